"""The summary of an adaptation: the numbers that tables show, made of results, read and checked again.

jax is only imported where it is needed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NotRequired

import numpy as np
from annotated_types import Ge, Le, MaxLen, MinLen
from pydantic import with_config
from typing_extensions import TypedDict

from envs.errors import DataError, UsageError, nearest
from envs.registry import WORLDS, Registry, World
from experiments.store.layout import SUMMARY
from experiments.store.statistics import (
    MOST_PARTS,
    arrivals,
    gain_over_tasks,
    part_shares,
    seed_spread,
    stratified_bootstrap_iqm,
)
from mgpo_jax.archives import read_arrays
from mgpo_jax.array_fields import ArrayField
from mgpo_jax.methods import METHODS
from mgpo_jax.schema import STRICT, Sha256, read_document

if TYPE_CHECKING:
    from experiments.store.results import Results

MIDWAY = 40  # episodes after which the regret is also reported
BEHIND_NOISE = 10  # minimum number of episodes of a judgement under noise
SOLVED = 1e-4  # a smaller regret counts as an optimal solution
CLOSE = 1e-4  # tolerance, absolute and relative, between a summary and the arrays it follows from
ADAPT_AGAIN = "adapt again with `python -m experiments.adapt`"
DECIDING = {
    "returns": ArrayField(("S", "N", "E"), "numbers"),
    "eval_episodes": ArrayField(("C",), "int64", low=1),
    "eval_returns": ArrayField(("S", "N", "C"), "numbers"),
    "eval_achieved": ArrayField(("S", "N", "C", "M"), "numbers", required=False, low=0, high=1),
    "num_scored": ArrayField(("S", "N", "R"), "integers", required=False, low=0),
    "optimal_returns": ArrayField(("N",), "numbers", required=False),
    "num_parts": ArrayField(("N",), "integers", required=False, low=0),
}
"""Schemas of the arrays of ``results.npz`` that determine a summary."""
PLACE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", re.ASCII)  # module:attribute

Label = Annotated[str, MaxLen(200)]
Tally = Annotated[int, Ge(0), Le(2**62)]
Extent = Annotated[int, Ge(1), Le(2**62)]
Amount = Annotated[float, Ge(0)]
Fraction = Annotated[float, Ge(0), Le(1)]
Shares = Annotated[dict[Label, tuple[Fraction, Fraction]], MinLen(1), MaxLen(1_000)]
PartShares = Annotated[list[tuple[Fraction, Extent]], MinLen(1), MaxLen(MOST_PARTS)]


@with_config(STRICT)
class Fresh(TypedDict):
    """The result of a search by sampled episodes outside of the budget, in stochastic worlds.

    There, the best return within the search is a matter of luck.
    """

    episodes: Extent
    """Number of episodes that a judged return averages."""
    gain: float
    """``final_return`` minus ``initial_return``."""
    gain_95: tuple[float, float] | None
    """Its 95 % interval over tasks (``statistics.gain_over_tasks``); None for a single task."""


@with_config(STRICT)
class Summary(TypedDict):
    """``summary.json``. Entries that need an unknown optimum or more seeds than there are, are None."""

    env: Label
    optimizer: Label
    """The method, as older versions called it."""
    method: NotRequired[Label]
    policy_sha256: NotRequired[Sha256]
    num_tasks: Extent
    num_seeds: Extent
    num_episodes: Extent
    unsolvable_tasks: NotRequired[Tally]
    """Number of tasks that cannot be solved within the horizon."""
    initial_return: float
    final_return: float
    final_return_std_over_seeds: Amount | None
    final_return_iqm: float
    final_return_iqm_95: tuple[float, float] | None
    optimal_return: float | None
    regret: float | None
    regret_std_over_seeds: Amount | None
    regret_after_40: float | None
    solved_optimally: Fraction | None
    part_shares: NotRequired[PartShares | None]
    """p_1, p_2, .. under the optimized prompt, each with the number of tasks and seeds that it is based on
    (``statistics.part_shares``). None if tasks are not rewarded part by part, or if a judged return is the
    mean of several episodes, which does not say how many parts were done in each."""
    success_rate: NotRequired[Fraction]
    """In worlds where the task is to arrive in few steps (``World.step_cost``), and single episodes are
    judged: the share of them that arrived under the optimized prompt."""
    spl: NotRequired[Fraction]
    """Success weighted by path length (``statistics.Arrivals``), under the same conditions."""
    episodes_used: NotRequired[Amount]
    """With ``--stop-at``: mean number of episodes of a search."""
    prompts_scored: NotRequired[Amount]
    """For methods that score prompts with the policy instead of an episode: mean number per search."""
    failed_episodes: Tally
    best_episode_return: float
    """Mean return of the best single episode of each search; a matter of luck in stochastic worlds."""
    fresh: NotRequired[Fresh]
    """Only in worlds whose policies are judged by sampled actions."""
    achieved: NotRequired[Shares]
    """In worlds with named goals: the success rate of each goal under the initial and under the optimized
    prompt."""
    cpu_seconds: Amount
    episodes_per_cpu_second: Amount


def method_of(summary: Summary) -> str:
    """The method's name or module:attribute, also in a summary of an older version."""
    return summary.get("method", summary["optimizer"])


def summarize(
    results: Results, *, policy_sha256: str, num_episodes: int, num_failed: int, cpu_seconds: float
) -> dict[str, Any]:
    """Compute the ``summary.json`` of results."""
    solvable = solvable_tasks(results)
    optimum = results.optimal_returns if results.optimum_known else None
    final, single = results.eval_returns[:, :, -1], judged_once(results.config, results.world)
    return {
        "env": results.env,
        "optimizer": results.method,
        "method": results.method,
        "policy_sha256": policy_sha256,
        "unsolvable_tasks": int((~solvable).sum()),
        **_return_entries(results.returns),
        **_judgement_entries(results.eval_returns),
        **_optimum_entries(results.eval_episodes, results.eval_returns, optimum, solvable),
        "part_shares": part_shares(final, results.num_parts) if single else None,
        **of_arrivals(results.eval_returns, optimum, results.world if single else None),
        **_sampling_entries(results),
        **_named_goal_entries(results),
        **_scoring_entries(results),
        **_stopping_entries(results),
        "failed_episodes": num_failed,
        "cpu_seconds": cpu_seconds,
        "episodes_per_cpu_second": num_episodes / cpu_seconds,
    }


def _return_entries(returns: np.ndarray) -> dict[str, Any]:
    """The entries that follow from the returns [S, N, E] of the search."""
    return {
        "num_tasks": returns.shape[1],
        "num_seeds": returns.shape[0],
        "num_episodes": returns.shape[2],
        "best_episode_return": float(returns.max(axis=-1).mean()),
    }


def _judgement_entries(eval_returns: np.ndarray) -> dict[str, Any]:
    """The entries that follow from the judged returns [S, N, C] alone."""
    final = eval_returns[:, :, -1]
    iqm, spread = stratified_bootstrap_iqm(final), seed_spread(final)
    return {
        "initial_return": float(eval_returns[:, :, 0].mean()),
        "final_return": spread.mean,
        "final_return_std_over_seeds": spread.std,
        "final_return_iqm": iqm.value,
        "final_return_iqm_95": None if iqm.low is None else [iqm.low, iqm.high],
    }


def of_arrivals(
    eval_returns: np.ndarray, optimum: np.ndarray | None, world: World | None
) -> dict[str, Any]:
    """The entries ``success_rate`` and ``spl``; empty in worlds without them.

    Args:
      eval_returns: [S, N, C] judged returns of single episodes.
      optimum: [N] optimal returns, if they are known.
      world: the world; None if the judged returns are means of several episodes.
    """
    if world is None or world.step_cost is None or optimum is None:
        return {}
    return arrivals(eval_returns[:, :, -1], optimum, world.step_cost)._asdict()


def _scoring_entries(results: Results) -> dict[str, Any]:
    """The entry ``prompts_scored``; empty for methods that do not rehearse prompts."""
    if results.num_scored is None:
        return {}
    return {"prompts_scored": float(results.num_scored[:, :, -1].mean())}


def _stopping_entries(results: Results) -> dict[str, Any]:
    """The entry ``episodes_used``; empty for searches that cannot stop early."""
    used = results.episodes_used
    return {} if used is None else {"episodes_used": float(used.mean())}


def _sampling_entries(results: Results) -> dict[str, Any]:
    """The entry ``fresh``; empty in worlds that do not judge by sampled actions."""
    judged = results.world.judged
    if judged.mode != "sample":
        return {}
    episodes = judged_episodes(results.config, results.world)
    return {"fresh": {"episodes": episodes, **_gain(results.eval_returns)}}


def _gain(eval_returns: np.ndarray) -> dict[str, Any]:
    """The gain of the last over the first of the judged returns [S, N, C], with its interval."""
    gain = gain_over_tasks(eval_returns[:, :, -1], eval_returns[:, :, 0])
    return {"gain": gain.value, "gain_95": None if gain.low is None else [gain.low, gain.high]}


def _named_goal_entries(results: Results) -> dict[str, Any]:
    """The entry ``achieved``; empty in worlds whose goals have no names."""
    if results.eval_achieved is None:
        return {}
    shares = _first_and_last(results.eval_achieved).tolist()
    return {"achieved": dict(zip(results.world.make().goal_names, shares, strict=True))}


def _first_and_last(achieved: np.ndarray) -> np.ndarray:
    """The mean success rates [M, 2] in the first and the last judgement, from shares [S, N, C, M]."""
    return achieved[:, :, [0, -1]].mean(axis=(0, 1)).T


def judged_once(config: Mapping[str, Any], world: World | None) -> bool | None:
    """Whether a judged return is of a single episode; None if that depends on an unknown world."""
    episodes = judged_episodes(config, world)
    return None if episodes is None else episodes == 1


def judged_episodes(config: Mapping[str, Any], world: World | None) -> int | None:
    """The number of episodes that a judged return averages; None if that depends on an unknown world.

    The settings or the world's record determine it. Under noise, which the record does not consider, it is
    at least ``BEHIND_NOISE``.
    """
    if (episodes := config.get("eval_episodes")) is not None or world is None:
        return episodes
    noisy = config.get("obs_noise") or config.get("action_noise")
    return max(world.judged.episodes, BEHIND_NOISE if noisy else 1)


def solvable_tasks(results: Results) -> np.ndarray:
    """[N] whether each task can be solved within the horizon."""
    import jax

    solvable = results.world.make().solvable
    return np.asarray(jax.jit(jax.vmap(solvable))(results.task_set))


def _optimum_entries(
    episodes: np.ndarray,
    eval_returns: np.ndarray,
    optimum: np.ndarray | None,
    solvable: np.ndarray | bool = True,
) -> dict[str, Any]:
    """The entries that compare judged returns with the optimum; None if that is unknown.

    Args:
      episodes: [C] numbers of episodes after which the returns were judged.
      eval_returns: [S, N, C] judged returns.
      optimum: [N] optimal returns.
      solvable: [N] which tasks can count as solved.
    """
    names = (
        "optimal_return",
        "regret",
        "regret_std_over_seeds",
        "regret_after_40",
        "solved_optimally",
    )
    if optimum is None:
        return dict.fromkeys(names)
    regret = optimum - eval_returns[:, :, -1]
    midway = np.flatnonzero(episodes == MIDWAY)
    at_40 = None
    if len(midway):
        at_40 = float((optimum - eval_returns[:, :, midway[0]]).mean())
    values = (
        float(optimum.mean()),
        float(regret.mean()),
        seed_spread(regret).std,
        at_40,
        float(((regret < SOLVED) & solvable).mean()),
    )
    return dict(zip(names, values, strict=True))


def read_summary(folder: Path) -> Summary:
    """Read the summary of a result folder.

    Raises:
      DataError: if there is no ``summary.json``, or a number is missing or impossible.
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
    """Raise ``DataError`` for a name that is neither known nor a module:attribute; imports nothing."""
    if PLACE.fullmatch(name):
        return
    try:
        if ":" in name:
            raise nearest(name, registry.names(), registry.kind)
        registry.find(name)
    except UsageError as error:
        raise DataError(f"{path}: {error}; {ADAPT_AGAIN}") from None


def check_against(
    path: Path, summary: Summary, single: bool | None, world: World | None = None
) -> None:
    """Raise ``DataError`` if a summary does not follow from the arrays in ``results.npz``.

    Only the world knows which tasks are unsolvable. The summary gives their number, so its share of solved
    tasks must be consistent with that.

    Args:
      path: path of ``results.npz``.
      summary: the summary to check.
      single: whether the judged returns are of single episodes (``judged_once``); if that is unknown, the
        summary may lack p_k.
      world: the world, if it is known.
    """
    arrays = read_arrays(path, DECIDING, dict.fromkeys("SNECR", range(1, 2**31)), ADAPT_AGAIN)
    judged, optimum = arrays["eval_returns"], arrays.get("optimal_returns")
    found: dict[str, Any] = {"unsolvable_tasks": 0, **summary}
    num_tasks = judged.shape[1]
    num_unsolvable = min(found["unsolvable_tasks"], num_tasks)
    expected = {
        "unsolvable_tasks": num_unsolvable,
        **_return_entries(arrays["returns"]),
        **_judgement_entries(judged),
        **_optimum_entries(arrays["eval_episodes"], judged, optimum),
    }
    most, solved = expected["solved_optimally"], found["solved_optimally"]
    if most is not None and solved is not None:
        unsolvable = num_unsolvable / num_tasks
        least = max(0.0, most - unsolvable)
        expected["solved_optimally"] = float(np.clip(solved, least, min(most, 1 - unsolvable)))
    if "part_shares" in found:  # older versions did not write them
        known = "num_parts" in arrays and single is not False
        shares = part_shares(judged[:, :, -1], arrays["num_parts"]) if known else None
        expected["part_shares"] = None if single is None and not found["part_shares"] else shares
    if "spl" in summary and world is not None:
        expected |= {"success_rate": None, "spl": None}
        expected |= of_arrivals(judged, optimum, world if single else None)
    if "prompts_scored" in summary or "num_scored" in arrays:
        scored = arrays.get("num_scored")
        found.setdefault("prompts_scored", None)
        expected["prompts_scored"] = None if scored is None else scored[:, :, -1].mean()
    if fresh := summary.get("fresh"):
        found |= fresh
        expected |= _gain(judged)
    if "achieved" in summary or "eval_achieved" in arrays:
        of_goals = arrays.get("eval_achieved")
        found["achieved"] = list(summary.get("achieved", {}).values()) or None
        expected["achieved"] = None if of_goals is None else _first_and_last(of_goals)
    for name, value in expected.items():
        if not _agree(found[name], value):
            raise DataError(
                f"{path.with_name(SUMMARY)}: {name} is {_format_value(found[name])}, but {path.name} gives "
                f"{_format_value(value)}; {ADAPT_AGAIN}"
            )


def _agree(found: Any, expected: Any) -> bool:
    if found is None or expected is None:
        return found is expected
    same_shape = np.shape(found) == np.shape(expected)
    return same_shape and bool(np.allclose(found, expected, rtol=CLOSE, atol=CLOSE))


def _format_value(value: Any) -> str:
    if value is None:
        return "unknown"
    return ", ".join(f"{part:.6g}" for part in np.ravel(value))
