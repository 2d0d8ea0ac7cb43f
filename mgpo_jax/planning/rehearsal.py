"""Prompts tried out without an episode: the frozen policy acts in the table of what was seen.

Where the table holds everything that the policy comes to, in a world without chance, a rehearsal is what an
episode would be. Where it leaves what is known, it says from where on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from envs.base import Environment, EnvSpec, TimeStep
from mgpo_jax.planning.table import FAR, UNKNOWN, Table
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import Prompt
from mgpo_jax.rollout import Query, rollout

HOPE = 2
"""Steps that a way beyond what is known is taken to cost, beside those that are known to be left."""
TOGETHER = 8  # rehearsals that share a clock: their memories fit into the cache near a core
# Ranks put the expected steps first, then what is left, then how long it kept to a shortest way.
_DIGITS = 1024

ARRIVES, LEAVES, FAILS = range(3)


class Ahead(NamedTuple):
    """What is to be tried: a way through the table of what was seen."""

    table: Table
    start: Int[Array, ""]
    goal: Int[Array, ""]
    left: Int[Array, "N"]
    """The fewest known steps from each state to the goal (``table.steps_to``)."""
    limit: Int[Array, ""]
    """A rehearsal is given up where it has no known way left to arrive after so many steps in all."""


class Place(NamedTuple):
    """A rehearsal in progress."""

    ahead: Ahead
    state: Int[Array, ""]
    """``UNKNOWN`` once it has left what is known."""
    steps: Int[Array, ""]


@dataclass(frozen=True)
class Seen(Environment):
    """A world as far as it was seen, as a world: its tasks are ``Ahead``, its goals numbers of states.

    Attributes:
      world: the world that was seen.
      longest: number of steps after which a rehearsal ends in any case.
    """

    world: EnvSpec
    longest: int

    @property
    def spec(self) -> EnvSpec:
        return replace(self.world, horizon=self.longest, goal_dim=1, layout=None)

    def reset(self, key: Array, task: Ahead) -> tuple[Place, TimeStep]:
        del key
        place = Place(task, task.start, jnp.int32(0))
        return place, self._seen(place)

    def step(self, state: Place, action: Array) -> tuple[Place, TimeStep]:
        known = state.ahead.table.successors[state.state, action]
        after = jnp.where(state.state == UNKNOWN, UNKNOWN, known)
        place = Place(state.ahead, after, state.steps + 1)
        return place, self._seen(place)

    def _seen(self, place: Place) -> TimeStep:
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
    """What came of trying a prompt in the table."""

    ends: Int[Array, "*C"]
    """``ARRIVES`` at the goal, ``LEAVES`` what is known, or ``FAILS``."""
    steps: Int[Array, "*C"]
    """Until it arrives, for sure; where it leaves what is known, the steps that may be hoped for; ``FAR``
    where it fails."""
    rank: Int[Array, "*C"]
    """The lower, the better. Ties in steps are broken by what was left to go at the best moment, where
    every step beside a shortest way counts as one more, and then by ``strays``."""
    strays: Int[Array, "*C"]
    """After how many steps it left the shortest ways."""
    farthest: Int[Array, "*C"]
    """How many steps of a shortest way it had behind it at the best moment."""


def rehearse(world: Seen, policy: Policy, ahead: Ahead, prompts: Prompt) -> Rehearsal:
    """Try prompts [C] greedily in the table.

    Args:
      world: the world as far as it was seen.
      policy: who acts.
      ahead: what to try.
      prompts: the C prompts.
    """
    greedy = jnp.ones((), bool)

    def tried(prompt: Prompt) -> Rehearsal:
        episode = rollout(jax.random.key(0), world, policy, ahead, Query(prompt, greedy))
        steps = episode.trajectory
        return _judged(steps.achieved_goals[:, 0].astype(jnp.int32), steps.length, ahead)

    return jax.lax.map(tried, prompts, batch_size=TOGETHER)


def _judged(way: Int[Array, "T"], length: Int[Array, ""], ahead: Ahead) -> Rehearsal:
    """What a rehearsal came to that visited the states ``way`` after its start."""
    states = jnp.concatenate([ahead.start[None], way])
    steps = jnp.arange(len(states))
    known = (steps <= length) & (states != UNKNOWN)
    left = jnp.minimum(ahead.left[states], _DIGITS // 4)
    last = jnp.sum(known) - 1
    arrives = states[last] == ahead.goal
    leaves = ~arrives & (states[length] == UNKNOWN)
    hoped = last + 1 + left[last] + HOPE
    total = jnp.where(arrives, last, jnp.where(leaves, hoped, FAR))

    beside = steps + left - left[0]  # steps that did not lead nearer
    to_go = jnp.where(known, left + beside, FAR)
    moment = jnp.argmin(to_go)
    strays = jnp.max(jnp.where(known & (beside == 0), steps, 0))
    first, second = (jnp.clip(number, 0, _DIGITS - 1) for number in (total, to_go[moment]))
    return Rehearsal(
        ends=jnp.where(arrives, ARRIVES, jnp.where(leaves, LEAVES, FAILS)),
        steps=total,
        rank=(first * _DIGITS + second) * _DIGITS + _DIGITS - 1 - strays,
        strays=strays,
        farthest=left[0] - left[moment],
    )


def any_of(which: Bool[Array, "C"], rank: Int[Array, "C"]) -> tuple[Array, Array]:
    """The best of those that are ``which``, and whether there is one."""
    return jnp.argmin(jnp.where(which, rank, jnp.iinfo(jnp.int32).max)), jnp.any(which)
