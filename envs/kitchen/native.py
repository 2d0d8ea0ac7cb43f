"""C MuJoCo within jitted programs: a callback steps a batch of worlds on a pool of threads."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental.buffer_callback import buffer_callback
from jaxtyping import Array, Bool, Float, Shaped
from mujoco.batch import Batch, SimulationError

from envs.kitchen.model import (
    SUBSTEPS,
    initial_positions,
    initial_state,
    load_model,
    scene_coordinates,
)
from envs.kitchen.physics import ExactState, Physics, PhysicsState, position_targets

WORLDS_PER_THREAD = 8  # with fewer, waking the thread takes longer than its work


def num_threads(num_worlds: int) -> int:
    """The number of threads that step ``num_worlds`` worlds fastest on this machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return min(cores or 1, -(-num_worlds // WORLDS_PER_THREAD))


class Stepper:
    """Steps any number of worlds of one model. It is thread-safe.

    Args:
      model: the model.
      num_substeps: number of MuJoCo steps in a control step.
      fields: names of the model's fields whose values differ between worlds.
    """

    def __init__(
        self, model: mujoco.MjModel, num_substeps: int, fields: Sequence[str] = ()
    ) -> None:
        self.model = model
        self.num_substeps = num_substeps
        self.fields = fields
        self.sizes = (model.nq, model.nv, model.nv)
        self._idle: dict[int, list[Batch]] = defaultdict(list)
        self._lock = Lock()

    def __call__(self, rows: Array | np.ndarray) -> np.ndarray:
        """The new states ``[..., Q + 2 V]`` after a control step of rows ``[..., Q + 2 V + U + 1]``.

        A row holds positions, velocities, warm start, controls and whether to step at all. The state of a
        world that MuJoCo fails to step is NaN.
        """
        width = sum(self.sizes)
        # Converted to numpy first, since a jax operation in a callback may wait for the program that is
        # waiting for the callback.
        flat = np.asarray(rows).reshape(-1, rows.shape[-1])
        after = self.step(flat[:, :width], flat[:, width:-1], flat[:, -1] > 0)
        return after.astype(np.float32).reshape(*rows.shape[:-1], width)

    def step(
        self,
        before: Float[np.ndarray, "B N"],
        ctrl: Float[np.ndarray, "B U"],
        active: Bool[np.ndarray, "B"],
        values: Mapping[str, np.ndarray] | None = None,
    ) -> Float[np.ndarray, "B N"]:
        """The states of B worlds after a control step, in float64; inactive worlds are unchanged.

        Args:
          before: positions, velocities and warm starts.
          ctrl: position targets of the actuators.
          active: which worlds to step.
          values: the values of the fields that differ between worlds, ``[B, ...]`` each.
        """
        batch = self._take(len(before))
        names = ("qpos", "qvel", "qacc_warmstart")
        views = [batch.bind(name) for name in names]
        for view, part in zip(views, np.split(before, np.cumsum(self.sizes)[:-1], 1), strict=True):
            view[:] = part
        batch.bind("ctrl")[:] = ctrl
        for name, value in (values or {}).items():
            batch.expand(name)[:] = value
        failed = np.zeros(0, int)
        try:
            if active.any():
                batch.step(ids=active, nstep=self.num_substeps)
        except SimulationError as error:
            failed = np.asarray(error.ids)
        after = np.concatenate(views, axis=1)
        after[failed] = np.nan
        after[~active] = before[~active]
        self._give_back(batch)
        return after

    def _take(self, num: int) -> Batch:
        with self._lock:
            if self._idle[num]:
                return self._idle[num].pop()
        return Batch(self.model, num, num_threads(num))

    def _give_back(self, batch: Batch) -> None:
        with self._lock:
            self._idle[batch.nsim].append(batch)


class ExactStepper:
    """Steps worlds whose states are in double precision, as in MuJoCo and FrankaKitchen."""

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper
        self.sizes = (2 * sum(stepper.sizes), stepper.sizes[0], stepper.sizes[1])

    def __call__(self, rows: Array | np.ndarray) -> np.ndarray:
        """The new states ``[..., 2 N + Q + V]`` of rows ``[..., 2 N + 9 + 1]``, all as 32-bit integers.

        A row holds the N = Q + 2 V numbers of a state in float64, the action in float32 and whether to step
        at all. A new state also holds its positions and velocities in float32.
        """
        flat, num = np.asarray(rows).reshape(-1, rows.shape[-1]), self.sizes[0]
        before = np.ascontiguousarray(flat[:, :num]).view(np.float64)
        action = np.ascontiguousarray(flat[:, num:-1]).view(np.float32).astype(np.float64)
        after = self.stepper.step(before, position_targets(before, action), flat[:, -1] > 0)
        seen = after[:, : sum(self.sizes[1:])].astype(np.float32)
        bits = np.concatenate([after.view(np.int32), seen.view(np.int32)], axis=1)
        return bits.reshape(*rows.shape[:-1], sum(self.sizes))


def silence_warnings() -> None:
    """Silence MuJoCo's warnings about diverged worlds, which it also logs to a file; their states show
    it."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(lambda message: None)


def in_programs(
    stepper: Callable[[Array | np.ndarray], np.ndarray], width: int, dtype: Any = jnp.float32
) -> Callable[[Shaped[Array, "N"]], Shaped[Array, "M"]]:
    """Turn a function of numpy arrays ``[..., N] -> [..., M]`` into a jax function of one row.

    Args:
      stepper: the function.
      width: M.
      dtype: dtype of its result.
    """

    # For CPU devices: a pure_callback copies large arguments on the threads of the device. If all of these
    # wait for the callback, it never begins. A buffer_callback copies nothing.
    def write(context: Any, out: Any, rows: Any) -> None:
        del context
        np.asarray(out)[...] = stepper(np.asarray(rows))

    def call(row: Shaped[Array, "N"]) -> Shaped[Array, "M"]:
        result = jax.ShapeDtypeStruct((width,), dtype)
        if jax.default_backend() == "cpu":
            return buffer_callback(write, result, vmap_method="expand_dims")(row)
        return jax.pure_callback(stepper, result, row, vmap_method="expand_dims")

    return call


def native_physics(name: str) -> Physics:
    """C MuJoCo with the model ``reduced``, or with ``stock``, whose states are in double precision."""
    silence_warnings()
    stepper = Stepper(load_model(name), SUBSTEPS[name])
    if name == "stock":
        return _exact_physics(name, ExactStepper(stepper))
    splits = tuple(np.cumsum(stepper.sizes)[:-1].tolist())
    call = in_programs(stepper, sum(stepper.sizes))

    def advance(
        state: PhysicsState, action: Float[Array, "9"], active: Bool[Array, ""]
    ) -> PhysicsState:
        ctrl = position_targets(state.qpos, action)
        after = call(jnp.concatenate([*state, ctrl, active[None].astype(jnp.float32)]))
        return PhysicsState._make(jnp.split(after, splits))

    positions, velocities = scene_coordinates(name)
    return Physics(
        initial=initial_state(name), positions=positions, velocities=velocities, advance=advance
    )


def _exact_physics(name: str, stepper: ExactStepper) -> Physics:
    """C MuJoCo with states in double precision."""
    splits = tuple(np.cumsum(stepper.sizes)[:-1].tolist())
    call = in_programs(stepper, sum(stepper.sizes), jnp.int32)

    def advance(
        state: ExactState, action: Float[Array, "9"], active: Bool[Array, ""]
    ) -> ExactState:
        bits = jax.lax.bitcast_convert_type(action, jnp.int32)
        after = call(jnp.concatenate([state.exact, bits, active[None].astype(jnp.int32)]))
        exact, *seen = jnp.split(after, splits)
        qpos, qvel = (jax.lax.bitcast_convert_type(part, jnp.float32) for part in seen)
        return ExactState(qpos=qpos, qvel=qvel, exact=exact)

    rounded, positions = initial_state(name), initial_positions(name)
    at_rest = np.zeros(sum(stepper.stepper.sizes))
    at_rest[: len(positions)] = positions
    coordinates, velocities = scene_coordinates(name)
    exact: Any = at_rest.view(np.int32)
    return Physics(
        initial=ExactState(qpos=rounded.qpos, qvel=rounded.qvel, exact=exact),
        positions=coordinates,
        velocities=velocities,
        advance=advance,
    )
