"""GRIPS: gradient-free search by adding, deleting and swapping goals (paper, Algorithm 2, E.2)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.base import Episode
from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace
from mgpo_jax.prompts import Prompt, single_goal
from mgpo_jax.rollout import Query
from mgpo_jax.trees import choose

ADD, DELETE, SWAP = range(3)


def edit(
    key: PRNGKeyArray, prompt: Prompt, goal: Float[Array, "G"], max_goals: int | Int[Array, ""]
) -> Prompt:
    """Apply one random operation, of those that the prompt's length allows, to the goals before the last.

    Args:
      key: random key.
      prompt: the prompt to edit.
      goal: the goal that the operation Add inserts.
      max_goals: number of goals of the longest prompt, including the last goal.
    """
    key_op, key_at, key_swap = jax.random.split(key, 3)
    num_slots = prompt.mask.shape[0]
    count = prompt.mask.sum() - 1  # goals before the last
    allowed = jnp.stack([count < max_goals - 1, count >= 1, count >= 2])
    op = jnp.argmax(jnp.where(allowed, jax.random.uniform(key_op, (3,)), -1.0))
    op = jnp.where(jnp.any(allowed), op, -1)

    # `rank` numbers the goals of the edited prompt; `source` is the rank in the old prompt that each of
    # them comes from, or `new` for the inserted goal.
    new = num_slots
    new_count = count + (op == ADD) - (op == DELETE)
    rank = jnp.arange(num_slots) - (num_slots - 1 - new_count)
    at = jax.random.randint(key_at, (), 0, jnp.maximum(count + (op == ADD), 1))
    other = (at + jax.random.randint(key_swap, (), 1, jnp.maximum(count, 2))) % jnp.maximum(
        count, 1
    )
    added = jnp.where(rank == at, new, rank - (rank > at))
    deleted = rank + (rank >= at)
    swapped = jnp.where(rank == at, other, jnp.where(rank == other, at, rank))
    source = jnp.select([op == ADD, op == DELETE, op == SWAP], [added, deleted, swapped], rank)

    pool = jnp.concatenate([prompt.goals, goal[None]])
    slot = jnp.where(source == new, num_slots, source + num_slots - 1 - count)
    is_last = jnp.arange(num_slots) == num_slots - 1
    mask = is_last | (rank >= 0)
    goals = jnp.where(is_last[:, None], prompt.goals[-1], pool[slot])
    return Prompt(jnp.where(mask[:, None], goals, 0.0), mask)


class GripsState(NamedTuple):
    """The state of Algorithm 2 between two episodes."""

    prompt: Prompt
    """p*, the prompt being edited."""
    return_: Float[Array, ""]
    """R*, the return of p*."""
    leader: Prompt
    """The best edit of this iteration so far."""
    leader_return: Float[Array, ""]
    episode: Int[Array, ""]


def grips(space: SearchSpace, num_edits: int | Int[Array, ""] = 5) -> PromptOptimizer:
    """GRIPS with ``num_edits`` edited prompts per iteration, each evaluated in one greedy episode.

    There are two differences from Algorithm 2. The first episode evaluates (g^M), whose return Algorithm 2
    leaves at -inf. And an edit of equal return is accepted: with sparse rewards it can happen that no
    prompt one edit away from (g^M) is better, and the search would never leave it.
    """

    def init(key: PRNGKeyArray, task_goal: Float[Array, "G"]) -> GripsState:
        del key
        first = single_goal(task_goal, space.num_slots)
        worst = jnp.float32(-jnp.inf)
        return GripsState(
            prompt=first, return_=worst, leader=first, leader_return=worst, episode=jnp.int32(0)
        )

    def ask(key: PRNGKeyArray, state: GripsState) -> tuple[Query, GripsState]:
        key_goal, key_edit = jax.random.split(key)
        edited = edit(key_edit, state.prompt, space.sample_goal(key_goal), space.longest)
        first = state.episode == 0
        prompt = choose(first, state.prompt, edited)
        return Query(prompt, jnp.ones((), bool)), state

    def tell(state: GripsState, query: Query, episode: Episode) -> GripsState:
        leads = episode.return_ > state.leader_return
        leader = choose(leads, query.prompt, state.leader)
        leader_return = jnp.maximum(episode.return_, state.leader_return)
        # An iteration ends after `num_edits` episodes; the evaluation of (g^M) is one of its own.
        ends = state.episode % num_edits == 0
        moves = ends & (leader_return >= state.return_)
        return GripsState(
            prompt=choose(moves, leader, state.prompt),
            return_=jnp.where(moves, leader_return, state.return_),
            leader=leader,
            leader_return=jnp.where(ends, -jnp.inf, leader_return),
            episode=state.episode + 1,
        )

    def best(state: GripsState) -> Prompt:
        return choose(state.leader_return > state.return_, state.leader, state.prompt)

    return PromptOptimizer(init, ask, tell, best)
