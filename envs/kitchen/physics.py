"""What a physics engine is to the kitchen: a state of three arrays and one function that advances it.

Two engines implement it on the same models, C MuJoCo and MJX; ``envs.kitchen.engines`` chooses one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

MODELS = ("reduced", "stock")
CONTROL_PERIOD = 0.08  # s

Either = Array | np.ndarray


class PhysicsState(NamedTuple):
    """Everything that the next step depends on, float32.

    Q positions and V velocities: 14 and 14 in the reduced model, 30 and 29 in the stock model.
    """

    qpos: Float[Array, "*batch Q"]
    qvel: Float[Array, "*batch V"]
    warmstart: Float[Array, "*batch V"]
    """Accelerations of the last substep, where the contact solver starts."""


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

    initial: PhysicsState
    """Where every episode starts (numpy)."""
    positions: Coordinates
    """To the 30 positions of the full scene."""
    velocities: Coordinates
    """To the 29 velocities of the full scene."""
    advance: Callable[[Any, Float[Array, "9"], Bool[Array, ""]], Any]
    """``(state, position targets of the actuators, whether it matters) -> state`` after 0.08 s.

    Where the result does not matter, since an episode has ended, an engine may return it unchanged."""
