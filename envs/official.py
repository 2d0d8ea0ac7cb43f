"""Comparing a world with its official implementation: episodes in both, stepped from Python.

If a world re-implements a program by others, the *official implementation*, its record says how to run that
(``World.official``). Then the same agent can act in both and the results can be compared, without having to
trust the re-implementation. Both are stepped one step at a time from Python, since the official
implementation requires that.
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
    """The result of an episode."""

    reached: tuple[str, ...]
    """The names of the goals that were reached, in order."""
    steps: tuple[int, ...]
    """The number of steps after which each goal was reached."""
    return_: float
    length: int
    """Number of steps of the episode."""


@runtime_checkable
class ByHand(Protocol):
    """One episode of one task, stepped from Python."""

    def reset(self) -> np.ndarray:
        """Begin the episode; returns the first observation."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        """Take an action; returns the next observation and whether the episode is over."""

    def played(self) -> Played:
        """The result so far."""


@runtime_checkable
class Acting(Protocol):
    """An agent that acts step by step, such as ``mgpo_jax.Actor``."""

    def reset(self, obs: np.ndarray) -> np.ndarray:
        """The first action of an episode."""

    def act(self, obs: np.ndarray) -> np.ndarray:
        """The next action."""


@dataclass(frozen=True, kw_only=True)
class Official:
    """The official implementation of a world, a program by others.

    Attributes:
      name: its name and version.
      episode: makes an episode of the program on a task of the world, with the return according to the
        task's rule.
      goal_name: the name of a goal ``[G]``, the same for both programs.
      task_name: a description of a task.
      obs_noise: half widths of the uniform noise that the program adds by default to each component of an
        observation, in its units (empty: none). The episodes here have no noise.
    """

    name: str
    episode: Callable[[Task], ByHand]
    goal_name: Callable[[np.ndarray], str]
    task_name: Callable[[Task], str]
    obs_noise: tuple[float, ...] = ()


class Own:
    """An episode of a world of this project, stepped from Python.

    Args:
      env: the world.
      task: one of its tasks.
      goal_name: the name of a goal.
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
    """The reset and step of a world, jitted."""
    compiled = jax.jit(compiler_options=dict(env.engine.compiler_options))
    return compiled(env.reset), compiled(env.step)


def played(reached: list[tuple[str, int]], return_: float, length: int) -> Played:
    """The result of an episode that reached these goals, pairs of name and step."""
    return Played(
        tuple(name for name, _ in reached), tuple(step for _, step in reached), return_, length
    )


def play(who: Acting, where: ByHand) -> Played:
    """Run one episode from its beginning to its end."""
    action = who.reset(where.reset())
    while True:
        obs, over = where.step(action)
        if over:
            return where.played()
        action = who.act(obs)
