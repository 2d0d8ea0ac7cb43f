"""Any world with noise on what the agent sees or does (paper, Table 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from envs.base import EnvSpec, State, Task, TimeStep
from envs.wrapper import Wrapper


class NoisyState(NamedTuple):
    """The state of the world behind the noise, and the key of the noise to come."""

    inner: State
    key: PRNGKeyArray


@dataclass(frozen=True)
class Noisy(Wrapper):
    """A world behind Gaussian noise.

    Attributes:
      obs_noise: standard deviation on every component of an observation, in its units.
      action_noise: standard deviation on continuous actions, which are clipped to [-1, 1] again; a
        discrete action is replaced by a random one with this probability.
    """

    obs_noise: float = 0.0
    action_noise: float = 0.0

    def __post_init__(self) -> None:
        if not all(0 <= size < math.inf for size in (self.obs_noise, self.action_noise)):
            raise ValueError(
                f"noise must be finite and not negative, found {self.obs_noise} on observations and "
                f"{self.action_noise} on actions"
            )
        if self.env.spec.discrete and self.action_noise > 1:
            raise ValueError(
                f"noise on discrete actions is a probability, found {self.action_noise}"
            )

    @property
    def spec(self) -> EnvSpec:
        return replace(self.env.spec, deterministic=False)

    def reset(self, key: PRNGKeyArray, task: Task) -> tuple[NoisyState, TimeStep]:
        key, key_reset, key_obs = jax.random.split(key, 3)
        inner, timestep = self.env.reset(key_reset, task)
        return NoisyState(inner, key), self._blur(key_obs, timestep)

    def step(self, state: NoisyState, action: Array) -> tuple[NoisyState, TimeStep]:
        key, key_action, key_obs = jax.random.split(state.key, 3)
        inner, timestep = self.env.step(state.inner, self._disturb(key_action, action))
        return NoisyState(inner, key), self._blur(key_obs, timestep)

    def _disturb(self, key: PRNGKeyArray, action: Array) -> Array:
        if not self.env.spec.discrete:
            noise = self.action_noise * jax.random.normal(key, action.shape)
            return jnp.clip(action + noise, -1.0, 1.0)
        key_whether, key_which = jax.random.split(key)
        other = jax.random.randint(key_which, (), 0, self.env.spec.action_dim, action.dtype)
        return jnp.where(jax.random.bernoulli(key_whether, self.action_noise), other, action)

    def _blur(self, key: PRNGKeyArray, timestep: TimeStep) -> TimeStep:
        noise = self.obs_noise * jax.random.normal(key, timestep.obs.shape)
        return timestep._replace(obs=timestep.obs + noise)
