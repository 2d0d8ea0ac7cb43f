"""Kinematics of the arm in JAX: the pose of the fingertips, its Jacobian, and the torques against gravity.

This needs only constants of the compiled model and no state of an engine, and costs a few small matrix
products. The tip is a point between the finger pads. The axes of its frame are x along the pads, y along
the opening of the fingers, and z along the approach.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from envs.kitchen.extra import import_mujoco

if TYPE_CHECKING:
    import mujoco

GRAVITY = 9.81  # m/s^2
PAD = 0.03  # m, from the site between the fingers to the center of their pads


class Arm(NamedTuple):
    """Constants of the seven links, in m and kg; all joints turn about the z axis of their link."""

    base_position: Float[np.ndarray, "3"]
    base_rotation: Float[np.ndarray, "3 3"]
    positions: Float[np.ndarray, "7 3"]
    """Position of each link in the frame of its parent."""
    rotations: Float[np.ndarray, "7 3 3"]
    masses: Float[np.ndarray, "7"]
    centers: Float[np.ndarray, "7 3"]
    """Center of mass of each link in its own frame; hand and fingers are part of the last link."""
    tip_position: Float[np.ndarray, "3"]
    """Position of the tip in the frame of the last link."""
    tip_rotation: Float[np.ndarray, "3 3"]


class Pose(NamedTuple):
    """The pose of the arm at given joint angles, in the world's frame; m and rad."""

    tip: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    """Orientation of the tip."""
    jacobian: Float[Array, "6 7"]
    """Linear and angular velocity of the tip per joint velocity."""
    gravity: Float[Array, "7"]
    """Torques that hold the arm against gravity, N m."""


def make_arm(model: mujoco.MjModel) -> Arm:
    """The constants of the arm in a model, which may be the reduced or the stock one."""
    mujoco = import_mujoco()
    data = mujoco.MjData(model)
    links = [model.body(f"panda0_link{number}") for number in range(1, 8)]
    data.qpos[7:9] = 0.02  # fingers half open
    mujoco.mj_forward(model, data)
    last = links[-1].id
    end = [last, model.body("panda0_leftfinger").id, model.body("panda0_rightfinger").id]
    masses = np.array([link.mass[0] for link in links])
    centers = np.array([link.ipos for link in links])
    masses[-1] = model.body_mass[end].sum()
    center = model.body_mass[end] @ data.xipos[end] / masses[-1]
    centers[-1] = data.xmat[last].reshape(3, 3).T @ (center - data.xpos[last])
    # The pose of the first link in the world at angle 0, since its parents are fixed.
    first = links[0].id
    site = model.site("end_effector")
    tip_rotation = _matrix(site.quat)
    positions = np.array([link.pos for link in links])
    rotations = np.array([_matrix(link.quat) for link in links])
    positions[0], rotations[0] = 0, np.eye(3)
    arm = Arm(
        base_position=data.xpos[first].copy(),
        base_rotation=data.xmat[first].reshape(3, 3),
        positions=positions,
        rotations=rotations,
        masses=masses,
        centers=centers,
        tip_position=site.pos + PAD * tip_rotation[:, 2],
        tip_rotation=tip_rotation,
    )
    return Arm._make(np.asarray(part, np.float32) for part in arm)


def arm_pose(arm: Arm, angles: Float[Array, "7"]) -> Pose:
    """Forward kinematics, the geometric Jacobian and gravity's torques."""
    position, rotation = jnp.asarray(arm.base_position), jnp.asarray(arm.base_rotation)
    anchors, axes, centers = [], [], []
    for link in range(7):
        position = position + rotation @ arm.positions[link]
        rotation = rotation @ arm.rotations[link]
        anchors.append(position)
        axes.append(rotation[:, 2])
        rotation = rotation @ turn(angles[link])
        centers.append(position + rotation @ arm.centers[link])
    tip = position + rotation @ arm.tip_position
    anchor, axis, center = jnp.stack(anchors), jnp.stack(axes), jnp.stack(centers)
    jacobian = jnp.concatenate([jnp.cross(axis, tip - anchor).T, axis.T])
    # Joint i lifts all links from i on.
    lift = jnp.cross(axis[:, None], center[None] - anchor[:, None])[..., 2]
    gravity = GRAVITY * jnp.sum(jnp.triu(lift) * arm.masses, axis=1)
    return Pose(tip=tip, rotation=rotation @ arm.tip_rotation, jacobian=jacobian, gravity=gravity)


def turn(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """The rotation matrix about z."""
    cos, sin, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros(()), jnp.ones(())
    return jnp.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one]).reshape(3, 3)


def rotation_vector(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Axis times angle, for angles below pi."""
    skew = jnp.stack(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine = jnp.linalg.norm(skew) / 2
    angle = jnp.arctan2(sine, (jnp.trace(rotation) - 1) / 2)
    return skew / 2 * jnp.where(sine > 1e-6, angle / jnp.maximum(sine, 1e-6), 1.0)


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    import_mujoco().mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)
