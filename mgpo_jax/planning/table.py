"""The map of one task: a table of the states seen so far and of the transitions between them.

A state is identified by the goal that is reached in it, in worlds where goals determine states
(``EnvSpec.goals_are_states``). The table has a fixed capacity. Once it is full, further states are ignored,
and actions that lead to them count as unknown. All functions are for one task.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from envs.base import Episode, Goals
from envs.specs import EnvSpec

UNKNOWN = -1
"""Index of an unknown state: the result of an untried action, and the padding after the end of a path."""
FAR = 1_000_000
"""Number of steps to a state that no known path leads to."""
SAME = 1e-4  # goals whose components all differ by less are the same


class Table(NamedTuple):
    """A table of N rows for states, of which the first ``size`` are in use."""

    goals: Float[Array, "N G"]
    """The goal that is reached in each state."""
    obs: Shaped[Array, "N ..."]
    """The observation in each state, from the first visit."""
    successors: Int[Array, "N A"]
    """The state that each action led to when it was last taken; ``UNKNOWN`` if it was never taken."""
    visits: Int[Array, "N"]
    """Number of visits to each state."""
    size: Int[Array, ""]
    stride: Float[Array, ""]
    """The largest change of the goal in one step so far, as a sum over its components."""


def empty_table(spec: EnvSpec, num_states: int) -> Table:
    """The table before the first episode in a world with discrete actions."""
    return Table(
        goals=jnp.zeros((num_states, spec.goal_dim)),
        obs=jnp.zeros((num_states, *spec.obs.shape), spec.obs.dtype),
        successors=jnp.full((num_states, spec.action_dim), UNKNOWN),
        visits=jnp.zeros(num_states, jnp.int32),
        size=jnp.int32(0),
        stride=jnp.float32(0),
    )


def forgotten(table: Table) -> Table:
    """An empty table with the same shapes."""
    blank = jax.tree.map(jnp.zeros_like, table)
    return blank._replace(successors=jnp.full_like(table.successors, UNKNOWN))


def find_state(table: Table, goal: Float[Array, "G"]) -> Int[Array, ""]:
    """The state in which a goal is reached; ``UNKNOWN`` if it is not in the table."""
    near = jnp.max(jnp.abs(table.goals - goal), axis=-1) < SAME
    near &= jnp.arange(len(table.goals)) < table.size
    return jnp.where(jnp.any(near), jnp.argmax(near), UNKNOWN)


def add_episode(table: Table, episode: Episode) -> tuple[Table, Int[Array, ""]]:
    """Add all steps of an episode to the table; also returns the state in which it started."""
    steps = episode.trajectory

    def visit(table: Table, goal: Array, obs: Array) -> tuple[Table, Int[Array, ""]]:
        found = find_state(table, goal)
        is_new = (found == UNKNOWN) & (table.size < len(table.goals))
        row = jnp.where(found == UNKNOWN, jnp.where(is_new, table.size, len(table.goals)), found)
        table = table._replace(
            goals=table.goals.at[row].set(goal, mode="drop"),
            obs=table.obs.at[jnp.where(is_new, row, len(table.goals))].set(obs, mode="drop"),
            visits=table.visits.at[row].add(1, mode="drop"),
            size=table.size + is_new,
        )
        return table, row

    def step(time: Array, carry: tuple[Table, Array, Array]) -> tuple[Table, Array, Array]:
        table, before, goal_before = carry
        goal = steps.achieved_goals[time]
        after_last = time + 1 >= steps.length
        next_obs = steps.obs[jnp.minimum(time + 1, len(steps.obs) - 1)]
        table, row = visit(table, goal, jnp.where(after_last, episode.last_obs, next_obs))
        known = jnp.where(row < len(table.goals), row, UNKNOWN)
        successors = table.successors.at[before, steps.actions[time]].set(known, mode="drop")
        stride = jnp.maximum(table.stride, jnp.sum(jnp.abs(goal - goal_before)))
        return table._replace(successors=successors, stride=stride), row, goal

    first_goal = jnp.asarray(episode.first_goal)
    table, start = visit(table, first_goal, steps.obs[0])
    first = (table, start, first_goal)
    table, _, _ = jax.lax.fori_loop(0, steps.length, step, first)
    return table, jnp.where(start < len(table.goals), start, UNKNOWN)


def steps_to(table: Table, state: Int[Array, ""]) -> Int[Array, "N"]:
    """The length of the shortest known path from each state to ``state``; ``FAR`` if there is none.

    If ``state`` is ``UNKNOWN``, no path leads to it.
    """

    def relax(distance: Array) -> Array:
        after = jnp.where(table.successors == UNKNOWN, FAR, distance[table.successors])
        return jnp.minimum(distance, 1 + jnp.min(after, axis=-1)).clip(max=FAR)

    return _fixed_point(relax, _all_far(table).at[_row_or_none(table, state)].set(0, mode="drop"))


def steps_from(table: Table, state: Int[Array, ""]) -> Int[Array, "N"]:
    """The length of the shortest known path from ``state`` to each state; ``FAR`` if there is none."""
    to = jnp.where(table.successors == UNKNOWN, len(table.goals), table.successors)

    def relax(distance: Array) -> Array:
        reached = jnp.broadcast_to(1 + distance[:, None], to.shape)
        return distance.at[to].min(reached, mode="drop")

    return _fixed_point(relax, _all_far(table).at[_row_or_none(table, state)].set(0, mode="drop"))


def _all_far(table: Table) -> Int[Array, "N"]:
    """The distance ``FAR`` for every state."""
    return jnp.full(len(table.goals), FAR)


def _row_or_none(table: Table, state: Int[Array, ""]) -> Int[Array, ""]:
    """The row of a state; for ``UNKNOWN`` one past the end, to which writes are dropped."""
    return jnp.where(state == UNKNOWN, len(table.goals), state)


def _fixed_point(relax: Callable[[Array], Array], distance: Int[Array, "N"]) -> Int[Array, "N"]:
    """Apply ``relax`` until it changes no distance any more."""
    first = (distance, jnp.ones((), bool))

    def again(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        shorter = relax(carry[0])
        return shorter, jnp.any(shorter != carry[0])

    return jax.lax.while_loop(lambda carry: carry[1], again, first)[0]


def shortest_way(
    key: PRNGKeyArray,
    table: Table,
    start: Int[Array, ""],
    left: Int[Array, "N"],
    longest: int,
) -> Int[Array, "L"]:
    """The states after ``start`` on a shortest known path; if there are several, on a random one.

    Args:
      key: random key.
      table: the map of the task.
      start: the state in which the path starts.
      left: ``steps_to`` the state in which the path ends.
      longest: L, the capacity for the path in steps. A longer path is cut off.

    Returns:
      The indices of the states, followed by ``UNKNOWN``.
    """

    def walk(state: Array, key: PRNGKeyArray) -> tuple[Array, Array]:
        after = table.successors[state]
        closer = (after != UNKNOWN) & (left[after] < left[state]) & (left[state] < FAR)
        pick = jnp.argmax(jnp.where(closer, jax.random.uniform(key, after.shape), -1.0))
        has_next = (state != UNKNOWN) & jnp.any(closer)
        state = jnp.where(has_next, after[pick], UNKNOWN)
        return state, state

    return jax.lax.scan(walk, start, jax.random.split(key, longest))[1]


class Way(NamedTuple):
    """A shortest known path from one state to another."""

    start: Int[Array, ""]
    end: Int[Array, ""]
    """The state at the end; ``UNKNOWN`` for one that is not in the table."""
    left: Int[Array, "N"]
    """The number of known steps from each state to the end (``steps_to``)."""
    states: Int[Array, "L"]
    """The states after ``start``, followed by ``UNKNOWN``."""
    goals: Goals
    """The goals that are reached on the path, including the one at its end."""

    @property
    def steps(self) -> Int[Array, ""]:
        """The number of steps of the path; ``FAR`` if no path is known."""
        unknown = (self.start == UNKNOWN) | (self.end == UNKNOWN)
        return jnp.where(unknown, FAR, self.left[self.start])


def way_to(
    key: PRNGKeyArray, table: Table, start: Int[Array, ""], end: Int[Array, ""], longest: int
) -> Way:
    """A shortest known path between two states; if there are several, a random one (``shortest_way``)."""
    left = steps_to(table, end)
    states = shortest_way(key, table, start, left, longest)
    return Way(start, end, left, states, goals_on(table, states))


def goals_on(table: Table, way: Int[Array, "L"]) -> Goals:
    """The goals that are reached on a path, including its end, as a record that prompts can be drawn
    from."""
    on_way = way != UNKNOWN
    goals = jnp.where(on_way[:, None], table.goals[way], 0.0)
    return Goals(goals, on_way, goals, on_way.sum())
