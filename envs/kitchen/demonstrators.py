"""The demonstrator of the kitchen: a scripted arm that knows the order.

The paper trains one policy for each subtask with PPO and chains them (appendix C.2; neither the policies
nor their data are public). Here every subtask is a short list of phases: move the arm to a pose in front of
the object, approach, act along the arc of the object's joint, let go, retreat. Actions are computed by
damped least squares from the arm's Jacobian, plus the torques against gravity. A phase ends early if the
hand has lost its object, and a subtask that is not complete after its last phase is started again. Gaussian
noise on all nine actions diversifies the data. Without it some joints would follow the same path in every
demonstration, and a policy would learn to rely on irrelevantly small differences in their positions.

The phases are defined in ``envs.kitchen.phases``; this module executes them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.agents import Agent, Demonstrator
from envs.base import Episode, Task, TimeStep, Trajectory
from envs.kitchen.arm import Arm, Pose, arm_pose, make_arm, rotation_vector, turn
from envs.kitchen.env import (
    NUM_SUBTASKS,
    Kitchen,
    KitchenState,
    KitchenTask,
)
from envs.kitchen.extra import import_mujoco
from envs.kitchen.phases import RETRY, Phase, Plan, make_plan
from envs.kitchen.physics import CONTROL_PERIOD, MAX_SHIFT, MODELS, NUM_ROBOT

NUM_JOINTS = 7
NOISE = 0.08  # standard deviation of the noise on the actions of arm and fingers

# Limits for the angles of the seven joints, rad. They are slightly within the joints' ranges and the bounds
# of the actuators' targets.
LOW = np.array([-2.85, -1.755, -2.85, -3.02, -2.85, 0.02, -2.85])
HIGH = np.array([2.85, 1.72, 2.85, -0.45, 2.85, 2.09, 2.85])
# A pose of the hand needs six joints. The redundant degree of freedom is used to move towards these angles.
REST = np.array([0.148, -1.5, 1.7, -2.3, 0.3, 0.8, 1.6])
DAMPING = 0.03
MAX_TURN = 0.25  # rad in a step

# The joint that each subtask moves: its index in the 30 positions of the scene, the body that it moves, the
# sign of the motion, and whether it slides or turns.
JOINTS = (11, 17, 19, 21, 22)
BODIES = ("knob 2", "lightswitchroot", "slidelink", "hingerightdoor", "microdoorroot")
SIGNS = (-1.0, -1.0, 1.0, 1.0, -1.0)
SLIDES = (False, False, True, False, False)


class Scene(NamedTuple):
    """The poses of the objects' bodies in the world's frame."""

    positions: Float[np.ndarray, "S 3"]
    rotations: Float[np.ndarray, "S 3 3"]
    """Orientations at joint position 0; joints turn about their z axis or slide along their x axis."""


class Robot(NamedTuple):
    """The constants of one model that the demonstrator uses."""

    scene: Scene
    arm: Arm
    stiffness: Float[np.ndarray, "7"]
    """Stiffness of the joints' position actuators, N m / rad."""
    reach: Float[np.ndarray, "7"]
    """How far a joint moves in a control step, as a fraction of the distance to its actuator's target."""


class Sight(NamedTuple):
    """The demonstrator's observation at a step."""

    positions: Float[Array, "30"]
    """Joint positions of the full scene."""
    pose: Pose

    @property
    def angles(self) -> Float[Array, "7"]:
        """The angles of the arm's joints."""
        return self.positions[:NUM_JOINTS]

    @property
    def fingers(self) -> Float[Array, "2"]:
        return self.positions[NUM_JOINTS:NUM_ROBOT]

    def joint(self, subtask: Int[Array, ""]) -> Float[Array, ""]:
        """The joint position of the object that a subtask moves."""
        return self.positions[jnp.asarray(JOINTS)[subtask]]


class Target(NamedTuple):
    """The target position of the tip and orientation of the hand."""

    point: Float[Array, "3"]
    rotation: Float[Array, "3 3"]


class Memory(NamedTuple):
    """The demonstrator's place in its plan."""

    subtask: Int[Array, ""]
    phase: Int[Array, ""]
    clock: Int[Array, ""]
    """Number of steps since the phase began."""
    tries: Int[Array, ""]
    """Number of earlier tries of the current subtask."""


@cache
def make_scene(model_name: str) -> Scene:
    """The poses of the objects' bodies in a model."""
    mujoco = import_mujoco()
    from envs.kitchen.model import load_model

    model = load_model(model_name)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bodies = [data.body(name) for name in BODIES]
    return Scene(
        positions=np.array([body.xpos for body in bodies], np.float32),
        rotations=np.array([body.xmat.reshape(3, 3) for body in bodies], np.float32),
    )


@cache
def make_robot(model_name: str) -> Robot:
    """The scene and the arm of a model."""
    import_mujoco()
    from envs.kitchen.model import load_model

    model = load_model(model_name)
    stiffness = model.actuator_gainprm[:NUM_JOINTS, 0]
    return Robot(
        scene=make_scene(model_name),
        arm=make_arm(model),
        stiffness=stiffness,
        reach=1 - np.exp(-CONTROL_PERIOD * stiffness / model.dof_damping[:NUM_JOINTS]),
    )


def scripted_arm(env: Kitchen, noise: float = NOISE) -> Agent:
    """The demonstrator; ``noise`` is the standard deviation of the noise on the nine actions."""
    plan, robot = make_plan(), make_robot(env.model)

    def begin(
        key: PRNGKeyArray, task: Task, state: KitchenState, timestep: TimeStep
    ) -> tuple[Array, Array, Memory]:
        one = jnp.ones((), jnp.int32)
        memory = Memory(
            subtask=task.order[0].astype(jnp.int32),
            phase=one,
            clock=one,
            tries=jnp.zeros((), jnp.int32),
        )
        return proceed(key, memory, state, timestep)

    def proceed(
        key: PRNGKeyArray, memory: Memory, state: KitchenState, timestep: TimeStep
    ) -> tuple[Array, Array, Memory]:
        del timestep
        sight = look(robot, jnp.asarray(env.physics.positions.expand(state.physics.qpos)))
        over = is_over(robot.scene, current_phase(plan, memory), memory, sight)
        memory = advance(plan, memory, over, next_subtask(state))
        action = act(robot, current_phase(plan, memory), memory.subtask, sight)
        action = jnp.clip(action + noise * jax.random.normal(key, (NUM_ROBOT,)), -1.0, 1.0)
        return action.astype(jnp.float32), jnp.zeros((), bool), memory

    return Agent(begin=begin, proceed=proceed)


def kitchen_demonstrators(env: Kitchen) -> dict[str, Demonstrator]:
    """The demonstrators of a kitchen, by name.

    All demonstrate every ordered task in turn (paper: 300 tasks, 30 episodes each). ``expert`` demonstrates
    in both scenes, with randomized physics in the reduced one. The others demonstrate in one unmodified
    scene with one engine. In the worlds of MJX and of the stock scene their own demonstrator comes first.
    """
    import_mujoco()  # raises errors now rather than while a program is traced
    engine = "native" if env.backend == "native" else "auto"
    known = {
        "expert": in_both_scenes(env),
        "expert-reduced": in_one_scene(replace(env, backend=engine, model="reduced")),
        "expert-stock": in_one_scene(replace(env, backend="native", model="stock")),
        "expert-mjx": in_one_scene(replace(env, backend="mjx", model="reduced")),
    }
    first = "expert"
    if env.backend == "mjx":
        first = "expert-mjx"
    if env.model == "stock":
        first = "expert-stock"
    return {first: known.pop(first), **known}


def in_one_scene(place: Kitchen) -> Demonstrator:
    """The demonstrator in one fixed world."""

    def task_in_turn(key: PRNGKeyArray, index: Int[Array, ""]) -> KitchenTask:
        del key
        return place.task(index)

    return Demonstrator(
        sample_task=task_in_turn,
        agent=lambda weights: scripted_arm(place),
        keeps=is_perfect,
        hindsight_return=perfect_return,
        settings=(("noise", NOISE),),
        env=place,
    )


def in_both_scenes(env: Kitchen) -> Demonstrator:
    """The demonstrator in a scene that is drawn for each episode. It does not observe the draw."""
    from envs.kitchen import varied

    place = varied.VariedKitchen(name=env.name, horizon=env.horizon)

    def task_in_turn(key: PRNGKeyArray, index: Int[Array, ""]) -> varied.VariedTask:
        return place.varied(key, env.task(index))

    return Demonstrator(
        sample_task=task_in_turn,
        agent=lambda weights: scripted_arm(place),
        keeps=is_perfect,
        hindsight_return=perfect_return,
        settings=(("noise", NOISE), *varied.settings(place)),
        env=place,
        variants=MODELS,
        variant=place.scene,
    )


def is_perfect(episode: Episode) -> Bool[Array, "*batch"]:
    """Whether all subtasks were completed in the order of the task."""
    return episode.return_ > 0.999


def perfect_return(trajectory: Trajectory) -> Float[Array, ""]:
    """The return in hindsight: always 1, since the subtasks that were completed are a task that it
    solves."""
    del trajectory
    return jnp.ones(())


# The parts of one step: observe, check whether the phase is over, advance the plan, act.


def look(robot: Robot, positions: Float[Array, "30"]) -> Sight:
    """The demonstrator's observation of a scene with these joint positions."""
    return Sight(positions=positions, pose=arm_pose(robot.arm, positions[:NUM_JOINTS]))


def current_phase(plan: Plan, memory: Memory) -> Phase:
    """The current row of the plan."""
    return jax.tree.map(
        lambda column: jnp.asarray(column)[memory.subtask, memory.phase], plan.phases
    )


def next_subtask(state: KitchenState) -> Int[Array, ""]:
    """The first unsolved subtask of the task; the last one if all are solved."""
    subtask = state.task.order[jnp.minimum(state.num_solved, NUM_SUBTASKS - 1)]
    return jnp.maximum(subtask, 0)


def is_over(scene: Scene, phase: Phase, memory: Memory, sight: Sight) -> Bool[Array, ""]:
    """Whether a phase has reached its end, lost its object or run out of steps."""
    joint = sight.joint(memory.subtask)
    sign = jnp.asarray(SIGNS)[memory.subtask]
    target = hand_target(scene, phase, memory.subtask, joint, phase.lead)
    grasp = hand_target(scene, phase, memory.subtask, joint, jnp.zeros(()))
    angle = jnp.linalg.norm(rotation_vector(target.rotation @ sight.pose.rotation.T))
    distance = jnp.linalg.norm(target.point - sight.pose.tip)
    near = (distance < phase.tolerance) & (angle < phase.turn_tolerance)
    posed = jnp.max(jnp.abs(phase.pose - sight.angles)) < phase.tolerance
    stopped = (sign * (joint - phase.stop) > 0) & (phase.stop < 9.0)
    lost = jnp.linalg.norm(grasp.point - sight.pose.tip) > phase.lost
    over = jnp.where(phase.joint_move, posed, near | stopped | lost)
    return over | (memory.clock >= phase.steps)


def advance(plan: Plan, memory: Memory, over: Bool[Array, ""], following: Int[Array, ""]) -> Memory:
    """Go on to the next phase if the current one is over, or to the subtask ``following`` after the last.

    That is the same subtask again if its phases did not complete it. The first try of a subtask starts at
    phase 1. The second, fourth, .. try starts at the phase in ``RETRY``, the third, fifth, .. at phase 0,
    which leads to ``HOME``.
    """
    phase = memory.phase + over
    last = phase >= jnp.asarray(plan.num_phases)[memory.subtask]
    tries = jnp.where(following == memory.subtask, memory.tries + 1, 0)
    again = jnp.where(tries % 2 == 1, jnp.asarray(RETRY)[memory.subtask], 0)
    return Memory(
        subtask=jnp.where(last, following, memory.subtask),
        phase=jnp.where(last, jnp.where(tries > 0, again, 1), phase),
        clock=jnp.where(over, 0, memory.clock) + 1,
        tries=jnp.where(last, tries, memory.tries),
    )


def act(robot: Robot, phase: Phase, subtask: Int[Array, ""], sight: Sight) -> Float[Array, "9"]:
    """The action of a phase, without noise."""
    target = hand_target(robot.scene, phase, subtask, sight.joint(subtask), phase.lead)
    step = jnp.where(
        phase.joint_move, 0.5 * (phase.pose - sight.angles), step_toward(target, phase, sight)
    )
    # Actuators act like springs. To complete the step within the control period, their targets must be
    # beyond it, and to hold the arm against gravity they must be above it.
    wanted = (step / robot.reach + sight.pose.gravity / robot.stiffness) / MAX_SHIFT
    arm = wanted / jnp.maximum(1.0, jnp.max(jnp.abs(wanted)))
    fingers = jnp.clip(4 * (phase.grip - sight.fingers) / MAX_SHIFT, -1.0, 1.0)
    return jnp.concatenate([arm, fingers])


def hand_target(
    scene: Scene,
    phase: Phase,
    subtask: Int[Array, ""],
    joint: Float[Array, ""],
    lead: Float[Array, ""],
) -> Target:
    """The target of the hand in a phase, given the position ``joint`` of the object's joint."""
    ahead = jnp.clip(joint + lead, phase.joint_range[0], phase.joint_range[1])
    slides = jnp.asarray(SLIDES)[subtask]
    turned = turn(jnp.where(slides, 0.0, ahead)) @ phase.point
    moved = turned + jnp.where(slides, ahead, 0.0) * jnp.array([1.0, 0.0, 0.0])
    point = jnp.asarray(scene.positions)[subtask] + jnp.asarray(scene.rotations)[subtask] @ moved
    yaw = turn(phase.yaw + phase.yaw_rate * joint)
    cos, sin = jnp.cos(phase.pitch), jnp.sin(phase.pitch)
    # Columns: along the pads (up), opening of the fingers (right), approach (forward).
    level = jnp.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    level = level.at[1, 0].set(sin).at[1, 2].set(cos).at[2, 0].set(cos).at[2, 2].set(-sin)
    return Target(point=point + yaw @ phase.offset, rotation=yaw @ level)


def step_toward(target: Target, phase: Phase, sight: Sight) -> Float[Array, "7"]:
    """The joint displacements of one step that brings the hand nearer to its target.

    As far as the pose of the hand leaves the joints free, they move towards ``REST``.
    """
    pose, angles = sight.pose, sight.angles
    shift = _shorten(target.point - pose.tip, phase.speed)
    spin = _shorten(rotation_vector(target.rotation @ pose.rotation.T), MAX_TURN)
    weight = jnp.concatenate([jnp.ones(3), jnp.full(3, phase.turning)])
    jacobian = weight[:, None] * pose.jacobian
    error = weight * jnp.concatenate([shift, spin])
    both = damped_solve(jacobian, jnp.concatenate([error[:, None], jacobian], axis=1))
    rest = 0.1 * (jnp.asarray(REST, jnp.float32) - angles)
    step = both[:, 0] + rest - both[:, 1:] @ rest
    blocked = ((angles + step > HIGH) & (step > 0)) | ((angles + step < LOW) & (step < 0))
    # Joints at their limits stay there, and the others compensate for them.
    free = damped_solve(jnp.where(blocked, 0.0, jacobian), error[:, None])[:, 0]
    held = jnp.where(blocked, jnp.clip(step, LOW - angles, HIGH - angles), free)
    return jnp.where(jnp.any(blocked), held, step)


def damped_solve(
    jacobian: Float[Array, "6 7"], columns: Float[Array, "6 N"]
) -> Float[Array, "7 N"]:
    """Joint displacements for each column of hand displacements, by damped least squares.

    The damping keeps them small near singularities, where the arm is stretched out.
    """
    return jacobian.T @ jnp.linalg.solve(jacobian @ jacobian.T + DAMPING**2 * jnp.eye(6), columns)


def _shorten(vector: Float[Array, "3"], longest: Float[Array, ""] | float) -> Float[Array, "3"]:
    return vector * jnp.minimum(1.0, longest / (jnp.linalg.norm(vector) + 1e-9))
