"""Optimized prompts once more: in a world behind noise, or in another world with the same tasks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
from tqdm import tqdm

import envs
from envs.base import Environment, Task
from envs.errors import UsageError
from envs.registry import World
from envs.wrappers import Noisy
from experiments.store.policies import load_policy_of
from experiments.store.results import Results, load_results
from experiments.store.statistics import seed_spread
from mgpo_jax.optimizers.methods import judged_query
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.prompts import Prompt
from mgpo_jax.runner import evaluate
from mgpo_jax.tasks import tasks_from


class Noise(NamedTuple):
    """Sizes of the noise on observations and on actions."""

    obs: float = 0.0
    action: float = 0.0

    def __str__(self) -> str:
        named = {"observations": self.obs, "actions": self.action}
        return ", ".join(f"{name} {size:g}" for name, size in named.items() if size) or "none"


class Case(NamedTuple):
    """An adaptation, its tasks and policy, and the worlds that its prompts go to."""

    result: Results
    env: str
    """Name of the world."""
    world: World
    behind: Sequence[tuple[Noise, Environment]]
    """The world behind each noise."""
    tasks: Task
    policy: LoadedPolicy


def noises(obs: Sequence[float], action: Sequence[float]) -> list[Noise]:
    """What to evaluate under: each size by itself, or none."""
    of_obs = [Noise(obs=size) for size in obs]
    return of_obs + [Noise(action=size) for size in action] or [Noise()]


def open_case(folder: Path, env_name: str | None, sizes: Sequence[Noise]) -> Case:
    """Read an adaptation, and check that policy, tasks and noise fit the world."""
    result = load_results(folder)
    if "prompt.goals" not in result.best:
        raise UsageError(f"{folder} is of {result.method}, which has no prompts to evaluate")
    name = env_name or result.env
    world, env = envs.find(name), envs.make(name)
    tasks = tasks_from(result.tasks, env, folder)
    try:
        behind = [(noise, Noisy(env, noise.obs, noise.action)) for noise in sizes]
    except ValueError as error:
        raise UsageError(str(error)) from None
    return Case(result, name, world, behind, tasks, load_policy_of(result, world))


def evaluate_case(case: Case, episodes: int, seed: int) -> Iterator[dict[str, Any]]:
    """The optimized prompts of one adaptation, a row for each noise."""
    result = case.result
    last = (slice(None), slice(None), -1)
    parts = (jnp.asarray(result.best[name][last]) for name in ("prompt.goals", "prompt.mask"))
    queries = judged_query(Prompt(*parts), case.world.judged)
    before = seed_spread(result.eval_returns[last])
    for noise, env in tqdm(case.behind, unit="noise", disable=None):
        returns, num_failed = evaluate(
            env, case.policy, case.tasks, queries, episodes=episodes, seed=seed
        )
        now = seed_spread(returns)
        yield {
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
        }


HEAD = ("env", "method", "adapted", "noise", "return (mean ± std over seeds)", "change")


def cells(row: dict[str, Any]) -> list[str]:
    """A row as it is printed."""
    return [
        row["env"],
        row["optimizer"],
        f"{row['adapted']:.3f}",
        row["noise"],
        f"{row['return']:.3f} ± {row['std_over_seeds']:.3f}",
        f"{row['change']:+.3f}",
    ]
