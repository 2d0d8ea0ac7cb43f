"""A user's own world: nine cells in a line, and two doors to open in a hidden order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mgpo_jax import Agent, ArraySpec, Demonstrator, Discrete, Environment, EnvSpec, TimeStep, World

CELLS, STAY = 9, 1  # action 0 goes to the left, 2 to the right


class Doors(NamedTuple):
    """A task: the cell where a walk starts, and the cells of the two doors in the order to open them."""

    start: Int[Array, "*batch"]
    order: Int[Array, "*batch 2"]


class Walk(NamedTuple):
    """An episode in progress."""

    task: Doors
    cell: Int[Array, ""]
    num_open: Int[Array, ""]
    steps: Int[Array, ""]


@dataclass(frozen=True)
class Line(Environment):
    """A door opens when it is reached in its turn, for a reward of 1/2."""

    @property
    def spec(self) -> EnvSpec:
        return EnvSpec(
            name="line",
            obs=ArraySpec((3, 3), "uint8"),
            goal_dim=CELLS,
            actions=Discrete(3),
            horizon=12,
            return_range=(0.0, 1.0),
        )

    def sample_task(self, key: PRNGKeyArray) -> Doors:
        cells = jax.random.permutation(key, CELLS).astype(jnp.int32)
        return Doors(cells[0], cells[1:3])

    def task_goal(self, task: Doors) -> Float[Array, "G"]:
        return jax.nn.one_hot(task.order, CELLS).sum(axis=0)

    def reset(self, key: PRNGKeyArray, task: Doors) -> tuple[Walk, TimeStep]:
        walk = Walk(task, task.start, num_open=jnp.int32(0), steps=jnp.int32(0))
        return walk, self._look(walk, reward=jnp.zeros(()))

    def step(self, state: Walk, action: Int[Array, ""]) -> tuple[Walk, TimeStep]:
        cell = jnp.clip(state.cell + action - STAY, 0, CELLS - 1)
        opens = cell == state.task.order[jnp.minimum(state.num_open, 1)]
        after = Walk(state.task, cell, state.num_open + opens, state.steps + 1)
        over = (state.num_open == 2) | (state.steps >= self.spec.horizon)
        after = jax.tree.map(lambda old, new: jnp.where(over, old, new), state, after)
        return after, self._look(after, 0.5 * (after.num_open - state.num_open))

    def _look(self, walk: Walk, reward: Array) -> TimeStep:
        done = walk.num_open == 2
        here, doors = jax.nn.one_hot(walk.cell, CELLS), jax.nn.one_hot(walk.task.order, CELLS)
        return TimeStep(
            obs=here.reshape(3, 3).astype(jnp.uint8),
            achieved_goal=here,
            goal_reached=jnp.ones((), bool),
            outcome=(doors * (jnp.arange(2) < walk.num_open)[:, None]).sum(axis=0),
            reward=reward,
            terminated=done,
            truncated=(walk.steps >= self.spec.horizon) & ~done,
        )


def knowing(weights: tuple) -> Agent:
    """An agent that knows the order and walks to the doors."""

    def proceed(key: PRNGKeyArray, memory: tuple, state: Walk, timestep: TimeStep) -> tuple:
        door = state.task.order[jnp.minimum(state.num_open, 1)]
        return STAY + jnp.sign(door - state.cell), jnp.zeros((), bool), memory

    return Agent(lambda key, task, state, timestep: proceed(key, (), state, timestep), proceed)


SHOWN = {"knowing": Demonstrator(lambda key, index: Line().sample_task(key), knowing)}
WORLD = World(
    name="line",
    make=Line,
    summary="open two doors on a line of nine cells in a hidden order",
    demonstrators=lambda env: SHOWN,
    presets={"fast": {"max_prompt_length": 3, "bucket": 12}},
    num_test_tasks=4,
)
UNSHOWN = World(name="line-unshown", make=Line, num_test_tasks=4)
