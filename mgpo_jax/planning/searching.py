"""Search for prompts that lead along a known path, by rehearsing them in the table of known states."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from mgpo_jax.optimizers.arms import Arms
from mgpo_jax.optimizers.base import SearchSpace
from mgpo_jax.planning.proposals import changed, crossed, random_prompts
from mgpo_jax.planning.rehearsal import (
    ARRIVES,
    FAILS,
    LEAVES,
    UNRANKED,
    Ahead,
    Rehearsal,
    Seen,
    any_of,
    not_rehearsed,
    rehearse,
)
from mgpo_jax.planning.steering import deficits, lead_along, steer
from mgpo_jax.planning.table import Table, Way
from mgpo_jax.planning.trials import is_tried
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import Prompt, single_goal
from mgpo_jax.trees import choose

NUM_PROMPTS = 32
"""Number of prompts in the pool, and of mutated prompts that are rehearsed in each round."""
NUM_KEPT = 20
"""Number of the best prompts that the next search starts with, besides new random ones."""
NUM_PARENTS = 12
"""Number of the best prompts that are mutated."""
CROSSED = 0.25
"""Probability that a mutated prompt is first crossed with a second parent."""
SLACK = 12
"""A rehearsal may take this many steps more than twice the shortest known path; then it is given up."""
OF_EACH_END = (6, 10, 10)
"""Numbers of prompts that arrive, leave the known states, and fail which the pool keeps at least, if it has
that many."""
NUM_LED = 8
"""Number of prompts that are steered together."""
LENGTHS_LED = (32, 64)
"""Capacities, in steps, for a path that prompts are steered along; the smallest sufficient one is used, and
prompts are not steered along a longer path."""


class Features(NamedTuple):
    """The parts of the method that are used; turning one off is an ablation."""

    rounds: int = 3
    """Largest number of rounds of mutated prompts in a search; 0 disables rehearsals."""
    steering: int = 20
    """Largest number of gradient steps that steer prompts in a search; 0 disables steering."""
    splice: bool = True
    """Whether paths combine all episodes, rather than come from the best one alone."""
    frontier: bool = True
    """Whether exploration also heads for frontiers."""


class Tools(NamedTuple):
    """The fixed inputs of the method. All of it is static except for the policy's parameters."""

    space: SearchSpace
    world: Seen
    policy: Policy
    features: Features
    draws_goals: bool
    """Whether the world draws random goals (``SearchSpace.sample_goal``)."""


class Memory(NamedTuple):
    """The prompts that a search passes on to the next one."""

    kept: Prompt
    """The best prompts of the latest search [NUM_KEPT]."""
    led: Prompt
    """The prompts that were steered last [NUM_LED]."""
    exists: Bool[Array, ""]
    """Whether there was a search yet."""


def no_memory(task_goal: Float[Array, "G"], num_slots: int) -> Memory:
    """The memory before the first search."""
    first = single_goal(task_goal, num_slots)
    kept, led = (
        jax.tree.map(lambda leaf, num=num: jnp.stack([leaf] * num), first)
        for num in (NUM_KEPT, NUM_LED)
    )
    return Memory(kept, led, jnp.zeros((), bool))


class Offer(NamedTuple):
    """The best prompt of one kind that a search has found, if there is any."""

    prompt: Prompt
    exists: Bool[Array, ""]


class Found(NamedTuple):
    """The result of a search."""

    memory: Memory
    sure: Offer
    """A prompt that reaches the task goal sooner than any greedy episode so far."""
    hopeful: Offer
    """A prompt that leaves the known states, and may reach the task goal sooner."""
    num_rehearsed: Int[Array, ""]
    """Number of prompts that the search rehearsed."""


class Pool(NamedTuple):
    """The state of a search: prompts [NUM_PROMPTS] with their rehearsals, best first."""

    prompts: Prompt
    rehearsal: Rehearsal


class Turn(NamedTuple):
    """The state of a search between two turns, in each of which prompts are made and rehearsed."""

    number: Int[Array, ""]
    """Number of turns so far."""
    pool: Pool
    led: Prompt
    """The prompts that were steered last [NUM_LED]."""
    num_rehearsed: Int[Array, ""]


class Made(NamedTuple):
    """The prompts that a turn rehearses."""

    prompts: Prompt
    """Prompts [NUM_PROMPTS], of which the first ``num`` count."""
    num: Int[Array, ""]
    led: Prompt
    """The prompts that were steered last [NUM_LED]."""


def nothing_found(memory: Memory) -> Found:
    """The result when no search was made."""
    prompt = jax.tree.map(lambda rows: rows[0], memory.kept)
    nothing = Offer(prompt, jnp.zeros((), bool))
    return Found(memory, nothing, nothing, jnp.int32(0))


class Quest(NamedTuple):
    """The fixed inputs of one search."""

    tools: Tools
    table: Table
    way: Way
    """A shortest known path to the task goal, whose state is in the table."""
    limit: Int[Array, ""]
    """Largest number of steps of a rehearsal that would still be useful."""

    @property
    def task_goal(self) -> Float[Array, "G"]:
        return self.table.goals[self.way.end]

    def tried(self, made: Made) -> Pool:
        """Rehearse prompts; returns them with the results."""
        way, tools = self.way, self.tools
        ahead = Ahead(self.table, way.start, way.end, way.left, self.limit)
        found = rehearse(tools.world, tools.policy, ahead, made.prompts, made.num)
        return Pool(made.prompts, found)

    def changed(self, key: PRNGKeyArray, prompt: Prompt, around: Int[Array, ""]) -> Prompt:
        """Mutate a prompt, see ``proposals.changed``."""
        longest, stride = self.tools.space.longest, self.table.stride
        return changed(key, prompt, self.way.goals, longest, stride, around)


def search_prompts(
    key: PRNGKeyArray,
    tools: Tools,
    table: Table,
    way: Way,
    memory: Memory,
    prompts: Arms,
    verified: Int[Array, ""],
) -> Found:
    """Search for prompts by rehearsing them: first kept and random prompts, then mutated and steered ones.

    Args:
      key: random key.
      tools: the fixed inputs of the method.
      table: the map of the task.
      way: a shortest known path to the task goal, whose state is in the table.
      memory: the prompts passed on by the last search.
      prompts: the prompts that were run greedily in episodes.
      verified: steps of the shortest greedy episode that reached the task goal.
    """
    quest = Quest(tools, table, way, jnp.minimum(verified - 1, 2 * way.steps + SLACK))
    key_random, key_rounds, key_led = jax.random.split(key, 3)
    space = tools.space
    fresh = random_prompts(
        key_random, way.goals, quest.task_goal, space.num_slots, space.longest, NUM_PROMPTS
    )
    kinds: list[Callable[[Turn], Made]] = [
        lambda turn: Made(_first_prompts(memory, fresh), jnp.int32(NUM_PROMPTS), turn.led),
        partial(_children, key_rounds, quest),
        *([partial(_steered, key_led, quest, fresh)] if _lengths_led(tools) else []),
    ]

    def take(turn: Turn) -> Turn:
        made = jax.lax.switch(_next_kind(quest, turn), kinds, turn)
        pool = _best(_concatenated(turn.pool, quest.tried(made)))
        return Turn(turn.number + 1, pool, made.led, turn.num_rehearsed + made.num)

    first = Turn(jnp.int32(0), Pool(fresh, not_rehearsed(NUM_PROMPTS)), memory.led, jnp.int32(0))
    # All turns share one loop, so that the program contains the rehearsal, its largest part, only once.
    last: Turn = jax.lax.while_loop(lambda turn: _next_kind(quest, turn) < len(kinds), take, first)
    pool = last.pool
    sooner = pool.rehearsal.steps < verified
    sooner &= ~jax.vmap(partial(is_tried, prompts))(pool.prompts)
    return Found(
        memory=Memory(_rows(pool.prompts, NUM_KEPT), last.led, jnp.ones((), bool)),
        sure=_offer(pool, sooner & (pool.rehearsal.ends == ARRIVES)),
        hopeful=_offer(pool, sooner & (pool.rehearsal.ends == LEAVES)),
        num_rehearsed=last.num_rehearsed,
    )


def _lengths_led(tools: Tools) -> list[int]:
    """The capacities, in steps, for a path that prompts are steered along; none without steering."""
    if not tools.features.steering or tools.policy.score is None:
        return []
    return sorted({min(length, tools.space.horizon) for length in LENGTHS_LED})


def _next_kind(quest: Quest, turn: Turn) -> Int[Array, ""]:
    """Which prompts the next turn makes: 0 first ones, 1 mutated ones, 2 steered ones. The number after the
    last of these ends the search."""
    steps, rounds = quest.way.steps, quest.tools.features.rounds
    lengths = _lengths_led(quest.tools)
    end = 3 if lengths else 2
    # Prompts are steered once at most, after all rounds of mutated ones.
    steers = (turn.number == rounds + 1) & (steps <= max(lengths, default=0))
    later = jnp.where(turn.number <= rounds, 1, jnp.where(steers, 2, end))
    later = jnp.where(_has_shortest(turn.pool, steps), end, later)
    return jnp.where(turn.number == 0, 0, later)


def _first_prompts(memory: Memory, fresh: Prompt) -> Prompt:
    """The prompts [NUM_PROMPTS] that a search starts with: kept ones, if there are any, and random ones."""
    keeps = memory.exists & (jnp.arange(NUM_PROMPTS) < NUM_KEPT)
    return jax.tree.map(
        lambda old, new: jnp.where(
            jnp.expand_dims(keeps, tuple(range(1, new.ndim))),
            jnp.concatenate([old, new[NUM_KEPT:]]),
            new,
        ),
        memory.kept,
        fresh,
    )


def _has_shortest(pool: Pool, known: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether the best prompt certainly reaches the task goal by a path no longer than the shortest known
    one."""
    return (pool.rehearsal.ends[0] == ARRIVES) & (pool.rehearsal.steps[0] <= known)


def _children(key: PRNGKeyArray, quest: Quest, turn: Turn) -> Made:
    """Mutated prompts."""
    keys = jax.random.split(jax.random.fold_in(key, turn.number - 1), NUM_PROMPTS)
    children = jax.vmap(lambda key: _child(key, quest, turn.pool))(keys)
    return Made(children, jnp.int32(NUM_PROMPTS), turn.led)


def _child(key: PRNGKeyArray, quest: Quest, pool: Pool) -> Prompt:
    """Mutate one of the best prompts once or twice, sometimes after crossing it with another one."""
    key_parent, key_cross, key_crosses, key_where, key_change = jax.random.split(key, 5)
    first, second = jax.random.randint(key_parent, (2,), 0, NUM_PARENTS)
    parent, mate = (jax.tree.map(lambda rows, i=i: rows[i], pool.prompts) for i in (first, second))
    longest = quest.tools.space.longest
    mixed = crossed(key_cross, parent, mate, quest.way.goals, longest)
    parent = choose(jax.random.bernoulli(key_crosses, CROSSED), mixed, parent)
    strays, farthest = pool.rehearsal.strays[first], pool.rehearsal.farthest[first]
    around = jnp.where(jax.random.bernoulli(key_where), strays, farthest)
    key_once, key_again, key_more = jax.random.split(key_change, 3)

    def change(prompt: Prompt, key: PRNGKeyArray) -> tuple[Prompt, Prompt]:
        mutated = quest.changed(key, prompt, around)
        return mutated, mutated

    # A loop, since a second copy of the mutations would take seconds to compile.
    twice, both = jax.lax.scan(change, parent, jnp.stack([key_once, key_again]))
    once = jax.tree.map(lambda rows: rows[0], both)
    return choose(jax.random.bernoulli(key_more), twice, once)


def _steered(key: PRNGKeyArray, quest: Quest, fresh: Prompt, turn: Turn) -> Made:
    """The most promising prompts, steered along the known path.

    Candidates are the prompts that were steered last, mutations of them, the best ones of the pool and
    random ones (``fresh``); those of the smallest deficits are steered.
    """
    pool, led = turn.pool, turn.led
    change = lambda key, prompt: quest.changed(key, prompt, pool.rehearsal.strays[0])  # noqa: E731
    own = jax.vmap(change)(jax.random.split(key, NUM_LED), led)
    first = _concatenated(led, own, _rows(pool.prompts, NUM_LED), _rows(fresh, NUM_LED))
    lengths = _lengths_led(quest.tools)
    too_short = [(quest.way.steps > length).astype(jnp.int32) for length in lengths[:-1]]
    along = [partial(_led, quest, length) for length in lengths]
    moved = jax.lax.switch(sum(too_short, start=jnp.int32(0)), along, first)
    prompts = jax.tree.map(lambda all_, some: all_.at[:NUM_LED].set(some), pool.prompts, moved)
    return Made(prompts, jnp.int32(NUM_LED), moved)


def _led(quest: Quest, longest: int, candidates: Prompt) -> Prompt:
    """The candidates with the smallest deficits, steered along the path of at most ``longest`` steps."""
    way, tools = quest.way, quest.tools
    lead = lead_along(quest.table, way.start, way.states, longest)
    chosen = jnp.argsort(deficits(tools.policy, lead, candidates))[:NUM_LED]
    first = jax.tree.map(lambda rows: rows[chosen], candidates)
    moved, _ = steer(tools.policy, lead, first, quest.table.stride, tools.features.steering)
    return moved


def _concatenated(*trees: Any) -> Any:
    """Concatenate the rows of pytrees."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *trees)


def _rows(tree: Any, num: int) -> Any:
    """The first ``num`` rows of a pytree."""
    return jax.tree.map(lambda rows: rows[:num], tree)


def _offer(pool: Pool, which: Bool[Array, "C"]) -> Offer:
    """The best prompt of a pool among those marked in ``which``."""
    index, exists = any_of(which, pool.rehearsal.rank)
    prompt = jax.tree.map(lambda rows: rows[index], pool.prompts)
    return Offer(prompt, exists)


def _best(pool: Pool) -> Pool:
    """The ``NUM_PROMPTS`` best prompts of a pool, best first, without duplicates and with some of each
    end."""
    rehearsal = pool.rehearsal
    num = len(rehearsal.rank)
    # Prompts of the same rank count as duplicates. Those that were not rehearsed come after all others.
    again = jnp.any(jnp.tril(rehearsal.rank[:, None] == rehearsal.rank, -1), axis=-1)
    missing = rehearsal.rank == UNRANKED
    rank = jnp.where(again & ~missing, UNRANKED - 1, rehearsal.rank)
    order, again = jnp.argsort(rank), again | missing
    pool = jax.tree.map(lambda rows: rows[order], pool)
    ends, again = pool.rehearsal.ends, again[order]
    is_end = ends[:, None] == jnp.array([ARRIVES, LEAVES, FAILS])
    place = jnp.cumsum(is_end, axis=0)[jnp.arange(num), ends]  # among those of the same end
    spare = again | (place > jnp.array(OF_EACH_END)[ends])
    # The sort is stable, so the selected prompts stay in order.
    chosen = jnp.sort(jnp.argsort(spare)[:NUM_PROMPTS])
    return jax.tree.map(lambda rows: rows[chosen], pool)
