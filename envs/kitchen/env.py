"""The kitchen: complete subtasks in an order that the task goal does not reveal.

Source: paper, section 4.1 and appendix C.2. The scene, the 59-dimensional observation, the 9 velocity
actions and the criterion for a completed subtask are those of gymnasium-robotics' FrankaKitchen without
observation noise, as in the authors' code. So is the reward rule: 1/n when the next subtask of the task is
complete and no later one is. A subtask that was completed once stays completed even if its joint moves
back, so completing a subtask too early prevents all further reward. The task goal is the set of subtasks; a
goal is the one subtask that was just completed.

Observation: 9 positions and 9 velocities of arm and fingers, 21 positions and 20 velocities of the objects
(rad, m, rad/s, m/s). An action in [-1, 1] sets the targets of the joint actuators to at most 0.16 rad or m
from the current joint positions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import permutations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import Environment, State, Task, TimeStep
from envs.kitchen.engines import BACKENDS, load_physics, resolve_backend
from envs.kitchen.physics import MODELS, NUM_ROBOT, Physics
from envs.specs import ArraySpec, Box, Engine, EnvSpec

SUBTASKS = ("bottom burner", "light switch", "slide cabinet", "hinge cabinet", "microwave")
NUM_SUBTASKS = len(SUBTASKS)
NONE = -1  # padding of orders with fewer than 5 subtasks

# The joint positions of the full scene that define each subtask, by index, and their targets
# (gymnasium-robotics, OBS_ELEMENT_INDICES and OBS_ELEMENT_GOALS).
TARGETS = (
    {11: -0.88, 12: -0.01},
    {17: -0.69, 18: -0.05},
    {19: 0.37},
    {20: 0.0, 21: 1.45},
    {22: -0.75},
)
THRESHOLD = 0.3
NUM_POSITIONS, OBS_DIM = 30, 59
# Their indices in an observation: positions and velocities of the robot, then of the objects.
POSITIONS, VELOCITIES = np.r_[:9, 18:39], np.r_[9:18, 39:59]

# Up to jax 0.10 the fusion emitters of XLA's CPU backend slow MJX's batched graph down by a factor of
# hundreds. Since 0.11 they cannot be switched off, and the graph is half as fast as without them.
MJX_ON_CPU = (("xla_cpu_use_fusion_emitters", False),) if jax.__version_info__ < (0, 11) else ()
# Smallest efficient batch. Below it the overhead of a call into C MuJoCo dominates, and MJX does not fill
# the vector units.
WORLDS_TOGETHER = 8
MAX_SPEED = 1e3  # largest speed of a joint; beyond it the physics has diverged


class KitchenTask(NamedTuple):
    """Which subtasks to complete, and in which order."""

    order: Int[Array, "*batch S"]
    """Indices into ``SUBTASKS``, padded with ``NONE`` to 5 places."""


class KitchenState(NamedTuple):
    """An episode in progress."""

    task: Task
    """A ``KitchenTask``, or another task with an ``order``."""
    physics: State
    """The state of the engine, with positions ``qpos`` and velocities ``qvel``."""
    completed: Bool[Array, "S"]
    """Which subtasks have been completed at least once."""
    newly: Bool[Array, "S"]
    """Which subtask, if any, the last step completed for the first time."""
    num_solved: Int[Array, ""]
    """Number of subtasks completed in order."""
    steps: Int[Array, ""]
    failed: Bool[Array, ""]
    """Whether the physics diverged or an action was not finite; ``physics`` is then the state before that
    step."""
    done: Bool[Array, ""]


@dataclass(frozen=True)
class Kitchen(Environment):
    """The kitchen world.

    Attributes:
      name: its name in messages and file names.
      horizon: number of steps after which an episode is truncated (paper: 500).
      backend: ``native`` (C MuJoCo on threads), ``mjx`` (JAX), or ``auto`` (MJX on accelerators).
      model: ``reduced``, or ``stock`` for the unmodified scene of gymnasium-robotics (native only).
    """

    name: str
    horizon: int
    backend: str = "auto"
    model: str = "reduced"

    def __post_init__(self) -> None:
        if self.backend not in BACKENDS:
            raise ValueError(
                f"backend must be one of {', '.join(BACKENDS)}, found {self.backend!r}"
            )
        if self.model not in MODELS:
            raise ValueError(f"model must be {' or '.join(MODELS)}, found {self.model!r}")
        if self.backend == "mjx" and self.model == "stock":
            raise ValueError(
                "MJX has no collisions of cylinders with meshes and boxes, which the stock model "
                "needs: use backend native"
            )

    @property
    def spec(self) -> EnvSpec:
        return EnvSpec(
            name=self.name,
            obs=ArraySpec((OBS_DIM,)),
            goal_dim=NUM_SUBTASKS,
            actions=Box(NUM_ROBOT),
            horizon=self.horizon,
            return_range=(0.0, 1.0),
            reward_confirms_goals=True,
        )

    @property
    def engine(self) -> Engine:
        mjx_on_cpu = self.backend == "mjx" and jax.default_backend() == "cpu"
        return Engine(
            worlds_together=WORLDS_TOGETHER, compiler_options=MJX_ON_CPU if mjx_on_cpu else ()
        )

    @property
    def physics(self) -> Physics:
        return load_physics(resolve_backend(self.backend, self.model), self.model)

    @property
    def num_tasks(self) -> int:
        return len(_all_orders())

    def sample_task(self, key: PRNGKeyArray) -> Task:
        """One of the 325 ordered tasks, uniformly (so most have 4 or 5 subtasks)."""
        return self.task(jax.random.randint(key, (), 0, self.num_tasks))

    def task(self, index: Int[Array, ""]) -> KitchenTask:
        """The task with an index in a fixed enumeration, shorter ones first, which repeats endlessly."""
        return KitchenTask(order=jnp.asarray(_all_orders())[index % self.num_tasks])

    def sample_goal(self, key: PRNGKeyArray) -> Float[Array, "G"]:
        return jax.nn.one_hot(jax.random.randint(key, (), 0, NUM_SUBTASKS), NUM_SUBTASKS)

    @property
    def goal_set(self) -> np.ndarray:
        """One goal for each subtask."""
        return np.eye(NUM_SUBTASKS, dtype=np.float32)

    def expert_goal(self, state: KitchenState, num_steps: int) -> Float[Array, "G"]:
        """The next subtask of the order, or the last one."""
        del num_steps
        last = jnp.sum(state.task.order != NONE) - 1
        return jax.nn.one_hot(state.task.order[jnp.minimum(state.num_solved, last)], NUM_SUBTASKS)

    def task_goal(self, task: Task) -> Float[Array, "G"]:
        """The set of subtasks as a multi-hot vector; their order stays hidden."""
        return jax.nn.one_hot(task.order, NUM_SUBTASKS).sum(axis=0)

    def optimal_return(self, task: Task) -> Float[Array, ""]:
        """1: every order fits into the horizon."""
        del task
        return jnp.ones(())

    def num_parts(self, task: Task) -> Int[Array, ""]:
        """The number of subtasks in the task."""
        return jnp.sum(task.order != NONE)

    def fingerprint(self, task: Task) -> Int[Array, "F"]:
        """The order: a test order must not occur in training."""
        return task.order

    def check_task(self, tasks: Task) -> None:
        order = np.asarray(tasks.order)
        if order.ndim != 2 or order.shape[1] != NUM_SUBTASKS:
            raise ValueError(
                f"order must have shape [N, {NUM_SUBTASKS}] (filled up with {NONE}), "
                f"found {list(order.shape)}"
            )
        super().check_task(tasks)
        if order.min() < NONE or order.max() >= NUM_SUBTASKS:
            raise ValueError(
                f"order must hold subtasks 0..{NUM_SUBTASKS - 1}, or {NONE} at the end"
            )
        for index, row in enumerate(order):
            subtasks = row[row != NONE]
            if len(subtasks) == 0:
                raise ValueError(f"task {index}: no subtasks")
            if (row[: len(subtasks)] == NONE).any():
                raise ValueError(f"task {index}: {NONE} may only fill the end of an order")
            if len(np.unique(subtasks)) < len(subtasks):
                raise ValueError(f"task {index}: a subtask occurs twice in {subtasks.tolist()}")

    def reset(self, key: PRNGKeyArray, task: Task) -> tuple[KitchenState, TimeStep]:
        """Begin with the arm in front of the closed kitchen, always in the same state."""
        del key
        none, zero = jnp.zeros(NUM_SUBTASKS, bool), jnp.zeros((), jnp.int32)
        no = jnp.zeros((), bool)
        state = KitchenState(
            task=task,
            physics=self.initial_physics(task),
            completed=none,
            newly=none,
            num_solved=zero,
            steps=zero,
            failed=no,
            done=no,
        )
        return state, self._observe(state, reward=jnp.zeros(()), complete=no)

    def initial_physics(self, task: Task) -> State:
        """The initial physics state of an episode, the same for all tasks."""
        del task
        return jax.tree.map(jnp.asarray, self.physics.initial)

    def step(self, state: KitchenState, action: Float[Array, "9"]) -> tuple[KitchenState, TimeStep]:
        valid = jnp.all(jnp.isfinite(action))
        sound = jnp.where(valid, action, 0.0)
        physics = self.physics.advance(state.physics, sound, valid & ~state.done)
        failed = ~valid | ~_is_sane(physics)
        physics = jax.tree.map(lambda old, new: jnp.where(failed, old, new), state.physics, physics)

        order, num_solved = state.task.order, state.num_solved
        num_subtasks = jnp.sum(order != NONE)
        place = jnp.arange(NUM_SUBTASKS)
        # At most one subtask is completed in a step, so that every goal is a single subtask. If two arrive
        # together, the next one of the task counts now and the other one a step later.
        arrived = self._at_target(physics) & ~state.completed & ~failed
        expected = place == order[jnp.minimum(num_solved, NUM_SUBTASKS - 1)]
        newly = arrived & (place == jnp.argmax(arrived * (1 + expected)))
        completed = state.completed | newly
        # The reward is paid when the solved subtasks and the next one are complete, and none of the task's
        # later subtasks is.
        in_order = jnp.all((completed[order] == (place <= num_solved)) | (place >= num_subtasks))
        num_solved += in_order
        steps = state.steps + 1
        after = KitchenState(
            task=state.task,
            physics=physics,
            completed=completed,
            newly=newly,
            num_solved=num_solved,
            steps=steps,
            failed=failed,
            done=(num_solved >= num_subtasks) | (steps >= self.horizon) | failed,
        )
        after = jax.tree.map(lambda old, new: jnp.where(state.done, old, new), state, after)
        reward = jnp.where(in_order & ~state.done, 1.0 / num_subtasks, 0.0)
        return after, self._observe(after, reward, after.num_solved >= num_subtasks)

    def _at_target(self, physics: State) -> Bool[Array, "S"]:
        """Which subtasks' joints are within the threshold of their targets."""
        counts, targets = _target_table()
        positions = self.physics.positions.expand(physics.qpos)
        distance = jnp.sqrt(jnp.sum(jnp.where(counts, positions - targets, 0.0) ** 2, axis=1))
        return distance < THRESHOLD

    def _observe(
        self, state: KitchenState, reward: Float[Array, ""], complete: Bool[Array, ""]
    ) -> TimeStep:
        positions = self.physics.positions.expand(state.physics.qpos)
        velocities = self.physics.velocities.expand(state.physics.qvel)
        robot, objects = slice(NUM_ROBOT), slice(NUM_ROBOT, None)
        return TimeStep(
            obs=jnp.concatenate(
                [positions[robot], velocities[robot], positions[objects], velocities[objects]]
            ),
            achieved_goal=state.newly.astype(jnp.float32),
            goal_reached=jnp.any(state.newly),
            outcome=state.completed.astype(jnp.float32),
            reward=reward,
            terminated=complete,
            truncated=((state.steps >= self.horizon) | state.failed) & ~complete,
            failed=state.failed,
        )


def _is_sane(physics: State) -> Bool[Array, ""]:
    """Whether a physics step gave finite numbers of a plausible size."""
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in physics]
    return jnp.all(jnp.stack(finite)) & jnp.all(jnp.abs(physics.qvel) < MAX_SPEED)


@cache
def _target_table() -> tuple[np.ndarray, np.ndarray]:
    """Which of the 30 positions define each subtask, and their targets, ``[5, 30]`` each."""
    counts = np.zeros((NUM_SUBTASKS, NUM_POSITIONS), bool)
    targets = np.zeros((NUM_SUBTASKS, NUM_POSITIONS), np.float32)
    for subtask, joints in enumerate(TARGETS):
        for index, target in joints.items():
            counts[subtask, index], targets[subtask, index] = True, target
    return counts, targets


@cache
def _all_orders() -> np.ndarray:
    """All ordered tasks of 1 to 5 distinct subtasks, ``[325, 5]``."""
    rows = [
        order + (NONE,) * (NUM_SUBTASKS - length)
        for length in range(1, NUM_SUBTASKS + 1)
        for order in permutations(range(NUM_SUBTASKS), length)
    ]
    return np.array(rows, np.int32)
