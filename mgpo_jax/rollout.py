"""The only episode loop: policies, baselines and demonstrators all act through it."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from envs.base import Agent, Environment, State, Task, TimeStep
from mgpo_jax.policy import Policy
from mgpo_jax.types import Episode, PRNGKeyArray, Query, Trajectory

NUM_SEGMENTS = 8


def rollout(
    key: PRNGKeyArray,
    env: Environment,
    policy: Policy,
    task: Task,
    query: Query,
    axis_name: str | None = None,
) -> Episode:
    """One episode of ``policy`` with the prompt of ``query`` on ``task``."""
    return run_episode(key, env, prompted(policy, query), task, axis_name)


def prompted(policy: Policy, query: Query) -> Agent:
    """The agent that follows ``policy`` under one prompt, greedily or exploring."""

    def act(key: PRNGKeyArray, distribution: Any) -> Array:
        return jnp.where(query.greedy, distribution.mode(), distribution.explore(key))

    def begin(key: PRNGKeyArray, task: Task, state: State, timestep: TimeStep) -> tuple:
        distribution, carry = policy.prefill(query.prompt, timestep.obs)
        action = act(key, distribution)
        return action, jnp.zeros((), bool), (carry, action)

    def proceed(key: PRNGKeyArray, memory: tuple, state: State, timestep: TimeStep) -> tuple:
        carry, action = memory
        distribution, carry = policy.decode(carry, action, timestep.obs)
        action = act(key, distribution)
        return action, jnp.zeros((), bool), (carry, action)

    def grow(memory: tuple, num_steps: int) -> tuple:
        carry, action = memory
        return policy.grow(carry, num_steps), action

    return Agent(begin, proceed, grow)


class _Loop(NamedTuple):
    """State of an episode in progress; ``record`` and ``rewards`` hold its steps so far."""

    time: Int[Array, ""]
    anyone_alive: Bool[Array, ""]
    alive: Bool[Array, ""]
    state: State
    timestep: TimeStep
    memory: Any
    record: Trajectory
    rewards: Array
    return_: Array


def run_episode(
    key: PRNGKeyArray, env: Environment, agent: Agent, task: Task, axis_name: str | None = None
) -> Episode:
    """One episode of ``agent`` on ``task``, of at most ``env.spec.horizon`` steps.

    Args:
      key: random key.
      env: the world (static).
      agent: who acts.
      task: one task of the world.
      axis_name: name of the ``vmap`` axis over episodes, if there is one. With it all lanes share
        one clock and the loop ends with the last live episode; without it ``vmap`` must keep a
        stopped lane's memory (such as a whole KV cache) by copying it at every step.
    """
    horizon = env.spec.horizon
    key_reset, key_begin, key_steps = jax.random.split(key, 3)
    state, timestep = env.reset(key_reset, task)
    action, quits, memory = agent.begin(key_begin, task, state, timestep)

    def anyone(alive: Bool[Array, ""]) -> Bool[Array, ""]:
        return alive if axis_name is None else jax.lax.pmax(alive.astype(jnp.int32), axis_name) > 0

    def take(
        time: Array, alive: Array, state: State, obs: Array, action: Array, memory: Any,
        record: Trajectory, rewards: Array, return_: Array,
    ) -> _Loop:  # fmt: skip
        state, timestep = env.step(state, action)
        now = (obs, action, timestep.goal, timestep.goal_reached, timestep.outcome)

        def put(rows: Array, row: Array) -> Array:
            row = jnp.where(alive, row, 0).astype(rows.dtype)
            return jax.lax.dynamic_update_index_in_dim(rows, row, time, 0)

        rows = [put(rows, row) for rows, row in zip(record[:-1], now, strict=True)]
        record = Trajectory(*rows, length=record.length + alive)
        rewards = put(rewards, timestep.reward)
        # Summed step by step: equal rewards make equal returns, whenever they came.
        return_ = return_ + jnp.where(alive, timestep.reward, 0.0)
        alive = alive & ~timestep.terminated & ~timestep.truncated
        return _Loop(
            time + 1, anyone(alive), alive, state, timestep, memory, record, rewards, return_
        )

    def advance(loop: _Loop) -> _Loop:
        step_key = jax.random.fold_in(key_steps, loop.time)
        action, quits, memory = agent.proceed(step_key, loop.memory, loop.state, loop.timestep)
        alive = loop.alive & ~quits
        return take(
            loop.time,
            alive,
            loop.state,
            loop.timestep.obs,
            action,
            memory,
            loop.record,
            loop.rewards,
            loop.return_,
        )

    blank = Trajectory(
        obs=jnp.zeros((horizon, *timestep.obs.shape), timestep.obs.dtype),
        actions=jnp.zeros((horizon, *action.shape), action.dtype),
        goals=jnp.zeros((horizon, *timestep.goal.shape), timestep.goal.dtype),
        goal_reached=jnp.zeros(horizon, bool),
        outcomes=jnp.zeros((horizon, *timestep.outcome.shape), timestep.outcome.dtype),
        length=jnp.zeros((), jnp.int32),
    )
    loop = take(
        jnp.zeros((), jnp.int32),
        ~quits,
        state,
        timestep.obs,
        action,
        memory,
        blank,
        jnp.zeros(horizon),
        jnp.zeros(()),
    )
    # Memory grows between segments, so that a step costs what has been seen, not the horizon.
    for start in range(1, horizon, -(-horizon // NUM_SEGMENTS)):
        end = min(start + -(-horizon // NUM_SEGMENTS), horizon)
        loop = loop._replace(memory=agent.grow(loop.memory, end - start))
        loop = jax.lax.while_loop(
            lambda loop, end=end: loop.anyone_alive & (loop.time < end), advance, loop
        )
    return Episode(loop.record, loop.rewards, loop.return_, loop.timestep.failed)
