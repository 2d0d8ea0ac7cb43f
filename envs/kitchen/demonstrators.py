"""The demonstrator of the kitchen: a scripted arm that knows the order.

The paper trains one policy for each subtask with PPO and chains them (appendix C.2; neither the policies
nor their data are public). Here every subtask is a short list of phases: move the arm to a pose in front of
the object, approach, act along the arc of the object's joint, let go, retreat. Actions come from damped
least squares on the arm's Jacobian, to which the torques against gravity are added. A phase ends early when
the hand has lost its object, and a subtask that is not complete after its last phase starts again. Gaussian
noise on all nine actions spreads the data. Without it some joints would follow the same path in every
demonstration, and a policy would learn to rely on differences in their positions that are too small to
matter.

The phases are in ``envs.kitchen.phases``; here is what carries them out.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import Agent, Demonstrator, Episode, Task, TimeStep, Trajectory
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
NOISE = 0.08  # standard deviation on the actions of arm and fingers

# Angles of the seven joints, rad. The limits are a little inside of the joints' ranges and of the bounds of
# the actuators' targets.
LOW = np.array([-2.85, -1.755, -2.85, -3.02, -2.85, 0.02, -2.85])
HIGH = np.array([2.85, 1.72, 2.85, -0.45, 2.85, 2.09, 2.85])
# Six joints would do for a pose of the hand. What the seventh leaves free leads towards these angles.
REST = np.array([0.148, -1.5, 1.7, -2.3, 0.3, 0.8, 1.6])
DAMPING = 0.03
MAX_TURN = 0.25  # rad in a step

# Of the joint that each subtask moves: its place in the 30 positions of the scene, the body that it moves,
# the sign of the motion, and whether it slides or turns.
JOINTS = (11, 17, 19, 21, 22)
BODIES = ("knob 2", "lightswitchroot", "slidelink", "hingerightdoor", "microdoorroot")
SIGNS = (-1.0, -1.0, 1.0, 1.0, -1.0)
SLIDES = (False, False, True, False, False)


class Scene(NamedTuple):
    """Where the moving bodies are, in the world."""

    positions: Float[np.ndarray, "S 3"]
    rotations: Float[np.ndarray, "S 3 3"]
    """At joint position 0; joints turn about their z axis or slide along their x axis."""


class Robot(NamedTuple):
    """Constants that the demonstrator of one model computes with."""

    scene: Scene
    arm: Arm
    stiffness: Float[np.ndarray, "7"]
    """Of the position actuators of the joints, N m / rad."""
    reach: Float[np.ndarray, "7"]
    """How far a joint gets in a control step, as a part of the way to its actuator's target."""


class Sight(NamedTuple):
    """What the demonstrator sees at a step."""

    positions: Float[Array, "30"]
    """Of the full scene."""
    pose: Pose

    @property
    def angles(self) -> Float[Array, "7"]:
        """Of the joints of the arm."""
        return self.positions[:NUM_JOINTS]

    @property
    def fingers(self) -> Float[Array, "2"]:
        return self.positions[NUM_JOINTS:NUM_ROBOT]

    def joint(self, subtask: Int[Array, ""]) -> Float[Array, ""]:
        """The joint position of the object that a subtask moves."""
        return self.positions[jnp.asarray(JOINTS)[subtask]]


class Target(NamedTuple):
    """Where the tip of the hand should be and how the hand should be held."""

    point: Float[Array, "3"]
    rotation: Float[Array, "3 3"]


class Memory(NamedTuple):
    """Where the demonstrator is in its plan."""

    subtask: Int[Array, ""]
    phase: Int[Array, ""]
    clock: Int[Array, ""]
    """Steps since the phase began."""
    tries: Int[Array, ""]
    """How often it has tried the present subtask before."""


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
        positions=np.array([body.xpos for body in bodies], np.float32),
        rotations=np.array([body.xmat.reshape(3, 3) for body in bodies], np.float32),
    )


@cache
def make_robot(model_name: str) -> Robot:
    """Scene and arm of either model."""
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
    """The demonstrator; ``noise`` is the standard deviation on the nine actions."""
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
    """Those of a kitchen. All go through every ordered task in turn (paper: 300 tasks, 30 episodes each).

    ``expert`` demonstrates in both scenes, with the reduced one's physics drawn for each episode. The
    others demonstrate in one scene as it is, with one engine. A world that names MJX or the stock scene has
    its own one first.
    """
    import_mujoco()  # complains now and not in the middle of a program
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
    """The demonstrator in one world."""

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
    """The demonstrator in a scene that is drawn for each episode. It does not know what was drawn."""
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
    """1: whatever was completed in an episode is a task that the episode solves."""
    del trajectory
    return jnp.ones(())


# The parts of one step: look, see whether the phase is over, advance the plan, act.


def look(robot: Robot, positions: Float[Array, "30"]) -> Sight:
    """What the demonstrator sees when the scene has these positions."""
    return Sight(positions=positions, pose=arm_pose(robot.arm, positions[:NUM_JOINTS]))


def current_phase(plan: Plan, memory: Memory) -> Phase:
    """The row of the plan that the demonstrator is at."""
    return jax.tree.map(
        lambda column: jnp.asarray(column)[memory.subtask, memory.phase], plan.phases
    )


def next_subtask(state: KitchenState) -> Int[Array, ""]:
    """The first subtask of the task that is not solved; the last one when all are."""
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
    """The next phase if the present one is over; after the last phase, the subtask ``following``.

    That is the same subtask again where its phases did not complete it. A subtask's first try starts at
    phase 1; its second, fourth and so on start at the phase in ``RETRY``, the others at phase 0, which
    leads to ``HOME``.
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
    # Actuators act like springs: to make the step within the control period their targets must lie beyond
    # it, and to hold the arm against gravity they must lie above it.
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
    """Where a phase wants the hand, with the joint of the subtask's object at ``joint``."""
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
    """Joint displacements of one step that brings the hand nearer to its target.

    Where the pose of the hand leaves the joints free to move, they move towards ``REST``.
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
    # Joints that are at their limit stay there, and the others make up for them.
    free = damped_solve(jnp.where(blocked, 0.0, jacobian), error[:, None])[:, 0]
    held = jnp.where(blocked, jnp.clip(step, LOW - angles, HIGH - angles), free)
    return jnp.where(jnp.any(blocked), held, step)


def damped_solve(
    jacobian: Float[Array, "6 7"], columns: Float[Array, "6 N"]
) -> Float[Array, "7 N"]:
    """Joint displacements for each column of hand displacements, by damped least squares.

    The damping keeps them small where the arm is stretched out and no displacement would do.
    """
    return jacobian.T @ jnp.linalg.solve(jacobian @ jacobian.T + DAMPING**2 * jnp.eye(6), columns)


def _shorten(vector: Float[Array, "3"], longest: Float[Array, ""] | float) -> Float[Array, "3"]:
    return vector * jnp.minimum(1.0, longest / (jnp.linalg.norm(vector) + 1e-9))
