"""What a physics engine is to the kitchen: a state of three arrays and one function that advances it.

Two engines implement it on the same models: ``native`` (C MuJoCo, ``envs.kitchen.native``) and ``mjx``
(JAX, ``envs.kitchen.mjx``). They are imported when first used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs.kitchen.extra import import_mujoco

BACKENDS = ("auto", "native", "mjx")
MODELS = ("reduced", "stock")
CONTROL_PERIOD = 0.08  # s


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

    What a reduced model holds still has scale 0; what follows another joint has its ratio.
    """

    source: Int[np.ndarray, "N"]
    scale: Float[np.ndarray, "N"]
    base: Float[np.ndarray, "N"]

    def expand(self, q: Float[Array, "M"]) -> Float[Array, "N"]:
        return self.base + self.scale * q[self.source]


@dataclass(frozen=True, eq=False)
class Physics:
    """An engine with a model."""

    initial: PhysicsState
    """Where every episode starts (numpy)."""
    positions: Coordinates
    """To the 30 positions of the full scene."""
    velocities: Coordinates
    """To the 29 velocities of the full scene."""
    advance: Callable[[PhysicsState, Float[Array, "9"], Bool[Array, ""]], PhysicsState]
    """``(state, position targets of the actuators, whether it matters) -> state`` after 0.08 s."""


def resolve_backend(backend: str, model: str) -> str:
    """The engine behind ``auto``: MJX on accelerators, C on CPUs and for the stock model."""
    if backend != "auto":
        return backend
    return "native" if model == "stock" or jax.default_backend() == "cpu" else "mjx"


@cache
def load_physics(backend: str, model: str) -> Physics:
    """The engine ``native`` or ``mjx`` with the model ``reduced`` or ``stock``.

    Raises:
      MissingExtraError: if the packages of the kitchen are missing or do not fit together.
      NoOpenGLError: if the OpenGL that ``MUJOCO_GL`` names is missing.
    """
    import_mujoco()  # complains before its first use
    if backend == "native":
        from envs.kitchen.native import native_physics

        return native_physics(model)
    from envs.kitchen.mjx import mjx_physics

    return mjx_physics(model)
