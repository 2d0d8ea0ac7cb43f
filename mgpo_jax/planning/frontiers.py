"""Exploration: random goals outside of the map, which draw the agent into unknown parts of the world, and
frontiers, states from which the task goal could be reached sooner than by any known path."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mgpo_jax.optimizers.base import SearchSpace
from mgpo_jax.planning.table import FAR, UNKNOWN, Table, find_state, steps_from, way_to
from mgpo_jax.prompts import Prompt, sample_prompt, single_goal

NUM_DRAWN = 32
"""Number of random goals of which one outside of the map is kept."""
# The cost of a frontier, in steps, beyond the estimated length of a path through it: for every time that it
# was chosen before, for every visit (up to ``MOST_VISITS``), and the scale of a random term.
COST_OF_CHOICE, COST_OF_VISIT, MOST_VISITS, CHANCE = 2.0, 0.15, 20, 0.7


def prompt_elsewhere(
    key: PRNGKeyArray, space: SearchSpace, table: Table, task_goal: Float[Array, "G"]
) -> Prompt:
    """A prompt of two goals: a random one that was not reached yet, and the task goal.

    If all of ``NUM_DRAWN`` random goals were reached before, the first of them is used. There must be room
    for two goals.
    """
    drawn = jax.vmap(space.sample_goal)(jax.random.split(key, NUM_DRAWN))
    reached = jax.vmap(lambda goal: find_state(table, goal) != UNKNOWN)(drawn)
    return followed_by(single_goal(drawn[jnp.argmin(reached)], space.num_slots - 1), task_goal)


def followed_by(prompt: Prompt, task_goal: Float[Array, "G"]) -> Prompt:
    """A prompt with one slot more, whose last goal is the task goal."""
    goals = jnp.concatenate([prompt.goals, task_goal[None]])
    return Prompt(goals, jnp.append(prompt.mask, True))


def choose_frontier(
    key: PRNGKeyArray,
    table: Table,
    start: Int[Array, ""],
    task_goal: Float[Array, "G"],
    choices: Int[Array, "N"],
    known: Int[Array, ""],
) -> Int[Array, ""]:
    """Choose the frontier through which the task goal may be nearest: a state with untried actions.

    The number of steps from a state to the task goal is bounded from below by the distance between their
    goals, divided by the largest change of the goal in one step so far.

    Args:
      key: random key.
      table: the map of the task.
      start: the state in which episodes start.
      task_goal: g^M.
      choices: how often each state was chosen before.
      known: number of steps of the shortest known path to the task goal.

    Returns:
      The index of a state.
    """
    steps = steps_from(table, start)
    away = jnp.sum(jnp.abs(table.goals - task_goal), axis=-1)
    at_least = jnp.ceil(away / jnp.maximum(table.stride, 1e-6) - 1e-3)
    over = steps + at_least
    seen = steps < FAR
    open_ = seen & jnp.any(table.successors == UNKNOWN, axis=-1)
    sooner = open_ & (over < known)
    allowed = jnp.where(jnp.any(sooner), sooner, jnp.where(jnp.any(open_), open_, seen))
    cost = (
        over
        + COST_OF_CHOICE * choices
        + COST_OF_VISIT * jnp.minimum(table.visits, MOST_VISITS)
        + CHANCE * jax.random.gumbel(key, over.shape)
    )
    return jnp.argmin(jnp.where(allowed, cost, jnp.inf))


def prompt_over(
    key: PRNGKeyArray,
    space: SearchSpace,
    table: Table,
    start: Int[Array, ""],
    over: Int[Array, ""],
    task_goal: Float[Array, "G"],
) -> Prompt:
    """A prompt that leads to the task goal by way of the state ``over``.

    It holds random goals of a shortest path to that state, the state's own goal, and the task goal. There
    must be room for two goals.
    """
    key_way, key_prompt = jax.random.split(key)
    way = way_to(key_way, table, start, over, space.horizon)
    goal = table.goals[over]
    to = sample_prompt(key_prompt, way.goals, goal, space.num_slots - 1, space.longest - 1)
    return followed_by(to, task_goal)
