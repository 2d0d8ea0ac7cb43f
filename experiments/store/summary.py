"""The numbers of an adaptation that tables show."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.store.results import Results
from experiments.store.statistics import seed_spread, stratified_bootstrap_iqm
from experiments.store.tables import block

MIDWAY = 40  # episodes after which the regret is also given
SOLVED = 1e-4  # a smaller regret counts as an optimal solution


def summarize(
    results: Results, *, policy_sha256: str, num_episodes: int, num_failed: int, cpu_seconds: float
) -> dict[str, Any]:
    """The numbers of ``summary.json``. Those that need an unknown optimum are None."""
    final = results.eval_returns[:, :, -1]
    iqm, spread = stratified_bootstrap_iqm(final), seed_spread(final)
    return {
        "env": results.env,
        "optimizer": results.method,
        "method": results.method,
        "policy_sha256": policy_sha256,
        "num_tasks": final.shape[1],
        "num_seeds": final.shape[0],
        "num_episodes": results.returns.shape[2],
        "initial_return": float(results.eval_returns[:, :, 0].mean()),
        "final_return": spread.mean,
        "final_return_std_over_seeds": spread.std,
        "final_return_iqm": iqm.value,
        "final_return_iqm_95": [iqm.low, iqm.high],
        **_against_optimum(results),
        "failed_episodes": num_failed,
        "best_episode_return": float(results.returns.max(axis=-1).mean()),
        "cpu_seconds": cpu_seconds,
        "episodes_per_cpu_second": num_episodes / cpu_seconds,
    }


def _against_optimum(results: Results) -> dict[str, Any]:
    names = (
        "optimal_return",
        "regret",
        "regret_std_over_seeds",
        "regret_after_40",
        "solved_optimally",
    )
    if not results.optimum_known:
        return dict.fromkeys(names)
    optimum = results.optimal_returns
    regret = optimum - results.eval_returns[:, :, -1]
    midway = np.flatnonzero(results.eval_episodes == MIDWAY)
    at_40 = None
    if len(midway):
        at_40 = float((optimum - results.eval_returns[:, :, midway[0]]).mean())
    values = (
        float(optimum.mean()),
        float(regret.mean()),
        seed_spread(regret).std,
        at_40,
        float((regret < SOLVED).mean()),
    )
    return dict(zip(names, values, strict=True))


def printed(summary: dict[str, Any]) -> str:
    """The summary as it is printed after an adaptation."""
    low, high = summary["final_return_iqm_95"]
    after_40, failed = summary["regret_after_40"], summary["failed_episodes"]
    rows = [
        ("initial return", f"{summary['initial_return']:.3f}"),
        (
            "final return",
            f"{summary['final_return']:.3f} ± {summary['final_return_std_over_seeds']:.3f}"
            " (mean ± std over seeds)",
        ),
        ("  IQM", f"{summary['final_return_iqm']:.3f} [{low:.3f}, {high:.3f}] (95 %)"),
    ]
    if summary["optimal_return"] is not None:
        rows += [
            ("optimal return", f"{summary['optimal_return']:.3f}"),
            ("regret", f"{summary['regret']:.3f} ± {summary['regret_std_over_seeds']:.3f}"),
            ("  after 40", "-" if after_40 is None else f"{after_40:.3f}"),
            ("solved optimally", f"{100 * summary['solved_optimally']:.0f} %"),
        ]
    if failed:
        rows.append(("failed episodes", f"{failed} (the world broke down)"))
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
