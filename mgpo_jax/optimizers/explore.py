"""MGPO-explore: the ablation without a bandit (paper, section 4.3).

It acts with the prompt drawn most recently from the best trajectory, whatever its returns were.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from mgpo_jax.optimizers.arms import BanditState, bandit
from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace


def explore(space: SearchSpace) -> PromptOptimizer:
    """Algorithm 1 without prompt selection."""

    def select(key: PRNGKeyArray, state: BanditState) -> Int[Array, ""]:
        del key, state
        return jnp.int32(0)

    return bandit(space, select, act_with_newest=True)
