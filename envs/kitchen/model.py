"""The kitchen's models: the stock scene of gymnasium-robotics, and a reduced one that also runs in MJX.

The reduced model keeps the kinematics, masses and inertias, joints and actuators of the arm and of the five
objects that the subtasks move. It differs from the stock scene in that

- everything else is fixed: three knobs, the left hinge door and the kettle (which nothing touches);
- the burner and the lamp, which equality constraints tie to their switches, are computed from the switches;
- only the fingers and the hand collide, with the handles, the knob, the light switch, three doors and the
counter, all
  of which are capsules; the rest of the arm passes through the furniture;
- a control step consists of 10 steps of 0.008 s, in the stock scene of 40 steps of 0.002 s. For grasps to
hold at that
  step size, sliding friction is 2 instead of 1, and contacts have a higher impedance (``solimp``) but a
  slower reference (``solref``). Fingers have no friction against rolling and spinning (``condim`` 3 instead
  of 6).

The scene (kitchen: Copyright 2019 The DSuite Authors; Franka arm: modified from
github.com/vikashplus/franka; both Apache License 2.0) is read from the installed gymnasium-robotics.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from envs.kitchen.extra import check_extra, scene_path
from envs.kitchen.physics import CONTROL_PERIOD, Coordinates, PhysicsState

SUBSTEPS = {"reduced": 10, "stock": 40}

ARM_JOINTS = tuple(f"robot:panda0_joint{number}" for number in range(1, 8))
FINGER_JOINTS = ("robot:panda0_finger_joint1", "robot:panda0_finger_joint2")
OBJECT_JOINTS = (
    "knob_Joint_2",
    "light_switch",
    "slide_cabinet",
    "right_hinge_cabinet",
    "microwave",
)

# Initial positions of all joints in gymnasium-robotics (KitchenEnv), 30 numbers: arm and fingers; four
# pairs of knob and burner; light switch and lamp; slide cabinet; hinge doors; microwave; kettle's pose.
INITIAL_POSITIONS = np.array([
    1.48388023e-01, -1.76848573e00, 1.84390296e00, -2.47685760e00, 2.60252026e-01,
    7.12533105e-01, 1.59515394e00, 4.79267505e-02, 3.71350919e-02,
    -2.66279850e-04, -5.18043486e-05, 3.12877220e-05, -4.51199853e-05,
    -3.90842156e-06, -4.22629655e-05, 6.28065475e-05, 4.04984708e-05,
    4.62730939e-04, -2.26906415e-04,
    -4.65501369e-04,
    -6.44129196e-03, -1.77048263e-03,
    1.08009684e-03,
    -2.69397440e-01, 3.50383255e-01, 1.61944683e00,
    1.00618764e00, 4.06395120e-03, -6.62095997e-03, -2.68278933e-04,
])  # fmt: skip
KETTLE_AT_REST = (-0.2694, 0.3504, 1.6203, 1.0, 0.0, 0.0, 0.0)  # in the settled stock scene


class Capsule(NamedTuple):
    """A collision shape of the reduced model, in the frame of its body; lengths in m."""

    name: str
    body: str
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


# Placed by hand along the collision shapes of the stock scene.
FINGERS = (
    Capsule("left finger", "panda0_leftfinger", (0, 0.0112, 0.034), (0, 0.0112, 0.084), 0.0105),
    Capsule("right finger", "panda0_rightfinger", (0, -0.0112, 0.034), (0, -0.0112, 0.084), 0.0105),
)
HAND = Capsule("hand", "panda0_link7", (0.0495, 0.0495, 0.142), (-0.0495, -0.0495, 0.142), 0.035)
KNOB = Capsule("knob", "knob 2", (0, -0.034, 0.038), (0, 0.034, 0.038), 0.014)
HANDLES = (
    Capsule("light switch", "lightswitchroot", (0.0385, -0.0926, 0), (0.0152, -0.0374, 0), 0.021),
    Capsule("slide handle", "slidelink", (-0.183, -0.123, -0.137), (-0.183, -0.123, 0.137), 0.022),
    Capsule("slide door", "slidelink", (-0.183, -0.02, -0.165), (-0.183, -0.02, 0.165), 0.03),
    Capsule(
        "hinge handle", "hingerightdoor", (-0.302, -0.128, -0.138), (-0.302, -0.128, 0.138), 0.022
    ),
    Capsule("hinge door", "hingerightdoor", (-0.302, -0.015, -0.17), (-0.302, -0.015, 0.17), 0.03),
    Capsule(
        "microwave handle", "microdoorroot", (0.475, -0.108, -0.13), (0.475, -0.108, 0.13), 0.02
    ),
    Capsule(
        "microwave door", "microdoorroot", (0.475, -0.026, -0.16), (0.475, -0.026, 0.16), 0.024
    ),
)
COUNTER_HEIGHT = 1.6  # m
# MJX always solves for the largest number of contacts, here limited to the nearest ones; demonstrations
# have up to 2.
MAX_CONTACTS = 8
SITES = (
    "end_effector",
    "knob2_site",
    "light_site",
    "slide_site",
    "hinge_site2",
    "microhandle_site",
)


@cache
def load_model(name: str) -> mujoco.MjModel:
    """The model ``reduced`` or ``stock``, in which diverged worlds are not reset automatically.

    The stock model is the full one without its purely visual shapes. It gives the same results bit for bit,
    and is a tenth faster.
    """
    model = _stock_model() if name == "stock" else reduce_model(full_model())
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


def initial_positions(name: str) -> Float[np.ndarray, "Q"]:
    """The joint positions at the start of every episode."""
    return INITIAL_POSITIONS[joint_addresses(name)[0]]


def initial_state(name: str) -> PhysicsState:
    """The state at the start of every episode, at rest."""
    positions: Any = initial_positions(name).astype(np.float32)
    rest: Any = np.zeros(load_model(name).nv, np.float32)
    return PhysicsState(qpos=positions, qvel=rest, warmstart=rest)


def scene_coordinates(name: str) -> tuple[Coordinates, Coordinates]:
    """The mappings from a model's positions and velocities to the 30 positions and 29 velocities of the
    full scene."""
    positions, velocities = joint_addresses(name)
    full = full_model()
    still = np.concatenate([INITIAL_POSITIONS[:-7], KETTLE_AT_REST])
    return (
        _coordinates(positions, still, full, full.jnt_qposadr),
        _coordinates(velocities, np.zeros(full.nv), full, full.jnt_dofadr),
    )


def joint_addresses(name: str) -> tuple[np.ndarray, np.ndarray]:
    """The indices of a model's positions and velocities in those of the full scene."""
    model, full = load_model(name), full_model()
    if name == "stock":
        return np.arange(full.nq), np.arange(full.nv)
    joints = [full.joint(model.joint(index).name) for index in range(model.njnt)]
    return (
        np.array([joint.qposadr[0] for joint in joints]),
        np.array([joint.dofadr[0] for joint in joints]),
    )


def reduce_model(full: mujoco.MjModel) -> mujoco.MjModel:
    """Build the reduced model from the compiled stock scene."""
    data = mujoco.MjData(full)
    mujoco.mj_kinematics(full, data)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = CONTROL_PERIOD / SUBSTEPS["reduced"]
    joints = ARM_JOINTS + FINGER_JOINTS + OBJECT_JOINTS
    movable = {int(full.joint(name).bodyid[0]) for name in joints}
    bodies = {0: spec.worldbody}
    for index in sorted(movable):
        bodies[index] = _copy_body(full, data, index, bodies)
    named = {full.body(index).name: body for index, body in bodies.items()}
    for name in SITES:
        site = full.site(name)
        named[full.body(site.bodyid[0]).name].add_site(name=name, pos=site.pos, quat=site.quat)
    for capsule in (*FINGERS, HAND, KNOB, *HANDLES):
        named[capsule.body].add_geom(
            name=capsule.name,
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[*capsule.start, *capsule.end],
            size=[capsule.radius, 0, 0],
            contype=0,
            conaffinity=0,
        )
    spec.worldbody.add_geom(
        name="counter",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[2, 2, 0.1],
        pos=[0, 0, COUNTER_HEIGHT],
        contype=0,
        conaffinity=0,
    )
    touching = [(finger.name, other.name) for finger in FINGERS for other in (KNOB, *HANDLES)]
    touching += [(HAND.name, other.name) for other in HANDLES]
    touching += [(part.name, "counter") for part in (*FINGERS, HAND)]
    for first, second in touching:
        spec.add_pair(
            name=f"{first}, {second}",
            geomname1=first,
            geomname2=second,
            condim=3,
            friction=[2, 2, 0, 0, 0],  # sliding friction; condim 3 uses no other
            solref=[0.02, 1],
            solimp=[0.95, 0.99, 0.001, 0.5, 2],
            margin=0.001,
        )
    spec.add_numeric(name="max_contact_points", data=[MAX_CONTACTS])
    for index in range(full.nu):
        _copy_actuator(full, index, spec)
    return spec.compile()


@cache
def full_model() -> mujoco.MjModel:
    """The full scene of gymnasium-robotics with all visual shapes, for pictures and as the source of the
    others."""
    check_extra()
    return mujoco.MjModel.from_xml_path(str(scene_path()))


def _stock_model() -> mujoco.MjModel:
    check_extra()
    spec = mujoco.MjSpec.from_file(str(scene_path()))
    spec.compiler.discardvisual = True
    return spec.compile()


def _copy_body(
    full: mujoco.MjModel,
    data: mujoco.MjData,
    index: int,
    bodies: dict[int, mujoco.MjsBody],
) -> mujoco.MjsBody:
    """Copy a body with its joint and compiled inertia; the fixed bodies above it are merged into one
    pose."""
    body = full.body(index)
    parent = int(body.parentid[0])
    pose = {"pos": body.pos, "quat": body.quat}
    if parent not in bodies:
        parent, pose = 0, {"pos": data.xpos[index], "quat": data.xquat[index]}
    copy = bodies[parent].add_body(
        name=body.name,
        mass=body.mass[0],
        ipos=body.ipos,
        iquat=body.iquat,
        inertia=body.inertia,
        explicitinertial=True,
        **pose,
    )
    joint = full.joint(body.jntadr[0])
    copy.add_joint(
        name=joint.name,
        type=joint.type[0],
        pos=joint.pos,
        axis=joint.axis,
        limited=True,
        range=joint.range,
        damping=joint.damping[0],
        armature=joint.armature[0],
        frictionloss=joint.frictionloss[0],
    )
    return copy


def _copy_actuator(full: mujoco.MjModel, index: int, spec: mujoco.MjSpec) -> None:
    actuator = full.actuator(index)
    spec.add_actuator(
        name=actuator.name,
        target=full.joint(actuator.trnid[0]).name,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=full.actuator_gaintype[index],
        biastype=full.actuator_biastype[index],
        gainprm=actuator.gainprm,
        biasprm=actuator.biasprm,
        ctrllimited=True,
        ctrlrange=actuator.ctrlrange,
        forcelimited=True,
        forcerange=actuator.forcerange,
    )


def _coordinates(
    addresses: np.ndarray, still: np.ndarray, full: mujoco.MjModel, joint_address: np.ndarray
) -> Coordinates:
    """The mapping to the scene's coordinates from those at ``addresses``; others keep the values
    ``still``."""
    source = np.zeros(len(still), np.int32)
    scale = np.zeros(len(still), np.float32)
    base = still.astype(np.float32)
    source[addresses] = np.arange(len(addresses))
    scale[addresses] = 1
    base[addresses] = 0
    for index in range(full.neq):
        leader, follower = (
            joint_address[joints[index]] for joints in (full.eq_obj1id, full.eq_obj2id)
        )
        if leader in addresses and follower not in addresses:
            source[follower] = source[leader]
            scale[follower] = 1 / full.eq_data[index, 1]
            base[follower] = 0
    return Coordinates(source=source, scale=scale, base=base)
