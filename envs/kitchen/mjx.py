"""MuJoCo in JAX (MJX): the physics of the reduced kitchen within jitted programs, for accelerators.

On CPUs such programs must be compiled with the world's ``engine.compiler_options``.
"""

from __future__ import annotations

import copy
import io
from contextlib import redirect_stdout

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from envs.kitchen.model import SUBSTEPS, initial_state, load_model, scene_coordinates
from envs.kitchen.physics import Physics, PhysicsState, position_targets

with redirect_stdout(io.StringIO()):  # hides a notice that Warp, which is not used, is missing
    from mujoco import mjx

# All worlds of a batch wait for the slowest one, so the contact solver stops after few iterations. They
# suffice because it starts from the solution of the last substep.
ITERATIONS, LINE_SEARCH_ITERATIONS = 4, 6


def mjx_physics(
    name: str, iterations: int = ITERATIONS, line_search_iterations: int = LINE_SEARCH_ITERATIONS
) -> Physics:
    """MJX with the model ``reduced``. For ``stock`` it lacks collisions of cylinders with meshes."""
    limited = copy.copy(load_model(name))
    limited.opt.iterations = iterations
    limited.opt.ls_iterations = line_search_iterations
    with jax.ensure_compile_time_eval():  # these must be constants, even during tracing
        model = mjx.put_model(limited, impl="jax")
        blank = mjx.make_data(model)

    def advance(
        state: PhysicsState, action: Float[Array, "9"], active: Bool[Array, ""]
    ) -> PhysicsState:
        del active  # skipping saves no time, since a batch computes all of its worlds
        ctrl = position_targets(state.qpos, action)

        def substep(state: PhysicsState, _: None) -> tuple[PhysicsState, None]:
            qpos, qvel, warmstart = state
            data = blank.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=ctrl)
            with jax.default_matmul_precision("highest"):  # otherwise GPUs round factors to 10 bits
                data = mjx.step(model, data)
            after = PhysicsState(qpos=data.qpos, qvel=data.qvel, warmstart=data.qacc_warmstart)
            return after, None

        return jax.lax.scan(substep, jax.tree.map(jnp.asarray, state), length=SUBSTEPS[name])[0]

    positions, velocities = scene_coordinates(name)
    return Physics(
        initial=initial_state(name), positions=positions, velocities=velocities, advance=advance
    )
