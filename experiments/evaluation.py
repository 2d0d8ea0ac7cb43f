"""Evaluate optimized prompts once more: under noise, or in another world with the same tasks."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

import envs
from envs.base import Environment, Task
from envs.errors import DataError, UsageError
from envs.official import Official
from envs.registry import WORLDS, World
from envs.wrappers import Noisy, noisy
from experiments.store.layout import TASKS
from experiments.store.policies import load_policy_of
from experiments.store.result_files import load_results
from experiments.store.results import Results
from experiments.store.statistics import SeedSpread, mean_log_success, seed_spread
from experiments.store.tables import table
from mgpo_jax import processes
from mgpo_jax.files import hash_arrays
from mgpo_jax.judging import evaluate_fully
from mgpo_jax.optimizers.methods import judged_query
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.progress import Progress
from mgpo_jax.prompts import Prompt
from mgpo_jax.seen_goals import warning_of_prompts
from mgpo_jax.tasks import tasks_from

OFFICIAL: Literal["official"] = "official"
"""Stands for the noise on observations that the world's official implementation adds by default."""


class Noise(NamedTuple):
    """Scales of the noise on observations and on actions."""

    obs: float | Literal["official"] = 0.0
    action: float = 0.0

    def __str__(self) -> str:
        named = {"observations": self.obs, "actions": self.action}
        told = (f"{name} {_format_size(size)}" for name, size in named.items() if size)
        return ", ".join(told) or "none"


def _format_size(size: float | str) -> str:
    return size if isinstance(size, str) else f"{size:g}"


class Case(NamedTuple):
    """An adaptation to evaluate, with its tasks, its policy and the worlds to evaluate it in."""

    folder: Path
    result: Results
    env: str
    """Name of the world."""
    world: World
    behind: Sequence[tuple[Noise, Environment]]
    """Each noise, with the environment that adds it."""
    tasks: Task
    policy: LoadedPolicy


def noises(obs: Sequence[float | Literal["official"]], action: Sequence[float]) -> list[Noise]:
    """The noises to evaluate under: one for each scale, or a single one of zero without any."""
    of_obs = [Noise(obs=size) for size in obs]
    return of_obs + [Noise(action=size) for size in action] or [Noise()]


def open_case(
    folder: Path, env_name: str | None, sizes: Sequence[Noise], policy: Path | None = None
) -> Case:
    """Read an adaptation, and check that policy, tasks and noise fit the world.

    Args:
      folder: its result folder.
      env_name: the world to evaluate in (default: the one that the prompts were found in).
      sizes: the noises.
      policy: folder of the policy (default: the one that the results name).

    Raises:
      UsageError: if the method has no prompts, or the world cannot run the tasks or has no such noise.
      DataError: if the results are damaged, or the policy is missing or does not fit.
    """
    if env_name is not None:
        envs.find(env_name)  # imports the module, so that the results may name it
    result = load_results(folder)
    if "prompt.goals" not in result.best:
        raise UsageError(f"{folder} is of {result.method}, which has no prompts to evaluate")
    name = env_name or result.env
    world, env = envs.find(name), envs.make(name)
    try:
        tasks = tasks_from(result.tasks, env, folder / TASKS)
    except DataError:
        if name == result.env:
            raise
        raise UsageError(_foreign_tasks_message(name, result.env)) from None
    obs_range = _official_noise(name, env, sizes)
    behind = [(noise, _add_noise(noise, env, obs_range)) for noise in sizes]
    loaded = load_policy_of(result, world, policy)
    processes.check_agreed(
        {
            f"the hash of the results in {folder}": hash_arrays({**result.best, **result.tasks}),
            f"the hash of the policy of {folder}": loaded.sha256,
        }
    )
    return Case(folder, result, name, world, behind, tasks, loaded)


def find_official(name: str, env: Environment) -> Official:
    """The official implementation of a world.

    Raises:
      UsageError: if it has none, or its dependencies are not installed.
    """
    make = envs.find(name).official
    if make is None:
        having = [world.name for world in WORLDS.usable() if world.official is not None]
        raise UsageError(
            f"{name} has no official implementation to compare with; worlds that have one: "
            f"{', '.join(having) or 'none'}"
        )
    try:
        return make(env)
    except ImportError as error:
        raise UsageError(str(error)) from None


def _official_noise(name: str, env: Environment, sizes: Sequence[Noise]) -> tuple[float, ...]:
    """Half widths of the observation noise of a world's official implementation; empty if no noise asks
    for it.

    Raises:
      UsageError: if there is no such program, or it adds no noise.
    """
    if not any(noise.obs == OFFICIAL for noise in sizes):
        return ()
    official = find_official(name, env)
    if not official.obs_noise:
        raise UsageError(
            f"--obs-noise {OFFICIAL}: {official.name} adds no noise to observations; give a number"
        )
    return official.obs_noise


def _add_noise(noise: Noise, env: Environment, obs_range: tuple[float, ...]) -> Noisy:
    """The world with noise added; ``obs_range`` has the half widths of the noise of its official
    implementation."""
    if isinstance(noise.obs, str):
        return noisy(env, action_noise=noise.action, obs_range=obs_range)
    return noisy(env, noise.obs, noise.action)


def _foreign_tasks_message(name: str, where: str) -> str:
    """The error message for a world whose tasks differ from those that the prompts were found for."""
    home = envs.find(where).home
    fitting = [world.name for world in WORLDS.usable() if world.home == home]
    return (
        f"--env {name} cannot run the tasks of {where}, where the prompts were found; worlds that can: "
        f"{', '.join(fitting) or where}"
    )


def evaluate_cases(cases: Sequence[Case], episodes: int, seed: int) -> Iterator[dict[str, Any]]:
    """Evaluate the optimized prompts of some adaptations; yields one row for each case and noise."""
    with Progress(sum(len(case.behind) for case in cases), "row") as progress:
        for case in cases:
            for row in _evaluate_case(case, episodes, seed):
                progress.update()
                yield row


def _evaluate_case(case: Case, episodes: int, seed: int) -> Iterator[dict[str, Any]]:
    result = case.result
    last = (slice(None), slice(None), -1)
    parts = (jnp.asarray(result.best[name][last]) for name in ("prompt.goals", "prompt.mask"))
    prompts = Prompt(*parts)
    said = warning_of_prompts(case.policy.seen_goals, *prompts, f"prompts of {case.folder}")
    if said and processes.is_first():
        print(f"warning: {said}", file=sys.stderr)
    queries = judged_query(prompts, case.world.judged)
    before = seed_spread(result.eval_returns[last])
    for noise, env in case.behind:
        judged = evaluate_fully(env, case.policy, case.tasks, queries, episodes=episodes, seed=seed)
        returns, num_failed = np.asarray(judged.return_), int(judged.num_failed.sum())
        now = seed_spread(returns)
        yield {
            "folder": str(case.folder),
            "num_tasks": returns.shape[1],
            "num_seeds": returns.shape[0],
            "episodes": episodes,
            "env": case.env,
            "optimizer": result.method,
            "noise": str(noise),
            "obs_noise": noise.obs,
            "action_noise": noise.action,
            "adapted": before.mean,
            "return": now.mean,
            "std_over_seeds": now.std,
            "change": now.mean - before.mean,
            "failed_episodes": num_failed,
            "num_episodes": returns.size * episodes,
            **_named_goal_entries(env, judged.achieved),
        }


def _named_goal_entries(env: Environment, achieved: Any) -> dict[str, Any]:
    """A row's entries on named goals, from success rates ``[S, N, M]``; none in worlds without names."""
    if achieved is None:
        return {}
    shares = dict(zip(env.goal_names, achieved.mean(axis=(0, 1)).tolist(), strict=True))
    return {"score": mean_log_success(list(shares.values())), "achieved": shares}


def achieved_table(rows: Sequence[dict[str, Any]]) -> str:
    """The score and the success rate of each named goal, with a column for each row that has them.

    Returns:
      The table in Markdown, or an empty string if no row has named goals.
    """
    having = [row for row in rows if "achieved" in row]
    if not having:
        return ""
    names = list(dict.fromkeys(name for row in having for name in row["achieved"]))
    lines = [["score", *(f"{row['score']:.2f}" for row in having)]]
    for name in names:
        shares = (row["achieved"].get(name) for row in having)
        lines.append([name, *("" if share is None else f"{100 * share:.1f} %" for share in shares)])
    return table(("goal", *(f"{row['folder']}, noise {row['noise']}" for row in having)), lines)


HEAD = (
    "folder", "env", "method", "tasks x seeds x episodes", "return in the adaptation", "noise",
    "return (mean ± std over seeds)", "change",
)  # fmt: skip


def cells(row: dict[str, Any]) -> list[str]:
    """The cells of a row in the printed table."""
    return [
        row["folder"],
        row["env"],
        row["optimizer"],
        f"{row['num_tasks']} x {row['num_seeds']} x {row['episodes']}",
        f"{row['adapted']:.3f}",
        row["noise"],
        str(SeedSpread(row["return"], row["std_over_seeds"])),
        f"{row['change']:+.3f}",
    ]
