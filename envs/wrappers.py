"""Wrappers: worlds that modify other worlds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import Environment, State, Task, TimeStep
from envs.errors import UsageError
from envs.specs import Engine, EnvSpec


@dataclass(frozen=True)
class Wrapper(Environment):
    """Delegates everything to ``env``; subclasses override what they change."""

    env: Environment

    @property
    def spec(self) -> EnvSpec:
        return self.env.spec

    @property
    def engine(self) -> Engine:
        return self.env.engine

    def sample_task(self, key: PRNGKeyArray) -> Task:
        return self.env.sample_task(key)

    def sample_goal(self, key: PRNGKeyArray) -> Float[Array, "G"]:
        return self.env.sample_goal(key)

    def task_goal(self, task: Task) -> Float[Array, "G"]:
        return self.env.task_goal(task)

    def optimal_return(self, task: Task) -> Float[Array, ""]:
        return self.env.optimal_return(task)

    def solvable(self, task: Task) -> Bool[Array, ""]:
        return self.env.solvable(task)

    @property
    def goal_names(self) -> tuple[str, ...]:
        return self.env.goal_names

    def num_parts(self, task: Task) -> Int[Array, ""]:
        return self.env.num_parts(task)

    @property
    def goal_set(self) -> np.ndarray:
        return self.env.goal_set

    def expert_goal(self, state: State, num_steps: int) -> Float[Array, "G"]:
        return self.env.expert_goal(state, num_steps)

    def fingerprint(self, task: Task) -> Int[Array, "F"]:
        return self.env.fingerprint(task)

    def check_task(self, tasks: Task) -> None:
        self.env.check_task(tasks)

    def check_solvable(self, tasks: Task) -> None:
        self.env.check_solvable(tasks)

    def reset(self, key: PRNGKeyArray, task: Task) -> tuple[State, TimeStep]:
        return self.env.reset(key, task)

    def step(self, state: State, action: Array) -> tuple[State, TimeStep]:
        return self.env.step(state, action)


class NoisyState(NamedTuple):
    """The state of the wrapped world, and the random key of the noise in later steps."""

    inner: State
    key: PRNGKeyArray


class NoNoiseError(ValueError):
    """No noise of any size can be applied to what a world has."""


@dataclass(frozen=True)
class Noisy(Wrapper):
    """A world with noise on observations and actions (paper, Table 3).

    Attributes:
      obs_noise: standard deviation of Gaussian noise on every component of an observation, in its units.
      action_noise: standard deviation of Gaussian noise on continuous actions, which are then clipped to
        [-1, 1] again; the probability with which a discrete action is replaced by a random one.
      obs_range: half widths of uniform noise on each component of the flattened observation, in its units;
        empty for none.
    """

    obs_noise: float = 0.0
    action_noise: float = 0.0
    obs_range: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        sizes = (self.obs_noise, self.action_noise, *self.obs_range)
        if not all(0 <= size < math.inf for size in sizes):
            raise ValueError(
                f"noise must be finite and not negative, found {self.obs_noise} on observations and "
                f"{self.action_noise} on actions{self._range_text()}"
            )
        if len(self.obs_range) not in (0, self.env.spec.obs.size):
            raise ValueError(
                f"uniform noise needs a half width for each component of an observation, of which "
                f"{self.env.spec.name} has {self.env.spec.obs.size}, found {len(self.obs_range)}"
            )
        if self.env.spec.discrete and self.action_noise > 1:
            raise ValueError(
                f"noise on discrete actions is a probability, found {self.action_noise}"
            )
        if (self.obs_noise or any(self.obs_range)) and not self.env.spec.obs.is_float:
            raise NoNoiseError(
                f"noise on observations needs floating-point observations, those of "
                f"{self.env.spec.name} are {self.env.spec.obs}"
            )
        if (self.obs_noise or any(self.obs_range)) and self.env.spec.layout is not None:
            raise NoNoiseError(
                "noise on observations needs quantities on a continuous scale, but those of "
                f"{self.env.spec.name} are codes and counts"
            )

    def _range_text(self) -> str:
        """The widths of uniform noise as text for a message."""
        if not self.obs_range:
            return ""
        return f", uniform within {min(self.obs_range)} to {max(self.obs_range)} on observations"

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

    def expert_goal(self, state: NoisyState, num_steps: int) -> Float[Array, "G"]:
        return self.env.expert_goal(state.inner, num_steps)

    def _disturb(self, key: PRNGKeyArray, action: Array) -> Array:
        if not self.env.spec.discrete:
            noise = self.action_noise * jax.random.normal(key, action.shape)
            return jnp.clip(action + noise, -1.0, 1.0)
        key_whether, key_which = jax.random.split(key)
        other = jax.random.randint(key_which, (), 0, self.env.spec.action_dim, action.dtype)
        return jnp.where(jax.random.bernoulli(key_whether, self.action_noise), other, action)

    def _blur(self, key: PRNGKeyArray, timestep: TimeStep) -> TimeStep:
        if not self.env.spec.obs.is_float:
            return timestep
        shape, dtype = timestep.obs.shape, timestep.obs.dtype
        noise = self.obs_noise * jax.random.normal(key, shape)
        if self.obs_range:
            draw = jax.random.uniform(jax.random.fold_in(key, 1), shape, minval=-1.0)
            noise += jnp.asarray(self.obs_range).reshape(shape) * draw
        return timestep._replace(obs=timestep.obs + noise.astype(dtype))


def behind_noise(
    env: Environment, obs_noise: float = 0.0, action_noise: float = 0.0
) -> Environment:
    """Wrap a world in noise of these sizes (``Noisy``); returns the world itself if both are 0.

    Raises:
      UsageError: if such noise cannot be applied to the world.
    """
    return noisy(env, obs_noise, action_noise) if obs_noise or action_noise else env


def noisy(
    env: Environment,
    obs_noise: float = 0.0,
    action_noise: float = 0.0,
    obs_range: tuple[float, ...] = (),
) -> Noisy:
    """Wrap a world in noise of the sizes that the flags of a command give.

    Raises:
      UsageError: if such noise cannot be applied to the world; the message names the flag.
    """
    for name, sizes in {
        "--obs-noise": (obs_noise, 0.0, obs_range),
        "--action-noise": (0.0, action_noise, ()),
    }.items():
        try:
            Noisy(env, *sizes)
        except ValueError as error:
            other_size = "" if isinstance(error, NoNoiseError) else "give another size, or "
            raise UsageError(f"{name}: {error}; {other_size}leave it out") from None
    return Noisy(env, obs_noise, action_noise, obs_range)
