"""Returns and advantages of one episode, whose rewards are 0 after its end, and the loss of PPO.

Nothing is bootstrapped after the last step: an episode that reaches the horizon is over, and the policy
observes the timestep. The steps can also be decisions of a high level, each with a reward of its own.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def returns_to_go(
    rewards: Float[Array, "T"], discount: float | Float[Array, ""]
) -> Float[Array, "T"]:
    """The discounted returns-to-go, G_t = r_t + discount * G_{t+1}."""

    def back(after: Array, reward: Array) -> tuple[Array, Array]:
        now = reward + discount * after
        return now, now

    return jax.lax.scan(back, jnp.zeros(()), rewards, reverse=True)[1]


def advantages(
    rewards: Float[Array, "T"],
    values: Float[Array, "T"],
    real: Bool[Array, "T"],
    discount: float | Float[Array, ""],
    gae_lambda: float | Float[Array, ""],
) -> Float[Array, "T"]:
    """Generalized advantage estimates (Schulman et al., 2016, Eq. 16); 0 at steps that are not ``real``.

    The value after the last real step is taken as 0.
    """
    values = jnp.where(real, values, 0.0)
    errors = rewards + discount * jnp.append(values[1:], 0.0) - values

    def back(after: Array, error: Array) -> tuple[Array, Array]:
        now = error + discount * gae_lambda * after
        return now, now

    found = jax.lax.scan(back, jnp.zeros(()), jnp.where(real, errors, 0.0), reverse=True)[1]
    return jnp.where(real, found, 0.0)


def real_mean(values: Float[Array, "K T"], real: Bool[Array, "K T"]) -> Float[Array, ""]:
    """Mean over the real steps."""
    return jnp.sum(jnp.where(real, values, 0.0)) / jnp.maximum(real.sum(), 1)


class Estimates(NamedTuple):
    """What PPO knows of a round's episodes before its first gradient step; no gradient goes through it."""

    gains: Float[Array, "K T"]
    """Advantages, normalized over the real steps of the round."""
    targets: Float[Array, "K T"]
    """What the values should become."""


def estimates(
    rewards: Float[Array, "K T"],
    values: Float[Array, "K T"],
    real: Bool[Array, "K T"],
    discount: float | Float[Array, ""],
    gae_lambda: float | Float[Array, ""],
) -> Estimates:
    """The estimates of K episodes, from the values before the update."""
    each = jax.vmap(advantages, (0, 0, 0, None, None))
    gains = each(rewards, values, real, discount, gae_lambda)
    targets = jax.lax.stop_gradient(gains + values)
    mean = real_mean(gains, real)
    spread = jnp.sqrt(real_mean((gains - mean) ** 2, real))
    return Estimates(jax.lax.stop_gradient((gains - mean) / (spread + 1e-8)), targets)


def ppo_loss(
    log_ratio: Float[Array, "K T"],
    values: Float[Array, "K T"],
    known: Estimates,
    real: Bool[Array, "K T"],
    clip: float | Float[Array, ""],
    value_weight: float | Float[Array, ""],
) -> Float[Array, ""]:
    """The clipped objective and the error of the values (Schulman et al., 2017, Eqs. 7 and 9), as a loss.

    Args:
      log_ratio: log pi(a_t) - log pi_old(a_t) of the actions that were taken.
      values: the values of the network that is trained.
      known: the estimates of the round.
      real: the steps that count.
      clip: largest deviation of a ratio from 1.
      value_weight: weight of the squared error of the values.
    """
    ratio = jnp.exp(jnp.where(real, log_ratio, 0.0))
    clipped = jnp.clip(ratio, 1 - clip, 1 + clip)
    gained = jnp.minimum(ratio * known.gains, clipped * known.gains)
    missed = (values - known.targets) ** 2
    return -real_mean(gained, real) + value_weight * real_mean(missed, real)
