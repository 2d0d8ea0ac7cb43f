"""Episodes of a policy under a prompt."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from envs.agents import Agent
from envs.base import Environment, Episode, State, Task, TimeStep
from envs.episodes import run_episode
from envs.registry import Judgement
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import Prompt


class Query(NamedTuple):
    """A prompt, and how a policy acts under it in one episode."""

    prompt: Prompt
    greedy: Bool[Array, "*batch"]
    """Whether to take the mode of the action distribution instead of an exploratory action."""
    temperature: Float[Array, "*batch"] | None = None
    """Temperature of the distribution from which exploratory actions are drawn (None: the policy's own)."""


def rollout(
    key: PRNGKeyArray, env: Environment, policy: Policy, task: Task, query: Query
) -> Episode:
    """Run one episode of ``policy`` on ``task``, under the prompt of ``query``."""
    return run_episode(key, env, prompted(policy, query), task)


def act(
    key: PRNGKeyArray,
    distribution: Any,
    greedy: bool | Bool[Array, ""],
    temperature: Float[Array, ""] | None = None,
) -> Array:
    """An action from a distribution: its mode if ``greedy``, otherwise a random one."""
    explored = distribution if temperature is None else distribution.tempered(temperature)
    return jnp.where(greedy, distribution.mode(), explored.explore(key))


def acting_as(judged: Judgement) -> tuple[Bool[Array, ""], Float[Array, ""] | None]:
    """How a policy acts when it is judged: whether greedily, and at what temperature (None: its own)."""
    temperature = jnp.float32(judged.temperature) if judged.tempered else None
    return jnp.asarray(judged.mode == "greedy"), temperature


def prompted(policy: Policy, query: Query) -> Agent:
    """The agent that follows ``policy`` under one prompt, greedily or exploring."""

    def begin(key: PRNGKeyArray, task: Task, state: State, timestep: TimeStep) -> tuple:
        distribution, carry = policy.prefill(query.prompt, timestep.obs)
        action = act(key, distribution, query.greedy, query.temperature)
        return action, jnp.zeros((), bool), (carry, action)

    def proceed(key: PRNGKeyArray, memory: tuple, state: State, timestep: TimeStep) -> tuple:
        carry, action = memory
        distribution, carry = policy.decode(carry, action, timestep.obs)
        action = act(key, distribution, query.greedy, query.temperature)
        return action, jnp.zeros((), bool), (carry, action)

    def grow(memory: tuple, num_steps: int) -> tuple:
        carry, action = memory
        return policy.grow(carry, num_steps), action

    return Agent(begin, proceed, grow)
