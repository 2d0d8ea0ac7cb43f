"""Returns of a released policy under the prompt (g^M), which names only the task goal and is never changed.

    python -m examples.task_goal --env crafter-symbolic --validation --episodes 8 --temperatures 0 0.5 1
    python -m examples.task_goal --env crafter-symbolic --episodes 100

The first command compares greedy actions (temperature 0) with actions sampled at other temperatures, on
validation tasks. So one can choose how the policies of a world are judged. The second is a control for
searches whose best single episode is reported: what the best of as many episodes of one prompt returns.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

import envs
import mgpo_jax as mgpo
from envs.errors import DataError, UsageError
from experiments.adaptation import chosen_tasks
from experiments.runtime import configure, say
from experiments.store.statistics import gain_over_tasks
from experiments.store.tables import table
from mgpo_jax.tasks import num_tasks, task_at

HEAD = (
    "actions", "episodes", "return ± standard error", "minus the last row [95 % over tasks]",
    "best single episode of a task",
)  # fmt: skip


@dataclass(frozen=True)
class TaskGoalConfig:
    """Settings of this example."""

    env: str = "crafter-symbolic"
    """The world, whose released policy acts."""
    temperatures: tuple[float, ...] = (1.0,)
    """Temperatures of the distributions that actions are sampled from, 0 for greedy actions; a row for
    each."""
    episodes: int = 8
    """Number of episodes of each task and temperature."""
    validation: bool = False
    """Play on validation tasks instead of the test tasks."""


def play(name: str, temperatures: Sequence[float], episodes: int, validation: bool) -> np.ndarray:
    """The return of every episode, [temperatures, episodes, tasks]; at a temperature of 0 it is greedy."""
    world, env, policy = envs.find(name), envs.make(name), mgpo.load_policy(name)
    tasks = chosen_tasks(world, env, None, validation)
    goals = [env.task_goal(task_at(tasks, index)) for index in range(num_tasks(tasks))]
    prompts = [mgpo.single_goal(goal, policy.config.max_prompt_length) for goal in goals]
    shape = len(temperatures), len(prompts)
    parts = (jnp.stack(part) for part in zip(*prompts, strict=True))
    prompt = mgpo.Prompt(*(jnp.broadcast_to(part, (shape[0], *part.shape)) for part in parts))
    each = jnp.broadcast_to(jnp.asarray(temperatures)[:, None], shape)
    query = mgpo.Query(prompt, greedy=each == 0, temperature=jnp.where(each == 0, 1.0, each))
    seeds = tqdm(range(episodes), unit="episode of each task", disable=None)
    found = [mgpo.evaluate(env, policy, tasks, query, episodes=1, seed=seed)[0] for seed in seeds]
    return np.stack(found, axis=1)


def rows(temperatures: Sequence[float], returns: np.ndarray) -> list[list[str]]:
    """A row of the table for each temperature, of returns [temperatures, episodes, tasks]."""
    *others, last = returns
    gains = [str(gain_over_tasks(of, last)) for of in others] + [""]
    return [
        [
            f"sampled at {temperature:g}" if temperature else "greedy",
            str(of.size),
            f"{of.mean():.2f} ± {of.std(ddof=1) / np.sqrt(of.size):.2f}",
            gain,
            f"{of.max(axis=0).mean():.2f}",
        ]
        for temperature, of, gain in zip(temperatures, returns, gains, strict=True)
    ]


def main(config: TaskGoalConfig) -> None:
    """Play episodes of a released policy under the prompt (g^M), and print a row for each temperature."""
    if config.episodes < 1 or min(config.temperatures, default=-1) < 0:
        raise UsageError("give at least one episode, and temperatures of 0 or more")
    returns = play(config.env, config.temperatures, config.episodes, config.validation)
    say(table(HEAD, rows(config.temperatures, returns)))


if __name__ == "__main__":
    settings = tyro.cli(TaskGoalConfig, description=main.__doc__)
    configure()
    try:
        main(settings)
    except (DataError, ImportError, UsageError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
