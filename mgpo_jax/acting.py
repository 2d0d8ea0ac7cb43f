"""Acting step by step under a prompt, outside of compiled programs: on a robot, or in a gymnasium loop."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.episodes import segment_length
from envs.errors import UsageError
from mgpo_jax.network_configs import TransformerConfig
from mgpo_jax.policy import LoadedPolicy, prepared_policy
from mgpo_jax.prompts import Prompt, prompt_of
from mgpo_jax.rollout import act


@cache
def _compiled(config: TransformerConfig) -> tuple[Any, Any]:
    """Jitted prefill and decode with the prepared parameters as arguments, so that policies of one config
    share them."""

    def prefill(params: Any, prompt: Prompt, obs: jax.Array) -> Any:
        return prepared_policy(config, params).prefill(prompt, obs)

    def decode(params: Any, carry: Any, action: jax.Array, obs: jax.Array) -> Any:
        return prepared_policy(config, params).decode(carry, action, obs)

    return jax.jit(prefill), jax.jit(decode)


class Actor:
    """A policy that acts in an environment which the caller steps.

    The actor keeps the history of the episode, so it is given one observation at a time, in order:

        actor = Actor(load_policy(world), goals)
        action = actor.reset(obs)
        while not done:
            obs, done = step_the_world(action)
            action = actor.act(obs)

    Args:
      policy: a loaded policy.
      goals: the prompt, a ``Prompt`` or an array ``[k, G]`` of goals, of which the last is the task goal.
      greedy: whether to take the most likely action instead of exploring.
      seed: random seed of the exploration.
    """

    def __init__(
        self, policy: LoadedPolicy, goals: Prompt | Any, greedy: bool = True, seed: int = 0
    ) -> None:
        self.config = policy.config
        self._grow = prepared_policy(policy.config, None).grow
        self._key = jax.random.key(seed)
        self._greedy = jnp.asarray(greedy)
        params = policy.config.prepared(policy.params)  # once, not at every step
        self._prefill, self._decode = (
            partial(function, params) for function in _compiled(policy.config)
        )
        self._step = 0
        self.prompt = goals

    @property
    def prompt(self) -> Prompt:
        """The prompt; it may be replaced between two episodes."""
        return self._prompt

    @prompt.setter
    def prompt(self, goals: Prompt | Any) -> None:
        slots = self.config.max_prompt_length
        prompt = goals if isinstance(goals, Prompt) else prompt_of(goals, slots)
        wanted = (slots, self.config.goal_dim)
        if prompt.goals.shape != wanted:
            raise UsageError(
                f"the policy takes prompts of shape {list(wanted)} (goals, numbers in a goal), found "
                f"{list(prompt.goals.shape)}"
            )
        self._prompt = prompt

    def reset(self, obs: Any) -> np.ndarray:
        """Begin a new episode with its first observation; returns the first action."""
        distribution, self._carry = self._prefill(self._prompt, self._checked(obs))
        self._step, self._room = 1, 0
        return self._choose(distribution)

    def act(self, obs: Any) -> np.ndarray:
        """Continue the episode with the next observation; returns the next action.

        Raises:
          UsageError: if it is called before ``reset``, the observation has another shape or holds NaN, or
            the episode is longer than the policy was trained for.
        """
        horizon = self.config.horizon
        if not self._step:
            raise UsageError(
                "act was called before reset; call reset with the first observation of the episode"
            )
        if self._step >= horizon:
            raise UsageError(
                f"the policy was trained for episodes of {horizon} steps; call reset to begin another"
            )
        if not self._room:
            # As in the episode loop, the cache grows by several steps at a time, since each size is
            # compiled.
            self._room = min(segment_length(horizon), horizon - self._step)
            self._carry = self._grow(self._carry, self._room)
        distribution, self._carry = self._decode(self._carry, self._action, self._checked(obs))
        self._step, self._room = self._step + 1, self._room - 1
        return self._choose(distribution)

    def _choose(self, distribution: Any) -> np.ndarray:
        self._key, key = jax.random.split(self._key)
        self._action = act(key, distribution, self._greedy)
        return np.asarray(self._action)

    def _checked(self, obs: Any) -> jax.Array:
        array = np.asarray(obs)
        if array.shape != self.config.obs_shape:
            raise UsageError(
                f"the policy takes observations of shape {list(self.config.obs_shape)}, found "
                f"{list(array.shape)}"
            )
        fractions = np.issubdtype(array.dtype, np.inexact)
        if fractions and not np.issubdtype(self.config.obs_dtype, np.inexact):
            raise UsageError(
                f"the policy takes observations of {self.config.obs_dtype}, found {array.dtype}"
            )
        if fractions and not np.isfinite(array).all():
            raise UsageError("the observation holds NaN or infinity")
        return jnp.asarray(array, self.config.obs_dtype)
