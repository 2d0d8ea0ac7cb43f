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
# Ranks put the expected steps first, then how near to the goal it came, then how long it held out.
_DIGITS = 1024

ARRIVES, LEAVES, FAILS = range(3)


class Ahead(NamedTuple):
    """What is to be tried: a way through the table of what was seen."""

    table: Table
    start: Int[Array, ""]
    goal: Int[Array, ""]
    limit: Int[Array, ""]
    """Steps after which a rehearsal is given up."""


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
            truncated=place.steps >= ahead.limit,
        )


class Rehearsal(NamedTuple):
    """What came of trying a prompt in the table."""

    ends: Int[Array, "*C"]
    """``ARRIVES`` at the goal, ``LEAVES`` what is known, or ``FAILS``."""
    steps: Int[Array, "*C"]
    """Until it arrives, for sure; where it leaves what is known, the steps that may be hoped for; ``FAR``
    where it fails."""
    rank: Int[Array, "*C"]
    """The lower, the better; with ties broken by how near to the goal it came."""


def rehearse(
    world: Seen, policy: Policy, ahead: Ahead, left: Int[Array, "N"], prompts: Prompt
) -> Rehearsal:
    """Try prompts [C] greedily in the table.

    Args:
      world: the world as far as it was seen.
      policy: who acts.
      ahead: what to try.
      left: ``table.steps_to`` the goal.
      prompts: the C prompts.
    """
    greedy = jnp.ones((), bool)

    def tried(prompt: Prompt) -> Rehearsal:
        episode = rollout(jax.random.key(0), world, policy, ahead, Query(prompt, greedy))
        steps = episode.trajectory
        return _judged(steps.achieved_goals[:, 0].astype(jnp.int32), steps.length, ahead, left)

    return jax.lax.map(tried, prompts, batch_size=TOGETHER)


def _judged(
    way: Int[Array, "T"], length: Int[Array, ""], ahead: Ahead, left: Int[Array, "N"]
) -> Rehearsal:
    """What a rehearsal came to that visited the states ``way`` after its start."""
    states = jnp.concatenate([ahead.start[None], way])
    known = (jnp.arange(len(states)) <= length) & (states != UNKNOWN)
    last = jnp.sum(known) - 1  # steps that are known
    remain = jnp.minimum(left[states], _DIGITS // 2)
    total = jnp.where(known, jnp.arange(len(states)) + remain, FAR)
    nearest = jnp.min(total)
    held = jnp.max(jnp.where(known & (total == nearest), jnp.arange(len(states)), 0))
    arrives = states[last] == ahead.goal
    leaves = ~arrives & (states[length] == UNKNOWN)
    steps = jnp.where(arrives, last, jnp.where(leaves, last + 1 + remain[states[last]] + HOPE, FAR))
    first = jnp.minimum(steps, _DIGITS - 1)
    rank = (first * _DIGITS + jnp.minimum(nearest, _DIGITS - 1)) * _DIGITS + _DIGITS - 1 - held
    return Rehearsal(
        ends=jnp.where(arrives, ARRIVES, jnp.where(leaves, LEAVES, FAILS)),
        steps=steps,
        rank=rank,
    )


def any_of(which: Bool[Array, "C"], rank: Int[Array, "C"]) -> tuple[Array, Array]:
    """The best of those that are ``which``, and whether there is one."""
    return jnp.argmin(jnp.where(which, rank, jnp.iinfo(jnp.int32).max)), jnp.any(which)
