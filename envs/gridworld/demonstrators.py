"""The demonstrator of GridWorld, which knows the order (paper, appendix C.3).

It walks to the next object of the task and switches it on. If it has to move along both rows and columns,
it chooses the axis at random, as the authors' expert does.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.agents import Agent, Demonstrator
from envs.base import TimeStep, Trajectory
from envs.gridworld.env import (
    EAST,
    FLIP,
    NORTH,
    OBJECTS,
    SOUTH,
    WEST,
    GridState,
    GridTask,
    GridWorld,
)


def switcher() -> Agent:
    """The demonstrator; the episode ends with the last object of the task."""

    def begin(
        key: PRNGKeyArray, task: GridTask, state: GridState, timestep: TimeStep
    ) -> tuple[Array, Array, tuple]:
        del task
        return proceed(key, (), state, timestep)

    def proceed(
        key: PRNGKeyArray, memory: tuple, state: GridState, timestep: TimeStep
    ) -> tuple[Array, Array, tuple]:
        del timestep
        target = jnp.asarray(OBJECTS)[state.task.order[state.num_solved]]
        down, right = target - state.position
        along_column = jnp.where(down > 0, SOUTH, NORTH)
        along_row = jnp.where(right > 0, EAST, WEST)
        vertical = (right == 0) | ((down != 0) & jax.random.bernoulli(key))
        move = jnp.where(vertical, along_column, along_row)
        action = jnp.where((down == 0) & (right == 0), FLIP, move)
        return action, jnp.zeros((), bool), memory

    return Agent(begin=begin, proceed=proceed)


def grid_demonstrators(env: GridWorld) -> dict[str, Demonstrator]:
    """The dataset of the paper: every ordered task in turn."""

    def task_in_turn(key: PRNGKeyArray, index: Int[Array, ""]) -> GridTask:
        del key
        return env.task(index)

    expert = Demonstrator(
        sample_task=task_in_turn,
        agent=lambda weights: switcher(),
        hindsight_return=perfect_return,
    )
    return {"expert": expert}


def perfect_return(trajectory: Trajectory) -> Float[Array, ""]:
    """The return in hindsight: always 1, since the objects that were switched on are a task that it
    solves."""
    del trajectory
    return jnp.ones(())
