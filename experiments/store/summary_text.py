"""The text of a summary, which is printed after an adaptation. Nothing here imports jax."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.store.statistics import Interval, PartShare, SeedSpread, mean_log_success
from experiments.store.tables import block

SCORE = "geometric mean over goals of 1 plus the percentage achieved, minus 1"
"""What the score is, in words (``statistics.mean_log_success``)."""


def sampling_rows(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The rows on sampled episodes, as label and text; empty in worlds that judge greedily."""
    if not (fresh := summary.get("fresh")):
        return []
    gain = Interval(fresh["gain"], *(fresh["gain_95"] or ()))
    return [
        (
            "best single episode",
            f"{summary['best_episode_return']:.3f} (of the search: luck included)",
        ),
        (
            "fresh",
            f"{summary['final_return']:.3f} (the final return, of {fresh['episodes']} sampled episodes "
            "outside of the search)",
        ),
        ("  minus initial", f"{gain}{' (95 % over tasks)' if gain.low is not None else ''}"),
    ]


def named_goal_rows(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The rows on named goals, as label and text; empty in worlds without names.

    The labels of single goals begin with spaces.
    """
    if not (achieved := summary.get("achieved")):
        return []
    first, last = zip(*achieved.values(), strict=True)
    return [
        (
            "score",
            f"{mean_log_success(last):.2f} (initially {mean_log_success(first):.2f}; {SCORE})",
        ),
        (
            "goals achieved",
            f"{_mean_percent(last)} of {len(last)} (initially {_mean_percent(first)})",
        ),
        *(
            (f"  {name}", f"{_percent(after)} (initially {_percent(before)})")
            for name, (before, after) in achieved.items()
        ),
    ]


def _mean_percent(shares: Sequence[float]) -> str:
    return _percent(float(np.mean(shares)))


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def printed(summary: Mapping[str, Any]) -> str:
    """The summary as a block of text, which is printed after an adaptation."""
    low, high = summary["final_return_iqm_95"] or (None, None)
    final = SeedSpread(summary["final_return"], summary["final_return_std_over_seeds"])
    more = " (mean ± std over seeds)" if final.std is not None else ""
    inside = "" if low is None else " (95 %)"
    after_40, failed = summary["regret_after_40"], summary["failed_episodes"]
    rows = [
        ("initial return", f"{summary['initial_return']:.3f}"),
        ("final return", f"{final}{more}"),
        ("  IQM", f"{Interval(summary['final_return_iqm'], low, high)}{inside}"),
    ]
    if summary["optimal_return"] is not None:
        rows += [
            ("optimal return", f"{summary['optimal_return']:.3f}"),
            ("regret", str(SeedSpread(summary["regret"], summary["regret_std_over_seeds"]))),
            ("  after 40", "-" if after_40 is None else f"{after_40:.3f}"),
            ("solved optimally", f"{100 * summary['solved_optimally']:.0f} %"),
        ]
    if (spl := summary.get("spl")) is not None:
        rows.append(("success rate, SPL", f"{_percent(summary['success_rate'])}, {spl:.3f}"))
    if shares := summary.get("part_shares"):
        shown = "share of searches that did the first k parts (searches with at least k parts)"
        rows.append(("parts in order", shown))
        rows += [(f"  p{k}", str(PartShare(*pair))) for k, pair in enumerate(shares, 1)]
    rows += sampling_rows(summary) + named_goal_rows(summary)
    if unsolvable := summary.get("unsolvable_tasks"):
        rows.append(
            (
                "unsolvable tasks",
                f"{unsolvable} of {summary['num_tasks']} (never within the horizon)",
            )
        )
    if (used := summary.get("episodes_used")) is not None:
        saved = 100 * (1 - used / summary["num_episodes"])
        rows.append(
            ("episodes used", f"{used:.1f} in a search ({saved:.0f} % of the budget saved)")
        )
    if scored := summary.get("prompts_scored"):
        num = summary["num_tasks"] * summary["num_seeds"]
        each = summary["cpu_seconds"] / num
        rows.append(("a search", f"{scored:.0f} prompts rehearsed, {each:.2f} CPU-seconds"))
    if failed:
        rows.append(("failed episodes", f"{failed} (the simulation failed)"))
    rows.append(
        (
            "speed",
            f"{summary['episodes_per_cpu_second']:.0f} episodes per CPU-second"
            f" ({summary['cpu_seconds']:.0f} CPU-seconds)",
        )
    )
    head = (
        f"{summary['env']}, {summary['method']}: {summary['num_tasks']} tasks x "
        f"{summary['num_seeds']} seeds x {summary['num_episodes']} episodes"
    )
    return block(head, rows)
