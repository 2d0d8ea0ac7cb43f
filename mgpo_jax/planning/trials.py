"""The prompts that ``plan`` has run greedily, with their returns, in the same table of arms as the
bandits'."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mgpo_jax.optimizers.arms import Arms, insert_arm, update_arm
from mgpo_jax.optimizers.ucb import upper_confidence_bounds
from mgpo_jax.prompts import Prompt
from mgpo_jax.rollout import Query
from mgpo_jax.trees import choose


def equal_to(prompts: Arms, prompt: Prompt) -> Bool[Array, "M"]:
    """Which rows of the table hold this prompt."""
    same = jnp.all(prompts.prompts.goals == prompt.goals, axis=(1, 2))
    return same & jnp.all(prompts.prompts.mask == prompt.mask, axis=1) & prompts.taken


def is_tried(prompts: Arms, prompt: Prompt) -> Bool[Array, ""]:
    """Whether the prompt is in the table."""
    return jnp.any(equal_to(prompts, prompt))


def with_result(prompts: Arms, query: Query, return_: Float[Array, ""]) -> Arms:
    """The table with the return of an episode, if the episode was greedy."""
    same = equal_to(prompts, query.prompt)
    updated = update_arm(prompts, jnp.argmax(same), return_)
    told = choose(jnp.any(same), updated, insert_arm(prompts, query.prompt, return_))
    return choose(query.greedy, told, prompts)


def mean_steps(
    means: Float[Array, "M"], prompts: Arms, prompt: Prompt, steps: Int[Array, ""]
) -> Float[Array, "M"]:
    """The mean numbers of steps of the prompts in the table, after one more episode.

    Args:
      means: the means before it.
      prompts: the table, which already holds the return of the episode.
      prompt: the prompt that was run.
      steps: the number of steps that it took.
    """
    row = jnp.argmax(equal_to(prompts, prompt))
    pulls = prompts.pulls[row]
    before = jnp.where(pulls > 1, means[row], 0.0)
    return means.at[row].set(before + (steps - before) / pulls)


def most_promising(prompts: Arms) -> Prompt:
    """The prompt with the highest upper confidence bound, as UCB chooses it.

    The unit of the bound is the standard deviation of all returns in the table, and c is that of UCB1.
    """
    num = jnp.maximum(jnp.sum(prompts.pulls), 1)
    overall = jnp.sum(prompts.pulls * prompts.mean) / num
    between = prompts.pulls * (prompts.mean - overall) ** 2
    std = jnp.sqrt(jnp.sum(prompts.sum_sq + between) / num)
    return prompts.prompt(jnp.argmax(upper_confidence_bounds(prompts, 2**0.5, std)))
