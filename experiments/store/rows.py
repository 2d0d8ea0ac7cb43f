"""Adaptations as the rows of a table, which state the tasks, the size, and all non-default settings.

Nothing here imports jax, except to ask a world about results of an older version. A module:attribute that a
file names is never imported.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envs.errors import DataError
from envs.registry import WORLDS, World
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.layout import ARRAYS, CONFIG, SUMMARY, TASKS
from experiments.store.paper import paper_final
from experiments.store.statistics import (
    Interval,
    PartShare,
    SeedSpread,
    mean_log_success,
    part_shares,
)
from experiments.store.summary import (
    ADAPT_AGAIN,
    DECIDING,
    Summary,
    check_against,
    judged_once,
    method_of,
    of_arrivals,
    read_summary,
)
from experiments.store.tables import number, shortened, table
from mgpo_jax.archives import array_names, read_arrays
from mgpo_jax.array_fields import ArrayField
from mgpo_jax.methods import METHODS, policy_kind
from mgpo_jax.released import released_folder
from mgpo_jax.schema import read_document

PAPER_EPISODES = 100  # the paper's episode budget per task
SHOWN = (
    "policy",
    "seed",
    "validation_seed",
    "eval_every",
    "eval_episodes",
    "obs_noise",
    "action_noise",
    "stop_at",
)  # settings that all methods have
STATED = {
    "seed",
    "eval_every",
}  # may differ in a row with the paper's number, since the row states them


class Row(NamedTuple):
    """An adaptation in a table."""

    folder: str
    summary: Summary
    tasks: str
    """``test`` (the world's test tasks), ``validation`` or ``own`` (a user's tasks)."""
    settings: Mapping[str, str]
    """The settings that differ from the defaults."""

    @property
    def like_the_paper(self) -> bool:
        """Whether the row is comparable with the paper's number."""
        return (
            self.tasks == "test"
            and self.summary["num_episodes"] == PAPER_EPISODES
            and not self.settings.keys() - STATED
        )


def as_json(row: Row) -> dict[str, Any]:
    """All of a row as JSON values."""
    about = {"folder": row.folder, "tasks": row.tasks, "settings": dict(row.settings)}
    return {**about, **row.summary}


def read_row(folder: Path) -> Row:
    """Read the row of an adaptation from its result folder.

    Raises:
      DataError: if a file is missing or damaged, or the files contradict each other.
    """
    summary = read_summary(folder)
    config = read_document(folder / CONFIG, dict[str, Any], ADAPT_AGAIN)
    made = (config.get("env"), config.get("method", config.get("bandit")))
    if made != (summary["env"], method_of(summary)):
        raise DataError(
            f"{folder / CONFIG} and {SUMMARY} name different worlds or methods; {ADAPT_AGAIN}"
        )
    # A module:attribute is not imported, so its record stays unknown.
    world = WORLDS.find(summary["env"]) if summary["env"] in WORLDS.names() else None
    single = judged_once(config, world)
    check_against(folder / ARRAYS, summary, single, world)
    if "part_shares" not in summary:
        summary["part_shares"] = _shares_of_older(folder, summary) if world and single else None
    if "spl" not in summary and single and world and world.step_cost:
        summary.update(_arrivals_of_older(folder, world))  # type: ignore[typeddict-item]
    return Row(
        folder=str(folder),
        summary=summary,
        tasks=kind_of_tasks(folder / TASKS, config, world),
        settings=changed_settings(config, summary, world),
    )


def _shares_of_older(folder: Path, summary: Summary) -> list[tuple[float, int]] | None:
    """p_k for results of an older version, which did not store the numbers of parts.

    The world computes them, which needs jax, unless the returns cannot be shares of parts. If the world's
    dependencies are not installed, p_k are unknown.
    """
    if not (0 <= summary["initial_return"] <= 1 and 0 <= summary["final_return"] <= 1):
        return None
    from experiments.store.result_files import load_results

    results = load_results(folder, parts=())
    with suppress(ImportError):
        shares = part_shares(results.eval_returns[:, :, -1], results.num_parts)
        return None if shares is None else [(share, num) for share, num in shares]
    return None


def _arrivals_of_older(folder: Path, world: World) -> dict[str, Any]:
    """Success rate and SPL for results of an older version, computed from their arrays."""
    fields = {name: DECIDING[name] for name in ("eval_returns", "optimal_returns")}
    arrays = read_arrays(
        folder / ARRAYS, fields, dict.fromkeys("SNC", range(1, 2**31)), ADAPT_AGAIN
    )
    return of_arrivals(arrays["eval_returns"], arrays.get("optimal_returns"), world)


def kind_of_tasks(path: Path, config: Mapping[str, Any], world: World | None) -> str:
    """The kind of an adaptation's tasks: ``test``, ``validation`` or ``own``.

    If a world has released test tasks, only exactly these count as ``test``, whatever the settings say.
    """
    stated = "validation" if config.get("validation") else "own"
    released = released_folder(world) / TASKS if world else None
    if released is None or not released.is_file():
        return "test" if stated == "own" and config.get("tasks") is None else stated
    tests, tasks = _all_arrays(released), _all_arrays(path)
    same = tasks.keys() == tests.keys() and all(
        np.array_equal(array, tests[name]) for name, array in tasks.items()
    )
    return "test" if same else stated


def _all_arrays(path: Path) -> dict[str, np.ndarray]:
    fields = {name: ArrayField(("N", ...), "anything") for name in array_names(path, ADAPT_AGAIN)}
    return read_arrays(path, fields, mend=ADAPT_AGAIN)


def changed_settings(
    config: Mapping[str, Any], summary: Summary, world: World | None
) -> dict[str, str]:
    """The settings of an adaptation that differ from the defaults, as text for a table."""
    fields = {field.name: field.default for field in dataclasses.fields(AdaptConfig)}
    changed = {
        name: config[name] for name in SHOWN if config.get(name, fields[name]) != fields[name]
    }
    sha256 = summary.get("policy_sha256")
    released = _released_sha256(world, policy_kind(method_of(summary)), sha256)
    if "policy" not in changed and sha256 not in (None, released):
        changed["policy"] = sha256[:12] if sha256 else ""
    return _texts(changed | _changed_hyper(config, method_of(summary), world))


def changed_hyper(settings: AdaptConfig, world: World | None) -> dict[str, str]:
    """The hyper-parameters of an adaptation that differ from the method's defaults in a world, as text."""
    if settings.hyper is None:
        return {}
    hyper = {"hyper": dataclasses.asdict(settings.hyper)}
    return _texts(_changed_hyper(hyper, settings.method, world))


def _texts(changed: Mapping[str, Any]) -> dict[str, str]:
    return {shortened(name): _format_setting(value) for name, value in changed.items()}


def _released_sha256(world: World | None, kind: str, default: str | None) -> str | None:
    """The hash of a world's released network of a kind; ``default`` if there is none."""
    place = released_folder(world, kind) / CONFIG if world else None
    if place is None or not place.is_file():
        return default
    return json.loads(place.read_text())["sha256"]


def _changed_hyper(config: Mapping[str, Any], method: str, world: World | None) -> dict[str, Any]:
    """Hyper-parameters that differ from the method's defaults in a world; all of them if unregistered."""
    hyper = config.get("hyper")
    if not isinstance(hyper, Mapping):  # the first version stored those of all methods together
        options = config.get("options")
        more = {name: config.get(name) for name in ("max_goals", "keep_rewarded")}
        hyper = {**options, **more} if isinstance(options, Mapping) else more
    if method not in METHODS.names():
        return {name: value for name, value in hyper.items() if value is not None}
    defaults = dataclasses.asdict(METHODS.find(method).hyper_in(world))
    return {
        name: value
        for name, value in hyper.items()
        if name in defaults and value != defaults[name] and value is not None
    }


def _format_setting(value: Any) -> str:
    """The value of a setting as text for a table."""
    if isinstance(value, bool):
        return str(value).lower()
    return shortened(f"{value:g}" if isinstance(value, float) else str(value))


HEAD = (
    "folder", "env", "method", "tasks", "tasks x seeds x episodes", "settings", "initial",
    "final (mean ± std over seeds)", "IQM [95 %]", "optimum", "regret", "after 40",
    "solved optimally", "paper: final",
)  # fmt: skip


FURTHER: Mapping[str, tuple[str, Callable[[Summary], str]]] = {
    "episodes used": ("episodes_used", lambda summary: f"{summary['episodes_used']:.1f}"),
    "prompts rehearsed": ("prompts_scored", lambda summary: f"{summary['prompts_scored']:.0f}"),
    "success rate": ("success_rate", lambda summary: f"{100 * summary['success_rate']:.1f} %"),
    "SPL": ("spl", lambda summary: f"{summary['spl']:.3f}"),
    "best single episode": ("fresh", lambda summary: f"{summary['best_episode_return']:.2f}"),
    "fresh": (
        "fresh",
        lambda summary: f"{summary['final_return']:.2f} ({summary['fresh']['episodes']} sampled)",
    ),
    "fresh - initial [95 % over tasks]": (
        "fresh",
        lambda summary: str(
            Interval(summary["fresh"]["gain"], *(summary["fresh"]["gain_95"] or ()))
        ),
    ),
    "score": ("achieved", lambda summary: f"{mean_log_success(_achieved(summary)):.2f}"),
    "goals achieved": (
        "achieved",
        lambda summary: f"{100 * np.mean(_achieved(summary)):.1f} %",
    ),
}
"""Optional columns by title: the entry of a summary that a cell needs, and a function that makes the
cell."""


def _achieved(summary: Summary) -> list[float]:
    """The success rate of each named goal under the optimized prompt."""
    return [after for _, after in summary["achieved"].values()]


def _further_cell(name: str, summary: Summary) -> str:
    """A cell of a column of ``FURTHER``; empty if the summary lacks its entry."""
    needed, cell = FURTHER[name]
    return cell(summary) if needed in summary else ""


def comparison(rows: Sequence[Row]) -> str:
    """A Markdown table of adaptations, with the paper's final returns where they are comparable.

    The columns of ``FURTHER`` and of p_k only appear if a row fills them.
    """
    further = [name for name in FURTHER if any(_further_cell(name, row.summary) for row in rows)]
    num = max((len(row.summary.get("part_shares") or ()) for row in rows), default=0)
    head = (*HEAD, *further, *(f"p{k}" for k in range(1, num + 1)))
    return table(
        head,
        [
            _cells(row)
            + [_further_cell(name, row.summary) for name in further]
            + _share_cells(row, num)
            for row in rows
        ],
    )


def _share_cells(row: Row, num: int) -> list[str]:
    shares = row.summary.get("part_shares") or ()
    return [str(PartShare(*pair)) for pair in shares] + [""] * (num - len(shares))


def _cells(row: Row) -> list[str]:
    summary = row.summary
    env, method = summary["env"], method_of(summary)
    low, high = summary["final_return_iqm_95"] or (None, None)
    return [
        row.folder,
        env,
        method,
        row.tasks,
        f"{summary['num_tasks']} x {summary['num_seeds']} x {summary['num_episodes']}",
        ", ".join(f"{name}={value}" for name, value in row.settings.items()),
        f"{summary['initial_return']:.2f}",
        str(SeedSpread(summary["final_return"], summary["final_return_std_over_seeds"])),
        str(Interval(summary["final_return_iqm"], low, high)),
        number(summary["optimal_return"]),
        number(summary["regret"]),
        number(summary["regret_after_40"]),
        _solved_cell(summary["solved_optimally"], summary.get("unsolvable_tasks", 0)),
        paper_final(env, method) if row.like_the_paper else "",
    ]


def _solved_cell(solved: float | None, num_unsolvable: int) -> str:
    if solved is None:
        return ""
    mark = f" ({num_unsolvable} tasks unsolvable)" if num_unsolvable else ""
    return f"{100 * solved:.0f} %{mark}"
