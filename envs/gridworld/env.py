"""GridWorld: switch on objects in an order that the task goal does not reveal.

Source: paper, appendix C.3; sizes, places and the reward rule are those of the authors' code. Rows are
counted downwards, columns to the right; north is row - 1. The observation is ``(state of each of the 7
objects, row, column)``, unscaled. The task goal is the set of objects; a goal is the one object that was
just switched on.
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

from envs.base import Environment, TimeStep
from envs.specs import ArraySpec, Discrete, EnvSpec

WEST, NORTH, EAST, SOUTH, STAY, FLIP = range(6)
MOVES = ((0, -1), (-1, 0), (0, 1), (1, 0), (0, 0), (0, 0))
SIDE = 10
OBJECTS = ((9, 1), (8, 4), (1, 9), (3, 7), (3, 9), (6, 1), (8, 6))
NUM_OBJECTS = len(OBJECTS)
LETTERS = "ABCDEFG"  # names of the objects
MIN_SUBTASKS = 3
NONE = -1  # padding of orders with fewer than 7 objects


class GridTask(NamedTuple):
    """Which objects to switch on, and in which order."""

    order: Int[Array, "*batch O"]
    """Indices into ``OBJECTS``, padded with ``NONE`` to 7 places."""


class GridState(NamedTuple):
    """An episode in progress."""

    task: GridTask
    position: Int[Array, "2"]
    is_on: Bool[Array, "O"]
    was_on: Bool[Array, "O"]
    """Which objects have been switched on at least once."""
    newly_on: Bool[Array, "O"]
    """Which object, if any, the last step switched on for the first time."""
    num_solved: Int[Array, ""]
    """Number of subtasks completed in order."""
    steps: Int[Array, ""]
    done: Bool[Array, ""]


@dataclass(frozen=True)
class GridWorld(Environment):
    """The object-switching world."""

    name: str
    horizon: int

    @property
    def spec(self) -> EnvSpec:
        return EnvSpec(
            name=self.name,
            obs=ArraySpec((NUM_OBJECTS + 2,)),
            goal_dim=NUM_OBJECTS,
            actions=Discrete(len(MOVES)),
            horizon=self.horizon,
            return_range=(0.0, 1.0),
            deterministic=False,
            reward_confirms_goals=True,
        )

    @property
    def num_tasks(self) -> int:
        return len(_all_orders())

    def sample_task(self, key: PRNGKeyArray) -> GridTask:
        """One of the 13,650 ordered tasks, uniformly (so most have 6 or 7 objects)."""
        return self.task(jax.random.randint(key, (), 0, self.num_tasks))

    def task(self, index: Int[Array, ""]) -> GridTask:
        """The task with an index in a fixed enumeration, shorter ones first, which repeats endlessly."""
        return GridTask(order=jnp.asarray(_all_orders())[index % self.num_tasks])

    def sample_goal(self, key: PRNGKeyArray) -> Float[Array, "G"]:
        return jax.nn.one_hot(jax.random.randint(key, (), 0, NUM_OBJECTS), NUM_OBJECTS)

    @property
    def goal_set(self) -> np.ndarray:
        """One goal for each object."""
        return np.eye(NUM_OBJECTS, dtype=np.float32)

    def expert_goal(self, state: GridState, num_steps: int) -> Float[Array, "G"]:
        """The next object of the order, or the last one."""
        del num_steps
        last = jnp.sum(state.task.order != NONE) - 1
        return jax.nn.one_hot(state.task.order[jnp.minimum(state.num_solved, last)], NUM_OBJECTS)

    def task_goal(self, task: GridTask) -> Float[Array, "G"]:
        """The set of objects as a multi-hot vector; their order stays hidden."""
        return jax.nn.one_hot(task.order, NUM_OBJECTS).sum(axis=0)

    def optimal_return(self, task: GridTask) -> Float[Array, ""]:
        """1: all subtasks in order fit into the horizon from every start."""
        del task
        return jnp.ones(())

    def solvable(self, task: GridTask) -> Bool[Array, ""]:
        """Whether the order fits into the horizon from the best start, which is the order's first
        object."""
        return self._fewest_steps(task) <= self.horizon

    def _fewest_steps(self, task: GridTask) -> Int[Array, ""]:
        """Steps from the first object on: the walk to each next object, and a flip of each."""
        places = jnp.asarray(OBJECTS)[task.order]
        ways = jnp.abs(places[1:] - places[:-1]).sum(axis=1)
        real = task.order != NONE
        return jnp.sum(jnp.where(real[1:], ways, 0)) + jnp.sum(real)

    def num_parts(self, task: GridTask) -> Int[Array, ""]:
        """The number of objects in the task."""
        return jnp.sum(task.order != NONE)

    def fingerprint(self, task: GridTask) -> Int[Array, "F"]:
        """The order: a test order must not occur in training."""
        return task.order

    def check_task(self, tasks: GridTask) -> None:
        order = np.asarray(tasks.order)
        if order.ndim != 2 or order.shape[1] != NUM_OBJECTS:
            raise ValueError(
                f"order must have shape [N, {NUM_OBJECTS}] (filled up with {NONE}), "
                f"found {list(order.shape)}"
            )
        super().check_task(tasks)
        if order.min() < NONE or order.max() >= NUM_OBJECTS:
            raise ValueError(f"order must hold objects 0..{NUM_OBJECTS - 1}, or {NONE} at the end")
        for index, row in enumerate(order):
            objects = row[row != NONE]
            if len(objects) < MIN_SUBTASKS:
                raise ValueError(
                    f"task {index}: {len(objects)} objects, an order has at least {MIN_SUBTASKS}"
                )
            if (row[: len(objects)] == NONE).any():
                raise ValueError(f"task {index}: {NONE} may only fill the end of an order")
            if len(np.unique(objects)) < len(objects):
                raise ValueError(f"task {index}: an object occurs twice in {objects.tolist()}")

    def check_solvable(self, tasks: GridTask) -> None:
        batch = GridTask(jnp.asarray(tasks.order))
        for index, steps in enumerate(jax.jit(jax.vmap(self._fewest_steps))(batch).tolist()):
            if steps > self.horizon:
                raise ValueError(
                    f"task {index}: the order takes at least {steps} steps, an episode of {self.name} "
                    f"has {self.horizon}"
                )

    def reset(self, key: PRNGKeyArray, task: GridTask) -> tuple[GridState, TimeStep]:
        """All objects off, the agent on a random cell."""
        none, zero = jnp.zeros(NUM_OBJECTS, bool), jnp.zeros((), jnp.int32)
        state = GridState(
            task=task,
            position=jax.random.randint(key, (2,), 0, SIDE),
            is_on=none,
            was_on=none,
            newly_on=none,
            num_solved=zero,
            steps=zero,
            done=jnp.zeros((), bool),
        )
        return state, self._observe(state, reward=jnp.zeros(()), complete=jnp.zeros((), bool))

    def step(self, state: GridState, action: Int[Array, ""]) -> tuple[GridState, TimeStep]:
        here = jnp.all(state.position == jnp.asarray(OBJECTS), axis=1)
        flipped = here & (action == FLIP)
        is_on = state.is_on ^ flipped
        newly_on = flipped & ~state.was_on

        order, num_solved = state.task.order, state.num_solved
        num_subtasks = jnp.sum(order != NONE)
        place = jnp.arange(NUM_OBJECTS)
        # The reward is paid when the solved objects and the next one are on, and none of the task's later
        # objects is.
        in_order = jnp.all((is_on[order] == (place <= num_solved)) | (place >= num_subtasks))
        num_solved += in_order
        steps = state.steps + 1
        complete = num_solved >= num_subtasks
        after = GridState(
            task=state.task,
            position=jnp.clip(state.position + jnp.asarray(MOVES)[action], 0, SIDE - 1),
            is_on=is_on,
            was_on=state.was_on | newly_on,
            newly_on=newly_on,
            num_solved=num_solved,
            steps=steps,
            done=complete | (steps >= self.horizon),
        )
        after = jax.tree.map(lambda old, new: jnp.where(state.done, old, new), state, after)
        reward = jnp.where(in_order & ~state.done, 1.0 / num_subtasks, 0.0)
        return after, self._observe(after, reward, after.num_solved >= num_subtasks)

    def _observe(
        self, state: GridState, reward: Float[Array, ""], complete: Bool[Array, ""]
    ) -> TimeStep:
        return TimeStep(
            obs=jnp.concatenate([state.is_on, state.position]).astype(jnp.float32),
            achieved_goal=state.newly_on.astype(jnp.float32),
            goal_reached=jnp.any(state.newly_on),
            outcome=state.was_on.astype(jnp.float32),
            reward=reward,
            terminated=complete,
            truncated=(state.steps >= self.horizon) & ~complete,
        )


@cache
def _all_orders() -> np.ndarray:
    """All ordered tasks of 3 to 7 distinct objects, ``[13650, 7]``."""
    rows = [
        order + (NONE,) * (NUM_OBJECTS - length)
        for length in range(MIN_SUBTASKS, NUM_OBJECTS + 1)
        for order in permutations(range(NUM_OBJECTS), length)
    ]
    return np.array(rows, np.int32)
