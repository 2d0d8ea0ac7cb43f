"""Action distributions, the outputs of a policy, behind one interface.

An action head outputs ``head.num_params(action_dim)`` numbers; ``head.make(params)`` turns them into a
distribution with ``log_prob``, ``log_prob_of_sample``, ``sample``, ``mode``, ``explore``, ``tempered``,
``entropy`` and ``kl``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.errors import NotAvailableError


@runtime_checkable
class Distribution(Protocol):
    """A distribution over one action; leading axes of its parameters are batch axes."""

    def log_prob(self, action: Array) -> Float[Array, "*batch"]: ...

    def log_prob_of_sample(self, action: Array) -> Float[Array, "*batch"]:
        """The log-likelihood of an action that ``sample`` returned, as a policy gradient needs it.

        It differs from ``log_prob`` where samples are clipped: a clipped action stands for all values
        beyond its bound. The expectation of its gradient is 0, which that of ``log_prob`` is not.

        Raises:
          NotAvailableError: if there is no closed form.
        """
        ...

    def sample(self, key: PRNGKeyArray) -> Array: ...

    def mode(self) -> Array: ...

    def explore(self, key: PRNGKeyArray) -> Array:
        """An exploratory action: a sample, except that a mixture omits the noise of its components."""
        ...

    def tempered(self, temperature: Float[Array, ""]) -> Distribution:
        """The distribution whose density is this one's to the power of 1 / temperature, normalized."""
        ...

    def entropy(self) -> Float[Array, "*batch"]:
        """The entropy in nats.

        For continuous actions it is the differential entropy before actions are clipped, which may be
        negative.

        Raises:
          NotAvailableError: if there is no closed form.
        """
        ...

    def kl(self, other: Any) -> Float[Array, "*batch"]:
        """KL(self, other) for another distribution of the same kind, in nats.

        Raises:
          NotAvailableError: if there is no closed form.
        """
        ...


class Categorical(NamedTuple):
    """Distribution over the actions 0..A-1."""

    logits: Float[Array, "*batch A"]

    def log_prob(self, action: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
        # A product with a one-hot instead of a gather, whose gradient is a scatter that is slow on CPUs.
        one_hot = jax.nn.one_hot(action, self.logits.shape[-1])
        return jnp.sum(jax.nn.log_softmax(self.logits) * one_hot, axis=-1)

    def log_prob_of_sample(self, action: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
        return self.log_prob(action)

    def sample(self, key: PRNGKeyArray) -> Int[Array, "*batch"]:
        return jax.random.categorical(key, self.logits)

    def mode(self) -> Int[Array, "*batch"]:
        return jnp.argmax(self.logits, axis=-1)

    def explore(self, key: PRNGKeyArray) -> Int[Array, "*batch"]:
        return self.sample(key)

    def tempered(self, temperature: Float[Array, ""]) -> Categorical:
        return Categorical(self.logits / temperature)

    def entropy(self) -> Float[Array, "*batch"]:
        log_p = jax.nn.log_softmax(self.logits)
        return -jnp.sum(jnp.exp(log_p) * log_p, axis=-1)

    def kl(self, other: Categorical) -> Float[Array, "*batch"]:
        log_p, log_q = jax.nn.log_softmax(self.logits), jax.nn.log_softmax(other.logits)
        return jnp.sum(jnp.exp(log_p) * (log_p - log_q), axis=-1)


class Gaussian(NamedTuple):
    """Diagonal Gaussian whose actions are clipped to [-1, 1].

    The log-likelihood is that of the paper's Eq. 2. The authors train the mean by squared error and act
    with a fixed standard deviation of exp(-1), which is the head ``fixed_gaussian``.
    """

    mean: Float[Array, "*batch A"]
    log_std: Float[Array, "*batch A"]

    def log_prob(self, action: Float[Array, "*batch A"]) -> Float[Array, "*batch"]:
        return jax.scipy.stats.norm.logpdf(action, self.mean, jnp.exp(self.log_std)).sum(axis=-1)

    def log_prob_of_sample(self, action: Float[Array, "*batch A"]) -> Float[Array, "*batch"]:
        std = jnp.exp(self.log_std)
        inside = jax.scipy.stats.norm.logpdf(action, self.mean, std)
        beyond = jax.scipy.stats.norm.logcdf((jnp.sign(action) * self.mean - 1) / std)
        return jnp.sum(jnp.where(jnp.abs(action) < 1, inside, beyond), axis=-1)

    def sample(self, key: PRNGKeyArray) -> Float[Array, "*batch A"]:
        noise = jax.random.normal(key, self.mean.shape)
        return jnp.clip(self.mean + jnp.exp(self.log_std) * noise, -1.0, 1.0)

    def mode(self) -> Float[Array, "*batch A"]:
        return jnp.clip(self.mean, -1.0, 1.0)

    def explore(self, key: PRNGKeyArray) -> Float[Array, "*batch A"]:
        return self.sample(key)

    def tempered(self, temperature: Float[Array, ""]) -> Gaussian:
        return Gaussian(self.mean, self.log_std + 0.5 * jnp.log(temperature))

    def entropy(self) -> Float[Array, "*batch"]:
        return jnp.sum(self.log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e), axis=-1)

    def kl(self, other: Gaussian) -> Float[Array, "*batch"]:
        """The divergence before actions are clipped."""
        ratio = jnp.exp(self.log_std - other.log_std)
        shift = (self.mean - other.mean) * jnp.exp(-other.log_std)
        return jnp.sum((ratio**2 + shift**2 - 1) / 2 - jnp.log(ratio), axis=-1)


class Mixture(NamedTuple):
    """Mixture of M diagonal Gaussians; as its mode counts the mean of the most likely component.

    Not from the paper, which has a single Gaussian.
    """

    logits: Float[Array, "*batch M"]
    mean: Float[Array, "*batch M A"]
    log_std: Float[Array, "*batch M A"]

    def log_prob(self, action: Float[Array, "*batch A"]) -> Float[Array, "*batch"]:
        action = jnp.broadcast_to(action[..., None, :], self.mean.shape)
        of_components = Gaussian(self.mean, self.log_std).log_prob(action)
        return jax.nn.logsumexp(jax.nn.log_softmax(self.logits) + of_components, axis=-1)

    def log_prob_of_sample(self, action: Float[Array, "*batch A"]) -> Float[Array, "*batch"]:
        raise NotAvailableError("a mixture explores without the noise of its components")

    def sample(self, key: PRNGKeyArray) -> Float[Array, "*batch A"]:
        key_which, key_action = jax.random.split(key)
        which = jax.random.categorical(key_which, self.logits)
        return self._component(which).sample(key_action)

    def mode(self) -> Float[Array, "*batch A"]:
        return self._component(jnp.argmax(self.logits, axis=-1)).mode()

    def explore(self, key: PRNGKeyArray) -> Float[Array, "*batch A"]:
        """The mean of a random component. The noise within a component is that of the demonstrator's
        execution, not of its intention, so it is omitted."""
        return self._component(jax.random.categorical(key, self.logits)).mode()

    def tempered(self, temperature: Float[Array, ""]) -> Mixture:
        """Weights and components are tempered separately, which is exact if the components do not
        overlap."""
        log_std = self.log_std + 0.5 * jnp.log(temperature)
        # The integral of a component's density to the power of 1 / temperature.
        volume = (1 - 1 / temperature) * self.log_std.sum(axis=-1)
        return Mixture(self.logits / temperature + volume, self.mean, log_std)

    def entropy(self) -> Float[Array, "*batch"]:
        raise NotAvailableError("the entropy of a mixture has no closed form")

    def kl(self, other: Mixture) -> Float[Array, "*batch"]:
        raise NotAvailableError("the divergence of two mixtures has no closed form")

    def _component(self, which: Int[Array, "*batch"]) -> Gaussian:
        index = which[..., None, None]
        mean, log_std = (
            jnp.take_along_axis(leaf, index, axis=-2).squeeze(-2)
            for leaf in (self.mean, self.log_std)
        )
        return Gaussian(mean, log_std)


class Binned(NamedTuple):
    """Independent categorical distributions for every dimension, over N evenly spaced values from -1 to 1.

    An action is rounded to the nearest value; samples are uniform around the drawn value and clipped. Not
    from the paper, which has a Gaussian.
    """

    logits: Float[Array, "*batch A N"]

    def log_prob(self, action: Float[Array, "*batch A"]) -> Float[Array, "*batch"]:
        intervals = self.logits.shape[-1] - 1
        nearest = jnp.round((jnp.clip(action, -1.0, 1.0) + 1) / 2 * intervals).astype(jnp.int32)
        return jnp.sum(Categorical(self.logits).log_prob(nearest) + jnp.log(intervals / 2), axis=-1)

    def log_prob_of_sample(self, action: Float[Array, "*batch A"]) -> Float[Array, "*batch"]:
        return self.log_prob(action)  # a clipped sample is rounded to the value that was drawn

    def sample(self, key: PRNGKeyArray) -> Float[Array, "*batch A"]:
        key_value, key_around = jax.random.split(key)
        value = jax.random.categorical(key_value, self.logits)
        around = jax.random.uniform(key_around, value.shape, minval=-0.5, maxval=0.5)
        return jnp.clip(2 * (value + around) / (self.logits.shape[-1] - 1) - 1, -1.0, 1.0)

    def mode(self) -> Float[Array, "*batch A"]:
        """The mean over the most likely value and its two neighbors."""
        num_values = self.logits.shape[-1]
        likeliest = jnp.argmax(self.logits, axis=-1, keepdims=True)
        near = jnp.abs(jnp.arange(num_values) - likeliest) <= 1
        weights = jax.nn.softmax(jnp.where(near, self.logits, -jnp.inf))
        return weights @ jnp.linspace(-1.0, 1.0, num_values)

    def explore(self, key: PRNGKeyArray) -> Float[Array, "*batch A"]:
        return self.sample(key)

    def tempered(self, temperature: Float[Array, ""]) -> Binned:
        return Binned(self.logits / temperature)

    def entropy(self) -> Float[Array, "*batch"]:
        intervals = self.logits.shape[-1] - 1
        return jnp.sum(Categorical(self.logits).entropy() - jnp.log(intervals / 2), axis=-1)

    def kl(self, other: Binned) -> Float[Array, "*batch"]:
        return jnp.sum(Categorical(self.logits).kl(Categorical(other.logits)), axis=-1)


class Head(NamedTuple):
    """How the network's last layer parameterizes a distribution."""

    num_params: Callable[[int], int]
    make: Callable[[Array], Distribution]


NUM_COMPONENTS = 5
NUM_VALUES = 41
MIN_LOG_STD = -3.0  # so that the most precise dimension does not dominate the likelihood
MAX_LOG_STD = 1.0
FIXED_LOG_STD = -1.0  # authors' code


def _log_std(raw: Array) -> Array:
    """The log standard deviation within its bounds; near the lower one, which training approaches, there
    still is a gradient."""
    return jnp.minimum(MIN_LOG_STD + jax.nn.softplus(raw - MIN_LOG_STD), MAX_LOG_STD)


def _make_gaussian(params: Array) -> Gaussian:
    mean, log_std = jnp.split(params, 2, axis=-1)
    return Gaussian(mean, _log_std(log_std))


def _make_fixed_gaussian(params: Array) -> Gaussian:
    return Gaussian(jnp.tanh(params), jnp.full_like(params, FIXED_LOG_STD))


def _make_mixture(params: Array) -> Mixture:
    logits, rest = params[..., :NUM_COMPONENTS], params[..., NUM_COMPONENTS:]
    rest = rest.reshape(*rest.shape[:-1], 2, NUM_COMPONENTS, -1)
    return Mixture(logits, rest[..., 0, :, :], _log_std(rest[..., 1, :, :]))


def _make_binned(params: Array) -> Binned:
    return Binned(params.reshape(*params.shape[:-1], -1, NUM_VALUES))


HEADS = {
    "categorical": Head(lambda action_dim: action_dim, Categorical),
    "gaussian": Head(lambda action_dim: 2 * action_dim, _make_gaussian),
    "fixed_gaussian": Head(lambda action_dim: action_dim, _make_fixed_gaussian),
    "mixture": Head(lambda action_dim: NUM_COMPONENTS * (1 + 2 * action_dim), _make_mixture),
    "binned": Head(lambda action_dim: NUM_VALUES * action_dim, _make_binned),
}
"""The heads by name; the first is for discrete actions, the others for actions in [-1, 1]."""
