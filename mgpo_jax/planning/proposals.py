"""Proposals of prompts that may lead along a path: random subsets of its goals, crossovers and
mutations."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.base import Goals
from mgpo_jax.prompts import Prompt, sample_prompt

INSERT, DELETE, REPLACE, DISTURB, SHIFT = range(5)
FARTHEST_SHIFT, FARTHEST_NEAR = 3, 6


def random_prompts(
    key: PRNGKeyArray,
    way: Goals,
    task_goal: Float[Array, "G"],
    num_slots: int,
    max_goals: int | Int[Array, ""],
    num: int,
) -> Prompt:
    """Draw ``num`` prompts from the goals on a path, as prompts are drawn from a trajectory
    (``sample_prompt``)."""
    keys = jax.random.split(key, num)
    draw = lambda key: sample_prompt(key, way, task_goal, num_slots, max_goals)  # noqa: E731
    return jax.vmap(draw)(keys)


def crossed(
    key: PRNGKeyArray, prompt: Prompt, other: Prompt, way: Goals, max_goals: int | Int[Array, ""]
) -> Prompt:
    """Cross two prompts at a random place on the path.

    The result has the goals of the first prompt up to that place, and those of the other after it. If that
    makes more than ``max_goals`` goals, the first ones are left out.
    """
    num_inner = len(prompt.mask) - 1
    cut = jax.random.randint(key, (), 0, jnp.maximum(way.length, 1))
    goals = jnp.concatenate([prompt.goals[:-1], other.goals[:-1]])
    place = jax.vmap(lambda goal: _nearest(goal, way))(goals)
    from_first = jnp.arange(len(goals)) < num_inner
    used = jnp.concatenate([prompt.mask[:-1], other.mask[:-1]])
    used &= jnp.where(from_first, place < cut, place >= cut)
    order = jnp.argsort(jnp.where(used, place, -1))[num_inner:]  # unused ones first
    # The goals to be kept are the last `max_goals` - 1 of these, so the slots before them are emptied.
    has_room = jnp.arange(num_inner) >= num_inner - (max_goals - 1)
    return _ordered(goals[order], used[order] & has_room, place[order], prompt.goals[-1])


# Long because the five mutations share their random draws.
def changed(
    key: PRNGKeyArray,
    prompt: Prompt,
    way: Goals,
    max_goals: int | Int[Array, ""],
    stride: Float[Array, ""],
    around: Int[Array, ""],
) -> Prompt:
    """Mutate one goal of a prompt: insert one of the path, or delete, replace, disturb or shift one.

    The goals of the result are sorted by the place on the path that they are nearest to. A disturbed goal
    gets normal noise with a scale of half a step to four steps, so that it may lie off the path: a policy
    that cuts a corner can be led around it that way. Half of the mutations are made near the place
    ``around``.

    Args:
      key: random key.
      prompt: the prompt to mutate. Its last goal stays.
      way: the goals on a path. The last one, at its end, is never inserted.
      max_goals: number of goals of the longest prompt, including the last goal.
      stride: the change of the goal in one step, as a sum over its components.
      around: a place on the path (index of a step), such as where a rehearsal of the prompt left the path.
    """
    keys = jax.random.split(key, 8)
    key_op, key_slot, key_place, key_noise, key_size, key_shift, key_near, key_is_near = keys
    inner, used = prompt.goals[:-1], prompt.mask[:-1]
    count, num_inner = used.sum(), jnp.maximum(way.length - 1, 1)
    place = jax.vmap(lambda goal: _nearest(goal, way))(inner)
    is_near = jax.random.bernoulli(key_is_near)

    has_room = count < max_goals - 1
    op = jax.random.randint(key_op, (), 0, 5)
    op = jnp.where((op == INSERT) & ~has_room, REPLACE, op)
    op = jnp.where(count == 0, INSERT, op)
    score = jax.random.uniform(key_slot, used.shape)
    score = jnp.where(is_near, 1 / (1 + jnp.abs(place - around) + 2 * score), score)
    slot = jnp.argmax(jnp.where(used, score, -1.0))
    slot = jnp.where(op == INSERT, 0, slot)  # slot 0 is empty as long as there is room

    near = around + jax.random.randint(key_near, (), -FARTHEST_NEAR, FARTHEST_NEAR + 1)
    anywhere = jax.random.randint(key_place, (), 0, num_inner)
    shift = jax.random.randint(key_shift, (), -FARTHEST_SHIFT, FARTHEST_SHIFT + 1)
    to = jnp.where(op == SHIFT, place[slot] + shift, jnp.where(is_near, near, anywhere))
    to = jnp.clip(to, 0, num_inner - 1)
    size = stride * jax.random.choice(key_size, jnp.array([0.5, 1.0, 2.0, 4.0]))
    noise = size * jax.random.normal(key_noise, inner.shape[-1:])
    goal = jnp.where(op == DISTURB, inner[slot] + noise, way.achieved_goals[to])

    is_used = (op != DELETE) & ((op != INSERT) | has_room)
    used = used.at[slot].set(is_used)
    inner = inner.at[slot].set(goal)
    place = place.at[slot].set(jnp.where(op == DISTURB, place[slot], to))
    return _ordered(inner, used, place, prompt.goals[-1])


def _nearest(goal: Float[Array, "G"], way: Goals) -> Int[Array, ""]:
    """The place on a path (index of a step) that a goal is nearest to."""
    distance = jnp.sum(jnp.abs(way.achieved_goals - goal), axis=-1)
    return jnp.argmin(jnp.where(way.goal_reached, distance, jnp.inf))


def _ordered(
    goals: Float[Array, "W G"],
    used: Array,
    place: Int[Array, "W"],
    last: Float[Array, "G"],
) -> Prompt:
    """The prompt of the used goals, sorted by their places on the path, and the last goal."""
    order = jnp.argsort(jnp.where(used, place, -1))  # unused slots first
    mask = jnp.append(used[order], True)
    goals = jnp.concatenate([goals[order], last[None]])
    return Prompt(jnp.where(mask[:, None], goals, 0.0), mask)
