"""MGPO-BPE: act with the prompt most likely to beat the best return (paper, Eq. 4).

The returns of a prompt have a Gaussian posterior N(mu_p, sigma_p), with the prior N(mu_0, sigma_0). Since
P(R > R*) = sf((R* - mu_p) / sigma_p) decreases in its argument, the most likely prompt is the one with the
smallest argument. The tail probabilities are never computed, so they cannot underflow. (In the authors'
code 1 - cdf underflows; then all arms tie and the first one wins.)
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

    After a single return the standard deviation of an arm's returns is unknown, and the prior's is used.
    After more returns it is at least ``min_std`` times the prior's, so that equal returns do not collapse
    the posterior.
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
      min_std: smallest standard deviation of an arm's returns, as a fraction of the prior's.
    """

    def select(key: PRNGKeyArray, state: BanditState) -> Int[Array, ""]:
        del key
        return jnp.argmin(shortfall(state.arms, state.best_return, space.return_range, min_std))

    return bandit(space, select)
