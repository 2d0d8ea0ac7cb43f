"""MGPO-BPE: act with the prompt most likely to beat the best return (paper, Eq. 4).

The returns of a prompt have a Gaussian posterior N(mu_p, sigma_p) from the prior N(mu_0, sigma_0).
P(R > R*) = sf((R* - mu_p) / sigma_p) falls with its argument, so the most likely prompt is the one
with the smallest argument: the tails are compared without ever being computed, and nothing
underflows (in the authors' code 1 - cdf does, all arms tie and the first one wins).
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mgpo_jax.optimizers.arms import Arms, BanditState, bandit
from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace


def posterior(
    arms: Arms, return_range: tuple[float, float], min_std: float | Float[Array, ""]
) -> tuple[Float[Array, "M"], Float[Array, "M"]]:
    """Mean and standard deviation of each arm's returns after its history (Eq. 4).

    The spread of a history of one return is unknown and taken as the prior's; that of a longer one
    is at least ``min_std`` times the prior's, so that equal returns do not collapse the posterior.
    """
    low, high = return_range
    prior_mean, prior_std = (low + high) / 2, (high - low) / 2
    spread = jnp.maximum(arms.std, min_std * prior_std)
    spread = jnp.where(arms.pulls < 2, prior_std, spread)
    precision = 1 / prior_std**2 + arms.pulls / spread**2
    mean = (prior_mean / prior_std**2 + arms.pulls * arms.mean / spread**2) / precision
    return mean, precision**-0.5


def shortfall(
    arms: Arms,
    best_return: Float[Array, ""],
    return_range: tuple[float, float],
    min_std: float | Float[Array, ""],
) -> Float[Array, "M"]:
    """(R* - mu_p) / sigma_p for each arm; infinite for free rows."""
    mean, std = posterior(arms, return_range, min_std)
    return jnp.where(arms.taken, (best_return - mean) / std, jnp.inf)


def bpe(space: SearchSpace, min_std: float | Float[Array, ""] = 0.02) -> PromptOptimizer:
    """Algorithm 1 with Bayesian posterior estimation.

    Args:
      space: the search space; its return range gives the prior (section E.1).
      min_std: smallest spread of a history, as a share of the prior's.
    """

    def select(key: PRNGKeyArray, state: BanditState) -> Int[Array, ""]:
        del key
        return jnp.argmin(shortfall(state.arms, state.best_return, space.return_range, min_std))

    return bandit(space, select)
