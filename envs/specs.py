"""The static specification of a world: its observations, goals and actions, and what its engine requires.

All of it is static configuration: frozen, hashable, and never traced.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


@dataclass(frozen=True)
class ArraySpec:
    """Shape and dtype of an array."""

    shape: tuple[int, ...]
    dtype: str = "float32"

    @property
    def size(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def is_float(self) -> bool:
        return np.issubdtype(np.dtype(self.dtype), np.floating)

    def __str__(self) -> str:
        return f"{self.dtype}{list(self.shape)}"


@dataclass(frozen=True)
class Discrete:
    """Actions are the integers 0 to ``num`` - 1."""

    num: int


@dataclass(frozen=True)
class Box:
    """Actions are ``size`` numbers in [-1, 1]."""

    size: int


@dataclass(frozen=True, kw_only=True)
class ObsLayout:
    """The meaning of the numbers in a flat observation, if some of them are categorical codes or counts.

    The codes of ``num_cells`` cells come first, then ``num_counts`` counts, then plain numbers. The code of
    a cell combines several digits d_0, d_1, .., such as the block in the cell and the creature on it. It is
    d_0 + code_sizes[0] * (d_1 + code_sizes[1] * (d_2 + ..)).

    Attributes:
      num_cells: number of cells.
      code_sizes: number of values of each digit of a code; a single size if codes are not divided into
        digits.
      num_counts: number of counts.
      max_count: the largest count; counts are integers from 0.
    """

    num_cells: int
    code_sizes: tuple[int, ...]
    num_counts: int
    max_count: int


@dataclass(frozen=True, kw_only=True)
class EnvSpec:
    """The static specification of a world.

    Attributes:
      name: the name of the world in messages and file names.
      obs: shape and dtype of an observation.
      goal_dim: size G of a goal.
      actions: the action space.
      horizon: number of steps after which an episode is truncated.
      return_range: smallest and largest possible return, by which optimizers scale returns.
      truncate_in_hindsight: whether a trajectory that is cut at any step is a demonstration of another task
        goal (paper, appendix D: true in MazeRunner, where every position is a goal).
      deterministic: whether the task and the actions determine an episode. If not, the return of one greedy
        episode is only a sample from the return distribution of a prompt.
      reward_confirms_goals: whether a reward at a goal means that this goal was the right one at this
        point, as in worlds that reward a sequence part by part.
      goals_are_states: whether the achieved goal determines the state of a task, as far as a policy can
        distinguish states. Then the observations of several episodes can be combined into one map.
      layout: the meaning of an observation's numbers, for encoders that embed codes and counts [all are
        plain numbers].
    """

    name: str
    obs: ArraySpec
    goal_dim: int
    actions: Discrete | Box
    horizon: int
    return_range: tuple[float, float]
    truncate_in_hindsight: bool = False
    deterministic: bool = True
    reward_confirms_goals: bool = False
    goals_are_states: bool = False
    layout: ObsLayout | None = None

    @property
    def discrete(self) -> bool:
        return isinstance(self.actions, Discrete)

    @property
    def action_dim(self) -> int:
        """The number of discrete actions, or the size A of a continuous one."""
        return self.actions.num if isinstance(self.actions, Discrete) else self.actions.size

    def zero_action(self) -> Array:
        """An action of the right shape and dtype."""
        return jnp.zeros((), jnp.int32) if self.discrete else jnp.zeros(self.action_dim)


@dataclass(frozen=True)
class Engine:
    """Requirements of a world's simulation engine on the compiled programs that step it.

    Attributes:
      worlds_together: smallest efficient batch of worlds in a step, for engines with a high overhead per
        call.
      compiler_options: XLA options for such programs, as pairs of name and value.
      max_segments: largest number of segments of an episode (``envs.episodes``), for worlds whose step
        takes long to compile, since each segment has its own copy of it.
    """

    worlds_together: int = 1
    compiler_options: tuple[tuple[str, bool], ...] = ()
    max_segments: int | None = None
