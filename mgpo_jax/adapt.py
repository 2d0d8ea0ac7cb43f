"""Online adaptation: ask for a prompt, run an episode with it, tell the result (paper, section 3.2).

The network stays frozen. Everything here is for one task; callers ``vmap`` over tasks and seeds, with
the name of that axis so that all episodes share one clock (see ``rollout.run_episode``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from envs.base import Environment, Task
from mgpo_jax.optimizers import PromptOptimizer
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import single_goal
from mgpo_jax.rollout import rollout
from mgpo_jax.types import Episode, PRNGKeyArray, Prompt, Query


class AdaptState(NamedTuple):
    """An adaptation in progress."""

    key: PRNGKeyArray
    optimizer: Any
    """State of the prompt optimizer."""


class AdaptLog(NamedTuple):
    """What happened in N consecutive episodes."""

    returns: Float[Array, "*batch N"]
    failed: Bool[Array, "*batch N"]
    """Whether the world broke down."""
    greedy: Bool[Array, "*batch N"]
    prompts: Prompt
    """The prompts that were run, [N, P, ..]."""
    best: Prompt
    """The best prompt after each episode, [N, P, ..]."""


class AdaptResult(NamedTuple):
    """A finished adaptation."""

    log: AdaptLog
    prompt: Prompt
    """The optimized prompt p*."""


def start_adaptation(
    key: PRNGKeyArray, env: Environment, policy: Policy, optimizer: PromptOptimizer, task: Task
) -> AdaptState:
    """The state before the first episode on ``task``."""
    key_init, key_run = jax.random.split(key)
    task_goal = env.task_goal(task)
    first = Query(single_goal(task_goal, policy.num_slots), jnp.ones((), bool))
    shapes = jax.eval_shape(lambda: rollout(key, env, policy, task, first)).trajectory
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return AdaptState(key_run, optimizer.init(key_init, task_goal, blank))


def continue_adaptation(
    state: AdaptState,
    env: Environment,
    policy: Policy,
    optimizer: PromptOptimizer,
    task: Task,
    num_episodes: int,
    axis_name: str | None = None,
) -> tuple[AdaptState, AdaptLog]:
    """The next ``num_episodes`` episodes of an adaptation."""

    def episode(state: AdaptState, _: None) -> tuple[AdaptState, AdaptLog]:
        key, key_ask, key_rollout = jax.random.split(state.key, 3)
        query, asked = optimizer.ask(key_ask, state.optimizer)
        result = rollout(key_rollout, env, policy, task, query, axis_name)
        told = optimizer.tell(asked, query, result)
        log = AdaptLog(
            result.return_,
            jnp.asarray(result.failed),
            query.greedy,
            query.prompt,
            optimizer.best(told),
        )
        return AdaptState(key, told), log

    return jax.lax.scan(episode, state, length=num_episodes)


def adapt(
    key: PRNGKeyArray,
    env: Environment,
    policy: Policy,
    optimizer: PromptOptimizer,
    task: Task,
    num_episodes: int,
    axis_name: str | None = None,
) -> AdaptResult:
    """Search the prompt for one task within ``num_episodes`` episodes (Eq. 1)."""
    state = start_adaptation(key, env, policy, optimizer, task)
    state, log = continue_adaptation(state, env, policy, optimizer, task, num_episodes, axis_name)
    return AdaptResult(log, optimizer.best(state.optimizer))


def evaluate(
    key: PRNGKeyArray,
    env: Environment,
    policy: Policy,
    task: Task,
    prompt: Prompt,
    axis_name: str | None = None,
) -> Episode:
    """One greedy episode under ``prompt``, outside of any search."""
    return rollout(key, env, policy, task, Query(prompt, jnp.ones((), bool)), axis_name)
