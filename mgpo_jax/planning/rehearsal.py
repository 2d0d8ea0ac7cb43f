"""Rehearsals: the frozen policy tries prompts in the table of known states, without a real episode.

In a deterministic world a rehearsal that visits only known states is exactly what an episode would be. If
it takes an action whose result is unknown, it tells how far it came.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from envs.base import Environment, TimeStep
from envs.specs import EnvSpec
from mgpo_jax.planning.table import FAR, UNKNOWN, Table
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import Prompt
from mgpo_jax.rollout import Query, rollout

HOPE = 2
"""Assumed cost, in steps, of an action whose result is unknown, beyond the known number of remaining
steps."""
TOGETHER = 8  # rehearsals that run in one batch: their KV caches fit into the cache of a CPU core
_UNREACHED = 256  # smallest number of steps that states without a known way to the goal count as
# A rank packs three numbers in base 1024, most significant first: the expected steps, the steps left at the
# best moment, and for how long the rehearsal kept to a shortest path.
_DIGITS = 1024
UNRANKED = jnp.iinfo(jnp.int32).max
"""The rank of a prompt that was not rehearsed, which is worse than all others."""

ARRIVES, LEAVES, FAILS = range(3)


class Ahead(NamedTuple):
    """The task of a rehearsal: to reach a state in the table of known states."""

    table: Table
    start: Int[Array, ""]
    goal: Int[Array, ""]
    left: Int[Array, "N"]
    """The fewest known steps from each state to the goal (``table.steps_to``)."""
    limit: Int[Array, ""]
    """Largest total number of steps: a rehearsal ends once no known path reaches the goal within it."""


class Place(NamedTuple):
    """The state of a rehearsal in progress."""

    ahead: Ahead
    state: Int[Array, ""]
    """The current state; ``UNKNOWN`` after an action whose result is unknown."""
    steps: Int[Array, ""]


@dataclass(frozen=True)
class Seen(Environment):
    """The environment in which rehearsals run: the known part of a world.

    Its tasks are of the type ``Ahead``, and its goals are indices of states.

    Attributes:
      world: the specification of the real world.
      longest: the horizon of a rehearsal, in steps.
    """

    world: EnvSpec
    longest: int

    @property
    def spec(self) -> EnvSpec:
        return replace(self.world, horizon=self.longest, goal_dim=1, layout=None)

    def reset(self, key: Array, task: Ahead) -> tuple[Place, TimeStep]:
        del key
        place = Place(task, task.start, jnp.int32(0))
        return place, self._timestep(place)

    def step(self, state: Place, action: Array) -> tuple[Place, TimeStep]:
        known = state.ahead.table.successors[state.state, action]
        after = jnp.where(state.state == UNKNOWN, UNKNOWN, known)
        place = Place(state.ahead, after, state.steps + 1)
        return place, self._timestep(place)

    def _timestep(self, place: Place) -> TimeStep:
        ahead = place.ahead
        number = place.state[None].astype(jnp.float32)
        return TimeStep(
            obs=ahead.table.obs[place.state],
            achieved_goal=number,
            goal_reached=jnp.ones((), bool),
            outcome=number,
            reward=jnp.zeros(()),
            terminated=(place.state == UNKNOWN) | (place.state == ahead.goal),
            truncated=place.steps + ahead.left[place.state] > ahead.limit,
        )


class Rehearsal(NamedTuple):
    """The results of rehearsing C prompts."""

    ends: Int[Array, "*C"]
    """How it ended: ``ARRIVES`` at the goal, ``LEAVES`` the known states, or ``FAILS``."""
    steps: Int[Array, "*C"]
    """Steps to the goal: exact if it arrives, an optimistic estimate if it leaves the known states, ``FAR``
    if it fails."""
    rank: Int[Array, "*C"]
    """Sort key, lower is better: first ``steps``; then the steps left to the goal at the best moment, where
    every wasted step counts as one more; then ``strays``."""
    strays: Int[Array, "*C"]
    """Number of steps before it first strayed from the shortest paths."""
    farthest: Int[Array, "*C"]
    """Progress at the best moment: how many steps closer to the goal it was than at the start."""


def not_rehearsed(num: int) -> Rehearsal:
    """The entries of prompts [num] that were not rehearsed."""
    blank = (FAILS, FAR, UNRANKED, 0, 0)
    return Rehearsal(*(jnp.full(num, value, jnp.int32) for value in blank))


def rehearse(
    world: Seen,
    policy: Policy,
    ahead: Ahead,
    prompts: Prompt,
    wanted: int | Int[Array, ""] | None = None,
) -> Rehearsal:
    """Rehearse prompts with greedy actions.

    Args:
      world: the known part of the world.
      policy: the policy that acts.
      ahead: the task.
      prompts: C prompts.
      wanted: how many of the prompts are rehearsed, beginning with the first one; None means all.

    Returns:
      The results of all C prompts. Those that were not rehearsed have the rank ``UNRANKED``.
    """
    num = len(prompts.mask)
    wanted = num if wanted is None else wanted
    greedy = jnp.ones((), bool)

    def run(prompt: Prompt) -> Rehearsal:
        episode = rollout(jax.random.key(0), world, policy, ahead, Query(prompt, greedy))
        steps = episode.trajectory
        return _result(steps.achieved_goals[:, 0].astype(jnp.int32), steps.length, ahead)

    def run_batch(index: Array, results: Rehearsal) -> Rehearsal:
        rows = index * TOGETHER + jnp.arange(TOGETHER)
        batch = jax.tree.map(lambda leaf: leaf[jnp.minimum(rows, num - 1)], prompts)
        return jax.tree.map(lambda all_, new: all_.at[rows].set(new), results, jax.vmap(run)(batch))

    results = not_rehearsed(-(-num // TOGETHER) * TOGETHER)
    results = jax.lax.fori_loop(0, -(-wanted // TOGETHER), run_batch, results)
    rehearsed = jnp.arange(num) < wanted
    return jax.tree.map(
        lambda all_, blank: jnp.where(rehearsed, all_[:num], blank), results, not_rehearsed(num)
    )


def _result(way: Int[Array, "T"], length: Int[Array, ""], ahead: Ahead) -> Rehearsal:
    """The result of a rehearsal that visited the first ``length`` states of ``way`` after its start."""
    states = jnp.concatenate([ahead.start[None], way])
    steps = jnp.arange(len(states))
    known = (steps <= length) & (states != UNKNOWN)
    # States from which no way is known count as at least as far as every other.
    unreached = jnp.maximum(_UNREACHED, jnp.max(jnp.where(ahead.left < FAR, ahead.left, 0)))
    left = jnp.minimum(ahead.left[states], unreached)
    last = jnp.sum(known) - 1
    arrives = states[last] == ahead.goal
    leaves = ~arrives & (states[length] == UNKNOWN)
    hoped = last + 1 + left[last] + HOPE
    total = jnp.where(arrives, last, jnp.where(leaves, hoped, FAR))

    wasted = steps + left - left[0]  # steps so far that were not on a shortest path
    to_go = jnp.where(known, left + wasted, FAR)
    moment = jnp.argmin(to_go)
    strays = jnp.max(jnp.where(known & (wasted == 0), steps, 0))
    first, second = (jnp.clip(number, 0, _DIGITS - 1) for number in (total, to_go[moment]))
    return Rehearsal(
        ends=jnp.where(arrives, ARRIVES, jnp.where(leaves, LEAVES, FAILS)),
        steps=total,
        rank=(first * _DIGITS + second) * _DIGITS + _DIGITS - 1 - strays,
        strays=strays,
        farthest=left[0] - left[moment],
    )


def any_of(which: Bool[Array, "C"], rank: Int[Array, "C"]) -> tuple[Array, Array]:
    """The index of the lowest rank among those marked in ``which``, and whether any is marked."""
    return jnp.argmin(jnp.where(which, rank, jnp.iinfo(jnp.int32).max)), jnp.any(which)
