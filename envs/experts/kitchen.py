"""The demonstrator of the kitchen: a scripted arm that knows the order.

The paper trains one policy for each subtask with PPO and chains them (appendix C.2; neither the policies
nor their data are public). Here every subtask is a short list of phases: move the arm to a pose in front of
the object, approach, act along the arc of the object's joint, let go, retreat. Actions come from damped
least squares on the arm's Jacobian with gravity fed forward. A phase that lost its object ends early, and a
subtask that is not complete after its last phase starts again. Gaussian noise on all nine actions
spreads the data: a joint that were exact in every demonstration would teach a policy to trust its last
digit.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import Agent, Demonstrator, TimeStep
from envs.kitchen.extra import import_mujoco
from envs.kitchen.physics import CONTROL_PERIOD
from envs.kitchen.world import (
    MAX_SHIFT,
    NUM_ROBOT,
    NUM_SUBTASKS,
    Kitchen,
    KitchenState,
    KitchenTask,
)

NOISE = 0.08  # standard deviation on the actions of arm and fingers
OPEN, CLOSED = 0.04, 0.0  # m, of each finger

# All poses are angles of the seven joints, rad. A little inside of the ranges and of the targets' bounds:
LOW = np.array([-2.85, -1.755, -2.85, -3.02, -2.85, 0.02, -2.85])
HIGH = np.array([2.85, 1.72, 2.85, -0.45, 2.85, 2.09, 2.85])
HOME = np.array([0.148, -1.768, 1.844, -2.477, 0.26, 0.713, 1.595])  # where tries start again
ASIDE = (0.14, -1.63, -0.35, -2.78, -0.39, 1.17, 0.01)  # right of an open hinge door
REST = np.array([0.148, -1.5, 1.7, -2.3, 0.3, 0.8, 1.6])  # where redundancy leads
DAMPING = 0.03
MAX_TURN = 0.25  # rad in a step

# Places in the 30 positions of the scene, and the body, site and sign of motion of each subtask's joint.
JOINTS = (11, 17, 19, 21, 22)
BODIES = ("knob 2", "lightswitchroot", "slidelink", "hingerightdoor", "microdoorroot")
SIGNS = (-1.0, -1.0, 1.0, 1.0, -1.0)
SLIDES = (False, False, True, False, False)
# Phase of the second try, the fourth and so on: grasps start from where the hand is.
RETRY = (0, 0, 0, 2, 2)

# Phases are written with numbers and tuples; in the table of all phases every field is an array.
Number = Any
Vector = Any


class Phase(NamedTuple):
    """One movement of the hand.

    The tip follows ``point`` of the object, as its joint plus ``lead`` would carry it (kept within
    ``joint_range``), plus ``offset`` to the right, forward and up of the hand. Lengths are in m, angles in
    rad; an object's joint is in rad, the slide cabinet's in m.
    """

    point: Vector = (0.0, 0.0, 0.0)
    offset: Vector = (0.0, 0.0, 0.0)
    lead: Number = 0.0
    joint_range: Vector = (-9.0, 9.0)
    yaw: Number = 0.0
    """Of the hand about the vertical; 0 faces the cabinets."""
    yaw_rate: Number = 0.0
    """Added yaw per joint position."""
    pitch: Number = 0.0
    """Downward."""
    grip: Number = CLOSED
    """Position of each finger."""
    tolerance: Number = 0.0
    """Distance at which the phase ends, m (rad for joint moves); 0 takes all steps."""
    turn_tolerance: Number = 9.0
    """Angle to the target's orientation at which the phase may end."""
    steps: Number = 20
    """After which the phase ends at the latest."""
    stop: Number = 9.0
    """Joint position at which the phase ends, counted in the direction of motion."""
    lost: Number = 9.0
    """Distance at which the hand has lost the object."""
    speed: Number = 0.06
    """m in a step."""
    turning: Number = 0.3
    """Weight of rotation against translation, m / rad."""
    joint_move: Number = False
    """Whether to move in joint space, to ``pose``."""
    pose: Vector = tuple(HOME)


def _move_to(pose: tuple[float, ...], grip: float, tolerance: float, steps: int) -> Phase:
    return Phase(pose=pose, grip=grip, tolerance=tolerance, steps=steps, joint_move=True)


def _burner() -> list[Phase]:
    """Push the upper end of the bar from left to right."""
    beside, end = (-0.052, 0.014, 0.038), (0.0, 0.0616, 0.038)
    hand = Phase(yaw=-0.4, joint_range=(0.0, 0.0))
    pose = (-0.945, -1.5, 1.4, -2.21, 0.08, 1.19, 1.31)
    return [
        _move_to(pose, CLOSED, 0.15, 30),
        hand._replace(point=beside, offset=(0, 0.004, 0), tolerance=0.02, turn_tolerance=0.35),
        hand._replace(
            point=end,
            offset=(0, 0.004, 0),
            lead=-0.947,
            joint_range=(-9, 9),
            stop=-0.68,
            steps=40,
            speed=0.1,
            turning=0.25,
        ),
        hand._replace(point=beside, offset=(0, -0.13, 0), tolerance=0.05, steps=10),
    ]


def _light() -> list[Phase]:
    """Push the switch from right to left."""
    hand = Phase(point=(0.0315, -0.075, 0.0), joint_range=(0.0, 0.0))
    pose = (-0.85, -1.23, 1.26, -2.6, -0.05, 1.93, 1.16)
    return [
        _move_to(pose, CLOSED, 0.15, 30),
        hand._replace(offset=(0.075, 0.015, 0), tolerance=0.02, turn_tolerance=0.35),
        hand._replace(offset=(-0.16, 0.02, 0), tolerance=0.02, steps=35, stop=-0.55),
        hand._replace(offset=(-0.05, -0.12, 0), tolerance=0.05, steps=12),
    ]


def _slide() -> list[Phase]:
    """Straddle the handle and drag it to the right."""
    hand = Phase(point=(-0.183, -0.123, 0.0), yaw=0.35)
    pose = (0.65, -0.81, -0.4, -2.27, -0.3, 1.5, 0.01)
    return [
        _move_to(ASIDE, OPEN, 0.4, 40),
        _move_to(pose, OPEN, 0.15, 40),
        hand._replace(offset=(0, 0.005, 0), grip=OPEN, tolerance=0.02, turn_tolerance=0.35),
        hand._replace(lead=0.08, joint_range=(0, 0.42), speed=0.08, steps=45, stop=0.2),
        hand._replace(grip=OPEN, steps=3),
        hand._replace(offset=(0, -0.13, 0), grip=OPEN, tolerance=0.04, steps=12),
        _move_to(ASIDE, OPEN, 0.5, 20),
    ]


def _hinge() -> list[Phase]:
    """Grasp the handle of the right door and walk it around its hinge."""
    hand = Phase(point=(-0.302, -0.128, 0.0), yaw_rate=0.35, grip=OPEN)
    pulling = hand._replace(turning=0.12)
    pose = (-0.99, -0.88, 1.24, -1.37, -0.1, 0.93, 0.9)
    return [
        _move_to(pose, OPEN, 0.15, 30),
        hand._replace(tolerance=0.015, turn_tolerance=0.35, steps=25),
        hand._replace(grip=CLOSED, steps=6),
        pulling._replace(
            lead=0.16, joint_range=(0, 1.5), grip=CLOSED, stop=1.22, steps=90, speed=0.05, lost=0.05
        ),
        pulling._replace(steps=5),
        pulling._replace(offset=(0, -0.14, 0), tolerance=0.04, steps=14),
    ]


def _microwave() -> list[Phase]:
    """Grasp the handle from above, since the arm does not reach down to it level, and pull."""
    hand = Phase(point=(0.475, -0.108, 0.05), yaw=0.3, yaw_rate=0.6, pitch=0.6, grip=OPEN)
    pulling = hand._replace(offset=(0, 0.01, 0), turning=0.15)
    pose = (-1.02, -1.29, 2.13, -1.99, 0.13, 1.63, 1.34)
    return [
        _move_to(pose, OPEN, 0.15, 30),
        hand._replace(offset=(0, 0.01, 0), tolerance=0.012, turn_tolerance=0.35, steps=25),
        hand._replace(offset=(0, 0.01, 0), grip=CLOSED, steps=7),
        pulling._replace(
            lead=-0.13,
            joint_range=(-0.95, 0),
            grip=CLOSED,
            stop=-0.62,
            steps=60,
            speed=0.05,
            lost=0.05,
        ),
        pulling._replace(steps=5),
        pulling._replace(offset=(0, -0.14, 0), tolerance=0.04, steps=14),
    ]


class Plan(NamedTuple):
    """The phases of all subtasks, ``[5, P]`` and more axes for vectors."""

    phases: Phase
    num_phases: Int[np.ndarray, "S"]


class Scene(NamedTuple):
    """Where the moving bodies are, in the world."""

    positions: Float[np.ndarray, "S 3"]
    rotations: Float[np.ndarray, "S 3 3"]
    """At joint position 0; joints turn about their z axis or slide along their x axis."""


class Memory(NamedTuple):
    """Where the demonstrator is in its plan."""

    subtask: Int[Array, ""]
    phase: Int[Array, ""]
    clock: Int[Array, ""]
    """Steps since the phase began."""
    tries: Int[Array, ""]
    """At this subtask, before the present one."""


@cache
def make_plan() -> Plan:
    """All subtasks' phases in one table; the first phase is for tries after the first."""
    hub = _move_to(tuple(HOME), OPEN, 0.45, 20)
    lists = [[hub, *phases()] for phases in (_burner, _light, _slide, _hinge, _microwave)]
    longest = max(map(len, lists))
    padded = [phases + [hub] * (longest - len(phases)) for phases in lists]
    columns = (
        np.array([[getattr(phase, name) for phase in phases] for phases in padded])
        for name in Phase._fields
    )
    table = Phase(*map(_single, columns))
    return Plan(table, np.array([len(phases) for phases in lists], np.int32))


def _single(column: np.ndarray) -> np.ndarray:
    return column.astype(np.float32) if column.dtype == np.float64 else column


@cache
def make_scene(model_name: str) -> Scene:
    """Poses of the objects' bodies in either model."""
    mujoco = import_mujoco()
    from envs.kitchen.model import load_model

    model = load_model(model_name)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bodies = [data.body(name) for name in BODIES]
    return Scene(
        np.array([body.xpos for body in bodies], np.float32),
        np.array([body.xmat.reshape(3, 3) for body in bodies], np.float32),
    )


def scripted_arm(env: Kitchen, noise: float = NOISE) -> Agent:
    """The demonstrator; ``noise`` is the standard deviation on the nine actions."""
    import_mujoco()  # complains before its first use
    from envs.kitchen.arm import Pose, arm_pose, make_arm, rotation_vector, turn
    from envs.kitchen.model import load_model

    model = load_model(env.model)
    plan, scene, arm = make_plan(), make_scene(env.model), make_arm(model)
    stiffness = model.actuator_gainprm[:7, 0]  # of the position actuators, N m / rad
    # What a step moves a joint is a part of what its target moves.
    reach = 1 - np.exp(-CONTROL_PERIOD * stiffness / model.dof_damping[:7])

    def hand_target(
        phase: Phase, subtask: Int[Array, ""], joint: Float[Array, ""], lead: Float[Array, ""]
    ) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Where a phase wants the tip and how it wants to hold it, with the object at ``joint``."""
        ahead = jnp.clip(joint + lead, phase.joint_range[0], phase.joint_range[1])
        slides = jnp.asarray(SLIDES)[subtask]
        turned = turn(jnp.where(slides, 0.0, ahead)) @ phase.point
        moved = turned + jnp.where(slides, ahead, 0.0) * jnp.array([1.0, 0.0, 0.0])
        point = (
            jnp.asarray(scene.positions)[subtask] + jnp.asarray(scene.rotations)[subtask] @ moved
        )
        yaw = turn(phase.yaw + phase.yaw_rate * joint)
        cos, sin = jnp.cos(phase.pitch), jnp.sin(phase.pitch)
        # Columns: along the pads (up), opening of the fingers (right), approach (forward).
        level = jnp.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        level = level.at[1, 0].set(sin).at[1, 2].set(cos).at[2, 0].set(cos).at[2, 2].set(-sin)
        return point + yaw @ phase.offset, yaw @ level

    def toward(
        pose: Pose,
        angles: Float[Array, "7"],
        point: Float[Array, "3"],
        rotation: Float[Array, "3 3"],
        phase: Phase,
    ) -> Float[Array, "7"]:
        """Joint displacements that bring the tip nearer to the target."""
        shift = _shorten(point - pose.tip, phase.speed)
        spin = _shorten(rotation_vector(rotation @ pose.rotation.T), MAX_TURN)
        weight = jnp.concatenate([jnp.ones(3), jnp.full(3, phase.turning)])
        jacobian = weight[:, None] * pose.jacobian
        error = weight * jnp.concatenate([shift, spin])

        def solve(jacobian: Float[Array, "6 7"], rows: Float[Array, "6 N"]) -> Float[Array, "7 N"]:
            return jacobian.T @ jnp.linalg.solve(
                jacobian @ jacobian.T + DAMPING**2 * jnp.eye(6), rows
            )

        both = solve(jacobian, jnp.concatenate([error[:, None], jacobian], axis=1))
        rest = 0.1 * (jnp.asarray(REST, jnp.float32) - angles)
        step = both[:, 0] + rest - both[:, 1:] @ rest
        blocked = ((angles + step > HIGH) & (step > 0)) | ((angles + step < LOW) & (step < 0))
        # Joints at their limit stay there, and the others do the work.
        free = solve(jnp.where(blocked, 0.0, jacobian), error[:, None])[:, 0]
        held = jnp.where(blocked, jnp.clip(step, LOW - angles, HIGH - angles), free)
        return jnp.where(jnp.any(blocked), held, step)

    def is_over(
        phase: Phase,
        memory: Memory,
        pose: Pose,
        angles: Float[Array, "7"],
        joint: Float[Array, ""],
    ) -> Bool[Array, ""]:
        sign = jnp.asarray(SIGNS)[memory.subtask]
        point, rotation = hand_target(phase, memory.subtask, joint, phase.lead)
        grasp, _ = hand_target(phase, memory.subtask, joint, jnp.zeros(()))
        angle = jnp.linalg.norm(rotation_vector(rotation @ pose.rotation.T))
        distance = jnp.linalg.norm(point - pose.tip)
        near = (distance < phase.tolerance) & (angle < phase.turn_tolerance)
        posed = jnp.max(jnp.abs(phase.pose - angles)) < phase.tolerance
        stopped = (sign * (joint - phase.stop) > 0) & (phase.stop < 9.0)
        lost = jnp.linalg.norm(grasp - pose.tip) > phase.lost
        over = jnp.where(phase.joint_move, posed, near | stopped | lost)
        return over | (memory.clock >= phase.steps)

    def row(memory: Memory) -> Phase:
        return jax.tree.map(
            lambda column: jnp.asarray(column)[memory.subtask, memory.phase], plan.phases
        )

    def begin(
        key: PRNGKeyArray, task: KitchenTask, state: KitchenState, timestep: TimeStep
    ) -> tuple[Array, Array, Memory]:
        one = jnp.ones((), jnp.int32)
        memory = Memory(task.order[0].astype(jnp.int32), one, one, jnp.zeros((), jnp.int32))
        return proceed(key, memory, state, timestep)

    def proceed(
        key: PRNGKeyArray, memory: Memory, state: KitchenState, timestep: TimeStep
    ) -> tuple[Array, Array, Memory]:
        del timestep
        positions = env.physics.positions.expand(state.physics.qpos)
        angles = positions[:7]
        pose = arm_pose(arm, angles)
        joint = positions[jnp.asarray(JOINTS)[memory.subtask]]
        over = is_over(row(memory), memory, pose, angles, joint)
        phase = memory.phase + over
        last = phase >= jnp.asarray(plan.num_phases)[memory.subtask]
        following = state.task.order[jnp.minimum(state.num_solved, NUM_SUBTASKS - 1)]
        following = jnp.maximum(following, 0)
        tries = jnp.where(following == memory.subtask, memory.tries + 1, 0)
        again = jnp.where(tries % 2 == 1, jnp.asarray(RETRY)[memory.subtask], 0)
        memory = Memory(
            subtask=jnp.where(last, following, memory.subtask),
            phase=jnp.where(last, jnp.where(tries > 0, again, 1), phase),
            clock=jnp.where(over, 0, memory.clock) + 1,
            tries=jnp.where(last, tries, memory.tries),
        )
        current = row(memory)
        joint = positions[jnp.asarray(JOINTS)[memory.subtask]]
        point, rotation = hand_target(current, memory.subtask, joint, current.lead)
        step = jnp.where(
            current.joint_move,
            0.5 * (current.pose - angles),
            toward(pose, angles, point, rotation, current),
        )
        wanted = (step / reach + pose.gravity / stiffness) / MAX_SHIFT
        arm_action = wanted / jnp.maximum(1.0, jnp.max(jnp.abs(wanted)))
        fingers = jnp.clip(4 * (current.grip - positions[7:NUM_ROBOT]) / MAX_SHIFT, -1.0, 1.0)
        action = jnp.concatenate([arm_action, fingers])
        action = jnp.clip(action + noise * jax.random.normal(key, (NUM_ROBOT,)), -1.0, 1.0)
        return action.astype(jnp.float32), jnp.zeros((), bool), memory

    return Agent(begin, proceed)


def kitchen_demonstrators(env: Kitchen) -> dict[str, Demonstrator]:
    """The dataset: every ordered task in turn (paper: 300 of them, 30 episodes each)."""

    def hindsight_return(trajectory: Any) -> Array:
        """1: it completes what the task names, in its order."""
        del trajectory
        return jnp.ones(())

    expert = Demonstrator(
        sample_task=lambda key, index: env.task(index),
        agent=scripted_arm(env),
        keeps=lambda episode: episode.return_ > 0.999,  # complete, in order
        hindsight_return=hindsight_return,
        settings=(("noise", NOISE),),
    )
    return {"expert": expert}


def _shorten(vector: Float[Array, "3"], longest: Float[Array, ""] | float) -> Float[Array, "3"]:
    return vector * jnp.minimum(1.0, longest / (jnp.linalg.norm(vector) + 1e-9))
