"""What a physics engine is to the kitchen: a state and one function that advances it.

Two engines implement it on the same models, C MuJoCo and MJX; ``envs.kitchen.engines`` chooses one.
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
MAX_SHIFT = 2.0 * CONTROL_PERIOD  # action scale times control period (FrankaRobot: act_rng, dt)
# Bounds of the position targets (franka_config.xml), rad and m.
TARGET_LOW = np.array([-2.9, -1.8, -2.9, -3.1, -2.9, 0.0, -2.9, 0.0, 0.0])
TARGET_HIGH = np.array([2.9, 1.8, 2.9, 0.0, 2.9, 3.8, 2.9, 0.04, 0.04])

Either = Array | np.ndarray


class PhysicsState(NamedTuple):
    """Everything that the next step depends on, float32.

    Q positions and V velocities: 14 and 14 in the reduced model, 30 and 29 in the stock model.
    """

    qpos: Float[Array, "*batch Q"]
    qvel: Float[Array, "*batch V"]
    warmstart: Float[Array, "*batch V"]
    """Accelerations of the last substep, where the contact solver starts."""


class ExactState(NamedTuple):
    """A state in double precision, which programs of 32 bits carry along without computing with it."""

    qpos: Float[Array, "*batch Q"]
    """Positions in float32, to be observed."""
    qvel: Float[Array, "*batch V"]
    """Velocities in float32."""
    exact: Int[Array, "*batch N"]
    """Positions, velocities and warm start in float64, each number as two integers of 32 bits."""


def position_targets(qpos: Float[Either, "*batch Q"], action: Float[Either, "*batch 9"]) -> Any:
    """Position targets ``[.., 9]`` of the actuators: an action moves them from where the joints are."""
    shift = MAX_SHIFT * action.clip(-1.0, 1.0)
    return (qpos[..., :NUM_ROBOT] + shift).clip(TARGET_LOW, TARGET_HIGH)


class Coordinates(NamedTuple):
    """How the coordinates of the full scene follow from those of a model: ``base + scale * q[source]``.

    A coordinate that the reduced model keeps still has scale 0. One that follows another joint has the
    ratio of the two.
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
    """Where every episode starts (numpy)."""
    positions: Coordinates
    """To the 30 positions of the full scene."""
    velocities: Coordinates
    """To the 29 velocities of the full scene."""
    advance: Callable[[Any, Float[Array, "9"], Bool[Array, ""]], Any]
    """``(state, action, whether it matters) -> state`` after 0.08 s; the action is finite.

    Where the result does not matter, since an episode has ended, an engine may return it unchanged."""
