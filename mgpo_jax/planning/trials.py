"""The prompts that ``plan`` has run greedily, with their returns, in the same table of arms as the
bandits'."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mgpo_jax.optimizers.arms import Arms, insert_arm, update_arm
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
