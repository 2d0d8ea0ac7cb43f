"""Prompts for a way: random ones of its goals, and changed ones."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.base import Goals
from mgpo_jax.prompts import Prompt, sample_prompt

INSERT, DELETE, REPLACE, DISTURB, SHIFT = range(5)
FARTHEST_SHIFT = 3


def random_prompts(
    key: PRNGKeyArray,
    way: Goals,
    task_goal: Float[Array, "G"],
    num_slots: int,
    max_goals: int | Int[Array, ""],
    num: int,
) -> Prompt:
    """That many prompts [num] of goals on a way, drawn as prompts are drawn from a trajectory."""
    keys = jax.random.split(key, num)
    draw = lambda key: sample_prompt(key, way, task_goal, num_slots, max_goals)  # noqa: E731
    return jax.vmap(draw)(keys)


# Long because the five changes share what they draw.
def changed(
    key: PRNGKeyArray,
    prompt: Prompt,
    way: Goals,
    max_goals: int | Int[Array, ""],
    stride: Float[Array, ""],
) -> Prompt:
    """A prompt with one change: a goal of the way inserted, one deleted, replaced, disturbed or shifted.

    Goals stand in the order of the places on the way that they are nearest to. One is disturbed by normal
    noise of half a step to two steps, which points beside the way: a policy that cuts a corner can be led
    around it.

    Args:
      key: random key.
      prompt: the prompt to change. Its last goal stays.
      way: goals on a way. The last one, where the way ends, is not inserted.
      max_goals: the longest prompt, the last goal included.
      stride: how far a step changes a goal.
    """
    key_op, key_slot, key_place, key_noise, key_size, key_shift = jax.random.split(key, 6)
    inner, used = prompt.goals[:-1], prompt.mask[:-1]
    count, num_inner = used.sum(), jnp.maximum(way.length - 1, 1)
    place = jax.vmap(lambda goal: _nearest(goal, way))(inner)

    has_room = count < max_goals - 1
    op = jax.random.randint(key_op, (), 0, 5)
    op = jnp.where((op == INSERT) & ~has_room, REPLACE, op)
    op = jnp.where(count == 0, INSERT, op)
    slot = jnp.argmax(jnp.where(used, jax.random.uniform(key_slot, used.shape), -1.0))
    slot = jnp.where(op == INSERT, 0, slot)  # the first slot is empty as long as there is room

    anywhere = jax.random.randint(key_place, (), 0, num_inner)
    shift = jax.random.randint(key_shift, (), -FARTHEST_SHIFT, FARTHEST_SHIFT + 1)
    shifted = jnp.clip(place[slot] + shift, 0, num_inner - 1)
    to = jnp.where(op == SHIFT, shifted, anywhere)
    size = stride * jax.random.choice(key_size, jnp.array([0.5, 1.0, 2.0]))
    noise = size * jax.random.normal(key_noise, inner.shape[-1:])
    goal = jnp.where(op == DISTURB, inner[slot] + noise, way.achieved_goals[to])

    is_used = (op != DELETE) & ((op != INSERT) | has_room)
    used = used.at[slot].set(is_used)
    inner = inner.at[slot].set(goal)
    place = place.at[slot].set(jnp.where(op == DISTURB, place[slot], to))
    return _ordered(inner, used, place, prompt.goals[-1])


def _nearest(goal: Float[Array, "G"], way: Goals) -> Int[Array, ""]:
    """The place on a way that a goal is nearest to."""
    distance = jnp.sum(jnp.abs(way.achieved_goals - goal), axis=-1)
    return jnp.argmin(jnp.where(way.goal_reached, distance, jnp.inf))


def _ordered(
    goals: Float[Array, "W G"],
    used: Array,
    place: Int[Array, "W"],
    last: Float[Array, "G"],
) -> Prompt:
    """The prompt of the used goals by their places, and the last one."""
    order = jnp.argsort(jnp.where(used, place, -1))  # unused slots first
    mask = jnp.append(used[order], True)
    goals = jnp.concatenate([goals[order], last[None]])
    return Prompt(jnp.where(mask[:, None], goals, 0.0), mask)
