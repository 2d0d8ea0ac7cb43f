"""The kitchen with randomized scenes and physics, so that demonstrations do not depend on one simulator.

This is domain randomization (Tobin et al. 2017). An episode takes place either in the unmodified stock
scene, or in the reduced scene with randomized friction, softness of contacts, damping, places of the
handles and initial joint angles. The draw is a part of the task and is hidden from the agent. States are in
the coordinates of the full scene, whichever scene they belong to.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import Task
from envs.kitchen.env import NUM_SUBTASKS, Kitchen, KitchenTask
from envs.kitchen.model import (
    ARM_JOINTS,
    HANDLES,
    KNOB,
    OBJECT_JOINTS,
    SUBSTEPS,
    initial_state,
    joint_addresses,
    load_model,
    scene_coordinates,
)
from envs.kitchen.native import Stepper, in_programs, silence_warnings
from envs.kitchen.physics import MODELS, Either, Physics, position_targets

# Half widths of the uniform distributions in the reduced scene.
FRICTION = 0.3  # factor on the sliding friction of all contacts
SOFTNESS = 0.3  # factor on the time in which a contact recovers from penetration
DAMPING = 0.2  # factors on the damping of each joint
HANDLE = 0.01  # m, displacement of each object's collision shapes in each direction
START = 0.02  # rad, displacement of each joint of the arm at the start
STOCK_SHARE = 0.7  # fraction of the episodes that are in the stock scene

NUM_JOINTS = len(ARM_JOINTS)
VARIED_FIELDS = ("pair_friction", "pair_solref", "dof_damping", "geom_pos")


class Variation(NamedTuple):
    """The scene and physics of an episode. In the stock scene all fields except for ``scene`` have no
    effect."""

    scene: Int[Either, "*batch"]
    """Index into ``MODELS``."""
    friction: Float[Either, "*batch"]
    softness: Float[Either, "*batch"]
    damping: Float[Either, "*batch V"]
    handles: Float[Either, "*batch S 3"]
    """Displacements of the objects' collision shapes, in the frames of their bodies, m."""
    start: Float[Either, "*batch J"]
    """Displacements of the arm's joints at the start, rad."""


class VariedTask(NamedTuple):
    """An order of subtasks, and the scene and physics of the episode."""

    order: Int[Array, "*batch S"]
    variation: Variation


class VariedState(NamedTuple):
    """Everything that the next step depends on, in float32."""

    qpos: Float[Array, "*batch 30"]
    qvel: Float[Array, "*batch 29"]
    warmstart: Float[Array, "*batch 29"]
    variation: Float[Array, "*batch P"]
    """The part of the variation that physics depends on, as one row (``_packed``)."""


@dataclass(frozen=True)
class VariedKitchen(Kitchen):
    """The kitchen whose tasks also determine the scene and the physics; it is stepped by C MuJoCo.

    Attributes:
      stock_share: probability of the stock scene.
    """

    backend: str = "native"
    stock_share: float = STOCK_SHARE

    @property
    def physics(self) -> Physics:
        return varied_physics()

    def sample_task(self, key: PRNGKeyArray) -> Task:
        """A random order of subtasks in a random scene."""
        return self.varied(key, super().sample_task(key))

    def varied(self, key: PRNGKeyArray, task: KitchenTask) -> VariedTask:
        """The order of ``task`` in a random scene."""
        return VariedTask(task.order, draw_variation(jax.random.fold_in(key, 1), self.stock_share))

    def scene(self, task: VariedTask) -> Int[Either, ""]:
        """The index into ``MODELS`` of a task's scene."""
        return task.variation.scene

    def initial_physics(self, task: VariedTask) -> VariedState:
        return start_of(task.variation)


def settings(env: VariedKitchen) -> tuple[tuple[str, float], ...]:
    """Names and values of the settings that the draws depend on."""
    return (
        ("stock_share", env.stock_share),
        ("friction", FRICTION),
        ("softness", SOFTNESS),
        ("damping", DAMPING),
        ("handle", HANDLE),
        ("start", START),
    )


def draw_variation(key: PRNGKeyArray, stock_share: float = STOCK_SHARE) -> Variation:
    """A random scene with random physics."""
    keys = jax.random.split(key, 6)

    def around(key: PRNGKeyArray, center: float, width: float, *shape: int) -> Array:
        return jax.random.uniform(key, shape, minval=center - width, maxval=center + width)

    return Variation(
        scene=jax.random.bernoulli(keys[0], stock_share).astype(jnp.int32),
        friction=around(keys[1], 1.0, FRICTION),
        softness=around(keys[2], 1.0, SOFTNESS),
        damping=around(keys[3], 1.0, DAMPING, load_model("reduced").nv),
        handles=around(keys[4], 0.0, HANDLE, NUM_SUBTASKS, 3),
        start=around(keys[5], 0.0, START, NUM_JOINTS),
    )


def start_of(variation: Variation) -> VariedState:
    """The physics state at the start of an episode, at rest."""
    reduced, stock = (_initial_positions(name) for name in MODELS)
    is_stock = variation.scene == MODELS.index("stock")
    shift = jnp.where(is_stock, 0.0, variation.start)
    rest = jnp.asarray(initial_state("stock").qvel)
    return VariedState(
        qpos=jnp.where(is_stock, stock, reduced).at[:NUM_JOINTS].add(shift),
        qvel=rest,
        warmstart=rest,
        variation=_packed(variation),
    )


@cache
def _initial_positions(name: str) -> Float[np.ndarray, "30"]:
    """The initial positions of a model's episodes, in the coordinates of the full scene."""
    return np.asarray(scene_coordinates(name)[0].expand(initial_state(name).qpos))


def _packed(variation: Variation) -> Float[Array, "P"]:
    """The part of a variation that physics depends on, as one row of P numbers."""
    parts = (variation.scene, variation.friction, variation.softness)
    numbers = [jnp.asarray(part, jnp.float32)[None] for part in parts]
    return jnp.concatenate([*numbers, variation.damping, variation.handles.ravel()])


def _unpacked(rows: np.ndarray) -> Variation:
    """The variations in N rows of ``_packed``, without their starts."""
    ends = np.cumsum([1, 1, 1, load_model("reduced").nv])
    scene, friction, softness, damping, handles = np.split(rows, ends, axis=1)
    return Variation(
        scene=scene[:, 0].astype(int),
        friction=friction[:, 0],
        softness=softness[:, 0],
        damping=damping,
        handles=handles.reshape(-1, NUM_SUBTASKS, 3),
        start=np.zeros((len(rows), NUM_JOINTS)),
    )


def varied_fields(model: mujoco.MjModel, variation: Variation) -> dict[str, np.ndarray]:
    """The fields ``VARIED_FIELDS`` of the reduced model for each of N variations."""
    num = len(variation.scene)
    friction = np.repeat(model.pair_friction[None], num, axis=0)
    friction[:, :, :2] *= variation.friction[:, None, None]  # the two sliding directions
    solref = np.repeat(model.pair_solref[None], num, axis=0)
    solref[:, :, 0] *= variation.softness[:, None]
    places = np.repeat(model.geom_pos[None], num, axis=0)
    for geom, subtask in _shapes_of(model):
        places[:, geom] += variation.handles[:, subtask]
    return {
        "pair_friction": friction,
        "pair_solref": solref,
        "dof_damping": model.dof_damping * variation.damping,
        "geom_pos": places,
    }


def _shapes_of(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """The collision shapes of the objects, each with the subtask of its object."""
    joints = [int(model.joint(name).id) for name in OBJECT_JOINTS]
    bodies = [int(model.jnt_bodyid[joint]) for joint in joints]
    geoms = [int(model.geom(capsule.name).id) for capsule in (KNOB, *HANDLES)]
    return [(geom, bodies.index(int(model.geom_bodyid[geom]))) for geom in geoms]


class VariedStepper:
    """Steps worlds of both scenes, each with its own physics, in the coordinates of the full scene."""

    def __init__(self) -> None:
        self._models = {name: load_model(name) for name in MODELS}
        fields = {"reduced": VARIED_FIELDS, "stock": ()}
        self._steppers = {
            name: Stepper(model, SUBSTEPS[name], fields[name])
            for name, model in self._models.items()
        }
        self._coordinates = {name: scene_coordinates(name) for name in MODELS}
        self._addresses = {name: joint_addresses(name) for name in MODELS}
        self.sizes = self._steppers["stock"].sizes

    def __call__(self, rows: Array | np.ndarray) -> np.ndarray:
        """The new positions, velocities and warm starts ``[..., 88]`` of rows ``[..., 88 + P + 9 + 1]``.

        A row holds positions, velocities, warm start, variation, controls and whether to step at all.
        """
        flat, width = np.asarray(rows).reshape(-1, rows.shape[-1]), sum(self.sizes)
        num_controls = self._models["stock"].nu
        ends = [width, flat.shape[1] - num_controls - 1, flat.shape[1] - 1]
        states, packed, ctrl, active = np.split(flat, ends, axis=1)
        variation = _unpacked(packed)
        after, scene = np.array(states), np.asarray(variation.scene)
        for index, name in enumerate(MODELS):
            chosen = (scene == index) & (active[:, 0] > 0)
            if chosen.any():
                new = self._advance(name, states, ctrl, chosen, variation)
                after[chosen] = new[chosen]
        return after.reshape(*rows.shape[:-1], width)

    def _advance(
        self,
        name: str,
        states: Float[np.ndarray, "B N"],
        ctrl: Float[np.ndarray, "B U"],
        active: Bool[np.ndarray, "B"],
        variation: Variation,
    ) -> Float[np.ndarray, "B N"]:
        """Take a control step in the active worlds, all of which have the same model."""
        stepper, splits = self._steppers[name], np.cumsum(self.sizes)[:-1]
        joints, dofs = self._addresses[name]
        places = (joints, dofs, dofs)
        parts = np.split(states, splits, axis=1)
        own = [part[:, place] for part, place in zip(parts, places, strict=True)]
        fields = varied_fields(self._models[name], variation) if stepper.fields else {}
        own_after = stepper.step(np.concatenate(own, axis=1), ctrl, active, fields)
        own_after = own_after.astype(np.float32)
        qpos, qvel, own_warmstart = np.split(own_after, np.cumsum(stepper.sizes)[:-1], axis=1)
        positions, velocities = self._coordinates[name]
        warmstart = np.zeros_like(parts[2])
        warmstart[:, dofs] = own_warmstart
        return np.concatenate([positions.expand(qpos), velocities.expand(qvel), warmstart], axis=1)


@cache
def varied_physics() -> Physics:
    """C MuJoCo with both models."""
    silence_warnings()
    stepper = VariedStepper()
    splits = tuple(np.cumsum(stepper.sizes)[:-1].tolist())
    call = in_programs(stepper, sum(stepper.sizes))

    def advance(
        state: VariedState, action: Float[Array, "9"], active: Bool[Array, ""]
    ) -> VariedState:
        ctrl = position_targets(state.qpos, action)
        after = call(jnp.concatenate([*state, ctrl, active[None].astype(jnp.float32)]))
        return VariedState(*jnp.split(after, splits), variation=state.variation)

    positions, velocities = scene_coordinates("stock")
    return Physics(
        initial=initial_state("stock"), positions=positions, velocities=velocities, advance=advance
    )
