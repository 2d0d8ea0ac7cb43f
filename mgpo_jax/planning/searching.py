"""Search for prompts that lead along a known way, by rehearsing them in the table of what was seen."""

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
    Ahead,
    Rehearsal,
    Seen,
    any_of,
    rehearse,
)
from mgpo_jax.planning.steering import deficits, lead_along, steer
from mgpo_jax.planning.table import Table, Way
from mgpo_jax.planning.trials import is_tried
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import Prompt, single_goal
from mgpo_jax.trees import choose

NUM_PROMPTS = 32
"""Prompts that are rehearsed together: in each round of changes."""
NUM_KEPT = 20
"""Of these, those that the next search begins with, beside new random ones."""
NUM_PARENTS = 12
"""The best ones, which are changed."""
CROSSED = 0.25
"""Share of changed prompts that have the goals of two parents."""
SLACK = 12
"""A rehearsal is given up when it will take that many steps more than twice the shortest known way."""
OF_EACH_END = (6, 10, 10)
"""How many prompts that arrive, leave what is known, or fail are kept at least, if there are so many."""
NUM_LED = 8
"""Prompts that are steered together."""
LENGTHS_LED = (32, 64)
"""Room for steps of the ways that prompts are steered along; a longer one is not. Less room costs less."""


class Features(NamedTuple):
    """What the plan makes use of; without one of them it is an ablation."""

    rounds: int = 3
    """Rounds of changed prompts that a search rehearses at most; 0 is no rehearsal at all."""
    steering: int = 20
    """Gradient steps that a search steers prompts by; 0 is none."""
    splice: bool = True
    """Whether ways are made of all episodes, or of the best one alone."""
    frontier: bool = True
    """Whether exploring also heads for frontiers."""


class Tools(NamedTuple):
    """What the plan is made with. Everything in it is static, but for the policy's weights."""

    space: SearchSpace
    world: Seen
    policy: Policy
    features: Features


class Memory(NamedTuple):
    """What a search leaves for the next one."""

    kept: Prompt
    """Its best prompts [NUM_KEPT]."""
    led: Prompt
    """The prompts that it steered [NUM_LED]."""
    exists: Bool[Array, ""]
    """Whether there was a search."""


def no_memory(task_goal: Float[Array, "G"], num_slots: int) -> Memory:
    """The memory before the first search."""
    first = single_goal(task_goal, num_slots)
    kept, led = (
        jax.tree.map(lambda leaf, num=num: jnp.stack([leaf] * num), first)
        for num in (NUM_KEPT, NUM_LED)
    )
    return Memory(kept, led, jnp.zeros((), bool))


class Offer(NamedTuple):
    """The best prompt of one kind that a search has found."""

    prompt: Prompt
    exists: Bool[Array, ""]


class Found(NamedTuple):
    """What a search for prompts has found."""

    memory: Memory
    sure: Offer
    """Arrives sooner than any greedy episode before."""
    hopeful: Offer
    """Leaves what is known, and may arrive sooner."""
    num_rehearsed: Int[Array, ""]


class Pool(NamedTuple):
    """A search in progress: prompts [NUM_PROMPTS] with their rehearsals, the best first."""

    prompts: Prompt
    rehearsal: Rehearsal


def nothing_found(memory: Memory) -> Found:
    """What is found without a search."""
    prompt = jax.tree.map(lambda rows: rows[0], memory.kept)
    nothing = Offer(prompt, jnp.zeros((), bool))
    return Found(memory, nothing, nothing, jnp.int32(0))


class Quest(NamedTuple):
    """What a search is for and what it knows."""

    tools: Tools
    table: Table
    way: Way
    """A shortest known way to the task goal, which is known."""
    limit: Int[Array, ""]
    """Steps of the longest way that is of any use."""

    @property
    def task_goal(self) -> Float[Array, "G"]:
        return self.table.goals[self.way.end]

    def tried(self, prompts: Prompt) -> Pool:
        """Prompts with their rehearsals."""
        way = self.way
        ahead = Ahead(self.table, way.start, way.end, way.left, self.limit)
        return Pool(prompts, rehearse(self.tools.world, self.tools.policy, ahead, prompts))

    def changed(self, key: PRNGKeyArray, prompt: Prompt, around: Int[Array, ""]) -> Prompt:
        """A prompt with one change, see ``proposals.changed``."""
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
    """Search for prompts by rehearsing them: the kept ones and random ones, then changed and steered ones.

    Args:
      key: random key.
      tools: what the plan is made with.
      table: what is known.
      way: a shortest known way to the task goal, which is known.
      memory: what earlier searches have left.
      prompts: those that were acted with.
      verified: steps of the shortest greedy episode that arrived.
    """
    quest = Quest(tools, table, way, jnp.minimum(verified - 1, 2 * way.steps + SLACK))
    key_random, key_rounds, key_led = jax.random.split(key, 3)
    space = tools.space
    fresh = random_prompts(
        key_random, way.goals, quest.task_goal, space.num_slots, space.longest, NUM_PROMPTS
    )
    pool = _best(quest.tried(_begun(memory, fresh)))

    def goes_on(carry: tuple[Array, Pool]) -> Bool[Array, ""]:
        return (carry[0] < tools.features.rounds) & ~_has_shortest(carry[1], way.steps)

    def change(carry: tuple[Array, Pool]) -> tuple[Array, Pool]:
        index, pool = carry
        keys = jax.random.split(jax.random.fold_in(key_rounds, index), NUM_PROMPTS)
        children = jax.vmap(lambda key: _child(key, quest, pool))(keys)
        return index + 1, _best(_joined(pool, quest.tried(children)))

    num_rounds, pool = jax.lax.while_loop(goes_on, change, (jnp.int32(0), pool))
    num, led = NUM_PROMPTS * (1 + num_rounds), memory.led
    if tools.features.steering and tools.policy.score is not None:
        lengths = sorted({min(length, space.horizon) for length in LENGTHS_LED})
        room = jnp.array(lengths)
        needed = ~_has_shortest(pool, way.steps) & (way.steps <= room[-1])
        branches: list[Callable[[Pool], tuple[Pool, Prompt]]] = [
            lambda pool: (pool, led),
            *(partial(_steered, key_led, quest, fresh, led, longest) for longest in lengths),
        ]
        which = jnp.where(needed, 1 + jnp.sum(way.steps > room), 0)
        pool, led = jax.lax.switch(which, branches, pool)
        num += NUM_LED * needed
    sooner = pool.rehearsal.steps < verified
    if space.deterministic:  # what a prompt did once it would do again
        sooner &= ~jax.vmap(partial(is_tried, prompts))(pool.prompts)
    return Found(
        memory=Memory(_rows(pool.prompts, NUM_KEPT), led, jnp.ones((), bool)),
        sure=_offer(pool, sooner & (pool.rehearsal.ends == ARRIVES)),
        hopeful=_offer(pool, sooner & (pool.rehearsal.ends == LEAVES)),
        num_rehearsed=num,
    )


def _begun(memory: Memory, fresh: Prompt) -> Prompt:
    """What a search begins with: the kept prompts and random ones, or random ones alone."""
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
    """Whether the best prompt surely takes a shortest known way."""
    return (pool.rehearsal.ends[0] == ARRIVES) & (pool.rehearsal.steps[0] <= known)


def _child(key: PRNGKeyArray, quest: Quest, pool: Pool) -> Prompt:
    """A changed prompt of one of the best, at times with goals of another one."""
    key_parent, key_cross, key_crosses, key_where, key_change = jax.random.split(key, 5)
    first, second = jax.random.randint(key_parent, (2,), 0, NUM_PARENTS)
    parent, mate = (jax.tree.map(lambda rows, i=i: rows[i], pool.prompts) for i in (first, second))
    longest = quest.tools.space.longest
    mixed = crossed(key_cross, parent, mate, quest.way.goals, longest)
    parent = choose(jax.random.bernoulli(key_crosses, CROSSED), mixed, parent)
    strays, farthest = pool.rehearsal.strays[first], pool.rehearsal.farthest[first]
    around = jnp.where(jax.random.bernoulli(key_where), strays, farthest)
    key_once, key_again, key_more = jax.random.split(key_change, 3)
    once = quest.changed(key_once, parent, around)
    twice = quest.changed(key_again, once, around)
    return choose(jax.random.bernoulli(key_more), twice, once)


def _steered(
    key: PRNGKeyArray, quest: Quest, fresh: Prompt, led: Prompt, longest: int, pool: Pool
) -> tuple[Pool, Prompt]:
    """The pool with steered prompts, and these: of those led before, changed ones, good and random ones.

    There is room for ways of ``longest`` steps.
    """
    way = quest.way
    lead = lead_along(quest.table, way.start, way.states, longest)
    tools, stride = quest.tools, quest.table.stride
    change = lambda key, prompt: quest.changed(key, prompt, pool.rehearsal.strays[0])  # noqa: E731
    own = jax.vmap(change)(jax.random.split(key, NUM_LED), led)
    first = _joined(led, own, _rows(pool.prompts, NUM_LED), _rows(fresh, NUM_LED))
    chosen = jnp.argsort(deficits(tools.policy, lead, first))[:NUM_LED]
    first = jax.tree.map(lambda rows: rows[chosen], first)
    moved, _ = steer(tools.policy, lead, first, stride, tools.features.steering)
    return _best(_joined(pool, quest.tried(moved))), moved


def _joined(*trees: Any) -> Any:
    """The rows of several pytrees one after another."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *trees)


def _rows(tree: Any, num: int) -> Any:
    """The first rows of a pytree."""
    return jax.tree.map(lambda rows: rows[:num], tree)


def _offer(pool: Pool, which: Bool[Array, "C"]) -> Offer:
    index, exists = any_of(which, pool.rehearsal.rank)
    prompt = jax.tree.map(lambda rows: rows[index], pool.prompts)
    return Offer(prompt, exists)


def _best(pool: Pool) -> Pool:
    """The ``NUM_PROMPTS`` best of a pool, each once, with some of each end, the best first."""
    rehearsal = pool.rehearsal
    num = len(rehearsal.rank)
    # Prompts of the same rank do the same, as far as it matters.
    again = jnp.any(jnp.tril(rehearsal.rank[:, None] == rehearsal.rank, -1), axis=-1)
    order = jnp.argsort(jnp.where(again, jnp.iinfo(jnp.int32).max, rehearsal.rank))
    pool = jax.tree.map(lambda rows: rows[order], pool)
    ends, again = pool.rehearsal.ends, again[order]
    is_end = ends[:, None] == jnp.array([ARRIVES, LEAVES, FAILS])
    place = jnp.cumsum(is_end, axis=0)[jnp.arange(num), ends]  # among those of its end
    spare = again | (place > jnp.array(OF_EACH_END)[ends])
    # The order among those that stay is kept, since the sort is stable.
    chosen = jnp.sort(jnp.argsort(spare)[:NUM_PROMPTS])
    return jax.tree.map(lambda rows: rows[chosen], pool)
