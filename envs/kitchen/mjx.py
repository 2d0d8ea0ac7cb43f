"""MuJoCo in JAX (MJX): the reduced kitchen as a part of jitted programs, for accelerators.

On CPUs a program that holds it must be compiled with ``EnvSpec.compiler_options``.
"""

from __future__ import annotations

import copy
import io
from contextlib import redirect_stdout

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from envs.kitchen.model import SUBSTEPS, initial_state, load_model, scene_coordinates
from envs.kitchen.physics import Physics, PhysicsState

with redirect_stdout(io.StringIO()):  # it prints that Warp, which is not used here, is missing
    from mujoco import mjx

# Lanes of a program wait for the slowest, so the solver stops early; it starts from the last solution.
ITERATIONS, LINE_SEARCH_ITERATIONS = 4, 6


def mjx_physics(
    name: str, iterations: int = ITERATIONS, line_search_iterations: int = LINE_SEARCH_ITERATIONS
) -> Physics:
    """MJX with the model ``reduced``; it has no collisions of cylinders with meshes as ``stock`` needs."""
    limited = copy.copy(load_model(name))
    limited.opt.iterations = iterations
    limited.opt.ls_iterations = line_search_iterations
    with jax.ensure_compile_time_eval():  # constants, also where a program is being traced
        model = mjx.put_model(limited, impl="jax")
        blank = mjx.make_data(model)

    def advance(
        state: PhysicsState, ctrl: Float[Array, "9"], active: Bool[Array, ""]
    ) -> PhysicsState:
        del active  # all lanes of a program take the same time

        def substep(state: PhysicsState, _: None) -> tuple[PhysicsState, None]:
            qpos, qvel, warmstart = state
            data = blank.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=ctrl)
            data = mjx.step(model, data)
            return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), None

        return jax.lax.scan(substep, jax.tree.map(jnp.asarray, state), length=SUBSTEPS[name])[0]

    return Physics(initial_state(name), *scene_coordinates(name), advance)
