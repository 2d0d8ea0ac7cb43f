"""Action distributions: what a policy returns and training scores, behind one interface.

A policy head puts out ``head.num_params(action_dim)`` numbers; ``head.make(params)`` turns them into
a distribution with ``log_prob``, ``sample`` and ``mode``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mgpo_jax.types import PRNGKeyArray


@runtime_checkable
class Distribution(Protocol):
    """A distribution over one action; leading axes of its parameters are axes of its results."""

    def log_prob(self, action: Array) -> Float[Array, "*batch"]: ...

    def sample(self, key: PRNGKeyArray) -> Array: ...

    def mode(self) -> Array: ...


class Categorical(NamedTuple):
    """Distribution over the actions 0..A-1."""

    logits: Float[Array, "*batch A"]

    def log_prob(self, action: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
        # A one-hot product instead of a gather: the gather's backward scatter is slow on CPU.
        one_hot = jax.nn.one_hot(action, self.logits.shape[-1])
        return jnp.sum(jax.nn.log_softmax(self.logits) * one_hot, axis=-1)

    def sample(self, key: PRNGKeyArray) -> Int[Array, "*batch"]:
        return jax.random.categorical(key, self.logits)

    def mode(self) -> Int[Array, "*batch"]:
        return jnp.argmax(self.logits, axis=-1)


class Gaussian(NamedTuple):
    """Diagonal Gaussian with its mean squashed into (-1, 1) and a learned spread.

    The authors train the mean by squared error and act with a fixed spread of exp(-1); the
    log-likelihood here is the paper's Eq. 2.
    """

    mean: Float[Array, "*batch A"]
    log_std: Float[Array, "*batch A"]

    def log_prob(self, action: Float[Array, "*batch A"]) -> Float[Array, "*batch"]:
        z = (action - self.mean) * jnp.exp(-self.log_std)
        return jnp.sum(-0.5 * z**2 - self.log_std - 0.5 * jnp.log(2 * jnp.pi), axis=-1)

    def sample(self, key: PRNGKeyArray) -> Float[Array, "*batch A"]:
        noise = jax.random.normal(key, self.mean.shape)
        return jnp.clip(self.mean + jnp.exp(self.log_std) * noise, -1.0, 1.0)

    def mode(self) -> Float[Array, "*batch A"]:
        return self.mean


class Head(NamedTuple):
    """How the network's last layer parameterizes a distribution."""

    num_params: Callable[[int], int]
    make: Callable[[Array], Distribution]


def _make_gaussian(params: Array) -> Gaussian:
    mean, log_std = jnp.split(params, 2, axis=-1)
    return Gaussian(jnp.tanh(mean), jnp.clip(log_std, -5.0, 1.0))


HEADS = {
    "categorical": Head(lambda action_dim: action_dim, Categorical),
    "gaussian": Head(lambda action_dim: 2 * action_dim, _make_gaussian),
}
