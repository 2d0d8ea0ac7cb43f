"""C MuJoCo behind a callback: a batch of worlds on a pool of threads, inside jitted programs."""

from __future__ import annotations

import os
from collections import defaultdict
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental.buffer_callback import buffer_callback
from jaxtyping import Array, Bool, Float
from mujoco.batch import Batch, SimulationError

from envs.kitchen.model import SUBSTEPS, initial_state, load_model, scene_coordinates
from envs.kitchen.physics import Physics, PhysicsState

WORLDS_PER_THREAD = 8  # with fewer, waking the thread takes longer than the work it does


class Stepper:
    """Steps any number of worlds of one model; callers may be on several threads."""

    def __init__(self, model: mujoco.MjModel, num_substeps: int) -> None:
        self.model = model
        self.num_substeps = num_substeps
        self.sizes = (model.nq, model.nv, model.nv)
        self._idle: dict[int, list[Batch]] = defaultdict(list)
        self._lock = Lock()

    def __call__(self, rows: Array | np.ndarray) -> np.ndarray:
        """New states ``[..., Q + 2 V]`` of rows ``[..., Q + 2 V + U + 1]``.

        A row holds positions, velocities, warm start, controls and whether to step at all. Worlds
        that MuJoCo gives up on come back as NaN.
        """
        width = sum(self.sizes)
        # Converted to numpy first: a jax operation inside of a callback may wait for the very program that
        # waits for the callback.
        flat = np.asarray(rows).reshape(-1, rows.shape[-1])
        before = flat[:, :width]
        active = flat[:, -1] > 0
        batch = self._take(len(flat))
        names = ("qpos", "qvel", "qacc_warmstart")
        views = [batch.bind(name) for name in names]
        for view, part in zip(views, np.split(before, np.cumsum(self.sizes)[:-1], 1), strict=True):
            view[:] = part
        batch.bind("ctrl")[:] = flat[:, width:-1]
        failed = np.zeros(0, int)
        try:
            if active.any():
                batch.step(ids=active, nstep=self.num_substeps)
        except SimulationError as error:
            failed = np.asarray(error.ids)
        after = np.concatenate(views, axis=1).astype(np.float32)
        after[failed] = np.nan
        after[~active] = before[~active]
        self._give_back(batch)
        return after.reshape(*rows.shape[:-1], width)

    def _take(self, num: int) -> Batch:
        with self._lock:
            if self._idle[num]:
                return self._idle[num].pop()
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        threads = min(cores or 1, -(-num // WORLDS_PER_THREAD))
        return Batch(self.model, num, threads)

    def _give_back(self, batch: Batch) -> None:
        with self._lock:
            self._idle[batch.nsim].append(batch)


def native_physics(name: str) -> Physics:
    """The C engine with the model ``reduced`` or ``stock``."""
    if mujoco.get_mju_user_warning() is None:
        # A diverged world is flagged in its state; MuJoCo would also write a log to the working folder.
        mujoco.set_mju_user_warning(lambda message: None)
    model = load_model(name)
    stepper = Stepper(model, SUBSTEPS[name])
    width = sum(stepper.sizes)
    splits = tuple(np.cumsum(stepper.sizes)[:-1].tolist())

    # For CPU devices: a pure_callback copies large arguments on the threads of the device. These may all be
    # waiting for the callback, which then never begins. A buffer_callback copies nothing.
    def write(context: Any, out: Any, rows: Any) -> None:
        del context
        np.asarray(out)[...] = stepper(np.asarray(rows))

    def advance(
        state: PhysicsState, ctrl: Float[Array, "9"], active: Bool[Array, ""]
    ) -> PhysicsState:
        row = jnp.concatenate([*state, ctrl, active[None].astype(jnp.float32)])
        result = jax.ShapeDtypeStruct((width,), jnp.float32)
        if jax.default_backend() == "cpu":
            after = buffer_callback(write, result, vmap_method="expand_dims")(row)
        else:
            after = jax.pure_callback(stepper, result, row, vmap_method="expand_dims")
        return PhysicsState._make(jnp.split(after, splits))

    positions, velocities = scene_coordinates(name)
    return Physics(
        initial=initial_state(name), positions=positions, velocities=velocities, advance=advance
    )
