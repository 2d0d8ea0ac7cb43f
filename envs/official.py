"""A world beside the program that it re-implements: episodes in both, stepped by hand.

Where a world has such an official program, written by others, its record says how to reach it
(``World.official``). Then anyone can act in both and compare what comes of it, without trust in the world
here. Stepped by hand means step by step from Python, as the official program has to be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment, Task


class Played(NamedTuple):
    """What came of an episode."""

    reached: tuple[str, ...]
    """The goals that were reached, by name and in their order."""
    steps: tuple[int, ...]
    """After how many steps each of them was."""
    return_: float
    length: int
    """Steps of the episode."""


@runtime_checkable
class ByHand(Protocol):
    """One episode of one task, stepped by hand."""

    def reset(self) -> np.ndarray:
        """Begin, and return the first observation."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        """Take an action, and return the next observation and whether the episode is over."""

    def played(self) -> Played:
        """What has come of it so far."""


@runtime_checkable
class Acting(Protocol):
    """Who acts, such as ``mgpo_jax.Actor``."""

    def reset(self, obs: np.ndarray) -> np.ndarray:
        """The first action of an episode."""

    def act(self, obs: np.ndarray) -> np.ndarray:
        """The next action."""


@dataclass(frozen=True, kw_only=True)
class Official:
    """The official program of a world.

    Attributes:
      name: what it is called, with its version.
      episode: an episode of it on a task of the world, with the return that the task's rule gives.
      goal_name: a goal ``[G]`` in words, the same ones for both programs.
      task_name: a task in words.
      obs_noise: half widths of the uniform noise that it adds by default to each component of an
        observation, in their units; the episodes here have none. Empty: it adds none.
    """

    name: str
    episode: Callable[[Task], ByHand]
    goal_name: Callable[[np.ndarray], str]
    task_name: Callable[[Task], str]
    obs_noise: tuple[float, ...] = ()


class Own:
    """An episode of a world of this project, stepped by hand.

    Args:
      env: the world.
      task: one task of it.
      goal_name: a goal in words.
    """

    def __init__(
        self, env: Environment, task: Task, goal_name: Callable[[np.ndarray], str]
    ) -> None:
        self._reset, self._step = _programs(env)
        self._task, self._goal_name = jax.tree.map(jnp.asarray, task), goal_name

    def reset(self) -> np.ndarray:
        self._state, timestep = self._reset(jax.random.key(0), self._task)
        self._length, self._return = 0, 0.0
        self._reached: list[tuple[str, int]] = []
        return np.asarray(timestep.obs)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        self._state, timestep = self._step(self._state, jnp.asarray(action))
        self._length += 1
        self._return += float(timestep.reward)
        if timestep.goal_reached:
            self._reached.append(
                (self._goal_name(np.asarray(timestep.achieved_goal)), self._length)
            )
        return np.asarray(timestep.obs), bool(timestep.terminated | timestep.truncated)

    def played(self) -> Played:
        return played(self._reached, self._return, self._length)


@cache
def _programs(env: Environment) -> tuple[Any, Any]:
    """Reset and step of a world as compiled programs."""
    compiled = jax.jit(compiler_options=dict(env.engine.compiler_options))
    return compiled(env.reset), compiled(env.step)


def played(reached: list[tuple[str, int]], return_: float, length: int) -> Played:
    """The record of an episode that reached these goals, each with its step."""
    return Played(
        tuple(name for name, _ in reached), tuple(step for _, step in reached), return_, length
    )


def play(who: Acting, where: ByHand) -> Played:
    """One episode from its beginning to its end."""
    action = who.reset(where.reset())
    while True:
        obs, over = where.step(action)
        if over:
            return where.played()
        action = who.act(obs)
