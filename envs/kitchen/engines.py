"""The choice of the kitchen's physics engine: ``native`` (C MuJoCo) or ``mjx`` (MuJoCo in JAX).

Engines are imported when they are first used.
"""

from __future__ import annotations

from functools import cache

import jax

from envs.kitchen.extra import import_mujoco
from envs.kitchen.physics import Physics

BACKENDS = ("auto", "native", "mjx")


def resolve_backend(backend: str, model: str) -> str:
    """Resolve ``auto`` to an engine: MJX on accelerators, C MuJoCo on CPUs and for the stock model."""
    if backend != "auto":
        return backend
    return "native" if model == "stock" or jax.default_backend() == "cpu" else "mjx"


@cache
def load_physics(backend: str, model: str) -> Physics:
    """The engine ``native`` or ``mjx`` with the model ``reduced`` or ``stock``.

    Raises:
      MissingExtraError: if the packages of the kitchen are missing or incompatible with each other.
      NoOpenGLError: if the OpenGL backend that ``MUJOCO_GL`` names is missing.
    """
    import_mujoco()  # raises errors before its first use
    if backend == "native":
        from envs.kitchen.native import native_physics

        return native_physics(model)
    from envs.kitchen.mjx import mjx_physics

    return mjx_physics(model)
