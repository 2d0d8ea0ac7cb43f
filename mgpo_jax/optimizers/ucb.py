"""MGPO-UCB: act with the prompt of the highest upper confidence bound (paper, Eq. 3)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mgpo_jax.optimizers.arms import Arms, BanditState, bandit
from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace


def upper_confidence_bounds(
    arms: Arms, c: float | Float[Array, ""], scale: float | Float[Array, ""]
) -> Float[Array, "M"]:
    """UCB(p) = mean + c * scale * sqrt(log N / 2 n_p) for each arm (Eq. 3 has scale 1)."""
    pulls = jnp.maximum(arms.pulls, 1)
    total = jnp.maximum(jnp.sum(arms.pulls), 1)
    bounds = arms.mean + c * scale * jnp.sqrt(jnp.log(total) / (2 * pulls))
    return jnp.where(arms.taken, bounds, -jnp.inf)


def ucb(
    space: SearchSpace,
    c: float | Float[Array, ""] = 1.0,
    scale: float | Float[Array, ""] | None = None,
) -> PromptOptimizer:
    """Algorithm 1 with UCB.

    Args:
      space: the search space.
      c: exploration constant [1 in the paper's main results].
      scale: unit of returns in which ``c`` counts. Eq. 3 is derived for returns in [0, 1]; the
        default is the span of the world's returns, so that ``c`` means the same in every world.
        1 gives the formula as printed, whatever the rewards are.
    """
    scale = space.return_span if scale is None else scale

    def select(key: PRNGKeyArray, state: BanditState) -> Int[Array, ""]:
        del key
        return jnp.argmax(upper_confidence_bounds(state.arms, c, scale))

    return bandit(space, select)
