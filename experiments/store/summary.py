"""The numbers of an adaptation that tables show. Nothing here imports jax before it has to."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NotRequired

import numpy as np
from annotated_types import Ge, Le, MaxLen
from pydantic import StringConstraints, with_config
from typing_extensions import TypedDict

from envs.errors import DataError, UsageError, nearest
from envs.registry import WORLDS, Registry
from experiments.store.layout import SUMMARY
from experiments.store.statistics import (
    Interval,
    SeedSpread,
    seed_spread,
    stratified_bootstrap_iqm,
)
from experiments.store.tables import block
from mgpo_jax.methods import METHODS
from mgpo_jax.schema import STRICT, ArrayField, read_arrays, read_document

if TYPE_CHECKING:
    from experiments.store.results import Results

MIDWAY = 40  # episodes after which the regret is also given
SOLVED = 1e-4  # a smaller regret counts as an optimal solution
CLOSE = 1e-4  # numbers of a summary and of the arrays may differ by this, relative to their size
ADAPT_AGAIN = "adapt again with `python -m experiments.adapt`"
JUDGED = {
    "eval_episodes": ArrayField(("C",), "int64", low=1),
    "eval_returns": ArrayField(("S", "N", "C"), "numbers"),
}
PLACE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", re.ASCII)  # module:attribute

Name = Annotated[str, MaxLen(200)]
Count = Annotated[int, Ge(0), Le(2**62)]
Positive = Annotated[int, Ge(1), Le(2**62)]
Size = Annotated[float, Ge(0)]
Share = Annotated[float, Ge(0), Le(1)]


@with_config(STRICT)
class Summary(TypedDict):
    """``summary.json``. What needs an unknown optimum, or more than one seed, is None."""

    env: Name
    optimizer: Name
    """The method, as older versions call it."""
    method: NotRequired[Name]
    policy_sha256: NotRequired[Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]]
    num_tasks: Positive
    num_seeds: Positive
    num_episodes: Positive
    unsolvable_tasks: NotRequired[Count]
    """Tasks that nobody can solve within the horizon."""
    initial_return: float
    final_return: float
    final_return_std_over_seeds: Size | None
    final_return_iqm: float
    final_return_iqm_95: tuple[float, float] | None
    optimal_return: float | None
    regret: float | None
    regret_std_over_seeds: Size | None
    regret_after_40: float | None
    solved_optimally: Share | None
    failed_episodes: Count
    best_episode_return: float
    cpu_seconds: Size
    episodes_per_cpu_second: Size


def method_of(summary: Summary) -> str:
    """Name or place of the method, also in a summary of an older version."""
    return summary.get("method", summary["optimizer"])


def summarize(
    results: Results, *, policy_sha256: str, num_episodes: int, num_failed: int, cpu_seconds: float
) -> dict[str, Any]:
    """The numbers of ``summary.json``."""
    return {
        "env": results.env,
        "optimizer": results.method,
        "method": results.method,
        "policy_sha256": policy_sha256,
        "num_tasks": results.returns.shape[1],
        "num_seeds": results.returns.shape[0],
        "num_episodes": results.returns.shape[2],
        "unsolvable_tasks": int((~solvable_tasks(results)).sum()),
        **_of_judgements(results.eval_returns),
        **_against_optimum(results),
        "failed_episodes": num_failed,
        "best_episode_return": float(results.returns.max(axis=-1).mean()),
        "cpu_seconds": cpu_seconds,
        "episodes_per_cpu_second": num_episodes / cpu_seconds,
    }


def _of_judgements(eval_returns: np.ndarray) -> dict[str, Any]:
    """What follows from the judged returns [S, N, C] alone."""
    final = eval_returns[:, :, -1]
    iqm, spread = stratified_bootstrap_iqm(final), seed_spread(final)
    return {
        "initial_return": float(eval_returns[:, :, 0].mean()),
        "final_return": spread.mean,
        "final_return_std_over_seeds": spread.std,
        "final_return_iqm": iqm.value,
        "final_return_iqm_95": None if iqm.low is None else [iqm.low, iqm.high],
    }


def solvable_tasks(results: Results) -> np.ndarray:
    """[N]: whether anyone could solve each task within the horizon."""
    import jax

    solvable = results.world.make().solvable
    return np.asarray(jax.jit(jax.vmap(solvable))(results.task_set))


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
        float(((regret < SOLVED) & solvable_tasks(results)).mean()),
    )
    return dict(zip(names, values, strict=True))


def read_summary(folder: Path) -> Summary:
    """The numbers that tables show, of a result folder.

    Raises:
      DataError: if there is no ``summary.json``, or a number is missing or cannot be.
    """
    path = Path(folder) / SUMMARY
    summary: Summary = read_document(path, Summary, ADAPT_AGAIN)
    _check_name(WORLDS, summary["env"], path)
    _check_name(METHODS, method_of(summary), path)
    if summary["num_seeds"] == 1:  # older versions wrote a spread of 0
        summary["final_return_std_over_seeds"] = summary["final_return_iqm_95"] = None
        summary["regret_std_over_seeds"] = None
    return summary


def _check_name(registry: Registry, name: str, path: Path) -> None:
    """Raise ``DataError`` for a name that is neither known nor a place, of which nothing is imported."""
    if PLACE.fullmatch(name):
        return
    try:
        if ":" in name:
            raise nearest(name, registry.names(), registry.kind)
        registry.find(name)
    except UsageError as error:
        raise DataError(f"{path}: {error}; {ADAPT_AGAIN}") from None


def check_against(arrays: Path, summary: Summary) -> None:
    """Raise ``DataError`` if a summary does not follow from the judged returns in ``results.npz``, or
    contradicts itself."""
    episodes, returns = _judgements(arrays)
    optimum, solved = summary["optimal_return"], summary["solved_optimally"]
    expected: dict[str, Any] = {
        "num_seeds": returns.shape[0],
        "num_tasks": returns.shape[1],
        "num_episodes": int(episodes[-1]),
        **_of_judgements(returns),
        "regret": None if optimum is None else optimum - summary["final_return"],
    }
    midway = np.flatnonzero(episodes == MIDWAY)
    if optimum is not None and len(midway):
        expected["regret_after_40"] = optimum - float(returns[:, :, midway[0]].mean())
    found: Mapping[str, Any] = summary
    for name, value in expected.items():
        if not _agree(found[name], value):
            raise DataError(
                f"{arrays.with_name(SUMMARY)}: {name} is {_told(found[name])}, by {arrays.name} it is "
                f"{_told(value)}; {ADAPT_AGAIN}"
            )
    if (solved is None) != (optimum is None):
        raise DataError(
            f"{arrays.with_name(SUMMARY)}: solved_optimally needs optimal_return; {ADAPT_AGAIN}"
        )


def _agree(found: Any, expected: Any) -> bool:
    if found is None or expected is None:
        return found is expected
    return bool(np.allclose(found, expected, rtol=CLOSE, atol=CLOSE))


def _told(value: Any) -> str:
    if value is None:
        return "unknown"
    return ", ".join(f"{part:.6g}" for part in np.ravel(value))


def _judgements(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """After how many episodes ``[C]`` the best choice was judged, and its returns ``[S, N, C]``."""
    arrays = read_arrays(path, JUDGED, dict.fromkeys("SNC", range(1, 2**31)), ADAPT_AGAIN)
    return arrays["eval_episodes"], arrays["eval_returns"]


def printed(summary: Mapping[str, Any]) -> str:
    """The summary as it is printed after an adaptation."""
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
    if unsolvable := summary.get("unsolvable_tasks"):
        rows.append(
            (
                "unsolvable tasks",
                f"{unsolvable} of {summary['num_tasks']} (never within the horizon)",
            )
        )
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
