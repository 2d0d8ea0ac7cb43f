"""Which physics engine steps the kitchen: ``native`` (C MuJoCo) or ``mjx`` (MuJoCo in JAX).

Both are imported when they are first used.
"""

from __future__ import annotations

from functools import cache

import jax

from envs.kitchen.extra import import_mujoco
from envs.kitchen.physics import Physics

BACKENDS = ("auto", "native", "mjx")


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
