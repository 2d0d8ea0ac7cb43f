"""Fake results, and functions that run episodes, for tests of figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment, Episode
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import prompt_of
from mgpo_jax.rollout import Query, rollout


@dataclass
class FakeResults:
    """The part of ``Results`` that figures read.

    ``found[i]`` maps numbers of episodes to the best prompt on task i from then on.
    """

    tasks: Sequence[Any]
    task_goals: np.ndarray
    found: Sequence[Mapping[int, np.ndarray]] | None
    eval_episodes: np.ndarray
    eval_returns: np.ndarray
    optimal_returns: np.ndarray
    num_episodes: int
    max_goals: int
    method: str = "ucb"
    reached: None = None  # no figure of what a search has seen

    @property
    def returns(self) -> np.ndarray:
        return np.zeros((len(self.eval_returns), len(self.tasks), self.num_episodes))

    @property
    def best(self) -> dict[str, np.ndarray]:
        """Only its shape is read: the number of slots of a prompt."""
        return {"prompt.goals": np.zeros((1, 1, 1, self.max_goals, self.task_goals.shape[1]))}

    def task(self, index: int) -> Any:
        return self.tasks[index]

    def best_goals(self, seed: int, task: int, episodes: int | None = None) -> np.ndarray | None:
        if self.found is None:
            return None
        episodes = self.num_episodes if episodes is None else episodes
        return self.found[task][max(since for since in self.found[task] if since <= episodes)]


def player(env: Environment, policy: Policy) -> Callable[..., Episode]:
    """A function that runs episodes of a policy."""

    @jax.jit
    def run(keys: jax.Array, task: Any, query: Query) -> Episode:
        return jax.vmap(lambda key: rollout(key, env, policy, task, query))(keys)

    def play(key: jax.Array, task: Any, goals: np.ndarray, num: int, greedy: bool) -> Episode:
        query = Query(prompt_of(goals, policy.num_slots), jnp.asarray(greedy))
        task = jax.tree.map(jnp.asarray, task)
        return jax.tree.map(np.asarray, run(jax.random.split(key, num), task, query))

    return play
