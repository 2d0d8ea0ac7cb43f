"""Returns and advantages of one episode, whose rewards are 0 after its end.

Nothing is bootstrapped after the last step: an episode that reaches the horizon is over, and the policy
observes the timestep.
"""

from __future__ import annotations

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
