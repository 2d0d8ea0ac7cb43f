"""The interface of the kitchen's physics engines: a state and one function that advances it.

C MuJoCo and MJX implement it with the same models; ``envs.kitchen.engines`` chooses one of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

MODELS = ("reduced", "stock")
NUM_ROBOT = 9  # joints of the arm and fingers, which come first in all positions
CONTROL_PERIOD = 0.08  # s
MAX_SHIFT = 2.0 * CONTROL_PERIOD  # action range times control period (FrankaRobot: act_rng, dt)
# Bounds of the position targets (franka_config.xml), rad and m.
TARGET_LOW = np.array([-2.9, -1.8, -2.9, -3.1, -2.9, 0.0, -2.9, 0.0, 0.0])
TARGET_HIGH = np.array([2.9, 1.8, 2.9, 0.0, 2.9, 3.8, 2.9, 0.04, 0.04])

Either = Array | np.ndarray


class PhysicsState(NamedTuple):
    """Everything that the next step depends on, in float32.

    There are Q positions and V velocities: 14 and 14 in the reduced model, 30 and 29 in the stock model.
    """

    qpos: Float[Array, "*batch Q"]
    qvel: Float[Array, "*batch V"]
    warmstart: Float[Array, "*batch V"]
    """Accelerations of the last substep, from which the contact solver starts."""


class ExactState(NamedTuple):
    """A state in double precision, which 32-bit programs only carry along, without computing with it."""

    qpos: Float[Array, "*batch Q"]
    """Positions in float32, for observations."""
    qvel: Float[Array, "*batch V"]
    """Velocities in float32."""
    exact: Int[Array, "*batch N"]
    """Positions, velocities and warm start in float64, each number as two 32-bit integers."""


def position_targets(qpos: Float[Either, "*batch Q"], action: Float[Either, "*batch 9"]) -> Any:
    """The position targets ``[.., 9]`` of the actuators: the current joint positions plus the scaled
    action."""
    shift = MAX_SHIFT * action.clip(-1.0, 1.0)
    return (qpos[..., :NUM_ROBOT] + shift).clip(TARGET_LOW, TARGET_HIGH)


class Coordinates(NamedTuple):
    """The mapping from a model's coordinates q to those of the full scene: ``base + scale * q[source]``.

    A coordinate that is fixed in the reduced model has scale 0. The scale of a coordinate that follows
    another joint is the ratio of the two.
    """

    source: Int[np.ndarray, "N"]
    scale: Float[np.ndarray, "N"]
    base: Float[np.ndarray, "N"]

    def expand(self, q: Float[Either, "*batch M"]) -> Float[Either, "*batch N"]:
        return self.base + self.scale * q[..., self.source]


@dataclass(frozen=True, eq=False)
class Physics:
    """An engine with a model."""

    initial: Any
    """The state at the start of every episode (numpy)."""
    positions: Coordinates
    """The mapping to the 30 positions of the full scene."""
    velocities: Coordinates
    """The mapping to the 29 velocities of the full scene."""
    advance: Callable[[Any, Float[Array, "9"], Bool[Array, ""]], Any]
    """``(state, action, active) -> state`` after 0.08 s; the action must be finite.

    If the world is not ``active``, because its episode has ended, the engine may return the state
    unchanged."""
