"""The one episode loop, through which policies, baselines and demonstrators all act.

Under ``jax.vmap`` all episodes step together, and the loop ends with the longest one. If the condition of a
``while_loop`` differs between lanes, jax selects at every step between the old and the new value of
everything that the loop carries, including whole key-value caches. Here the condition is a single scalar
for all lanes, which avoids that.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from envs.agents import Agent, keeps_its_size
from envs.base import Environment, Episode, State, Task, TimeStep, Trajectory

# The loop runs in segments, between which the agent's memory grows. With more segments the cost of a step
# follows the number of steps so far rather than the horizon, but compilation takes longer.
MAX_SEGMENTS = 8
SEGMENT_STEPS = 32  # length of the shortest segment, in steps


def num_segments(horizon: int, most: int | None = None) -> int:
    """The number of segments of an episode with at most ``horizon`` steps.

    Args:
      horizon: the largest number of steps.
      most: the world's own limit on segments, if it has one (``Engine.max_segments``).
    """
    return max(1, min(MAX_SEGMENTS, most or MAX_SEGMENTS, horizon // SEGMENT_STEPS))


def segment_length(horizon: int, most: int | None = None) -> int:
    """The number of steps in a segment; the last one may be shorter. Arguments as of ``num_segments``."""
    return -(-horizon // num_segments(horizon, most))


@jax.custom_batching.custom_vmap
def anyone(alive: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether this episode (under ``vmap``, any episode of the batch) is still running."""
    return alive


@anyone.def_vmap
def _anyone_of_batch(size: int, batched: Any, alive: Bool[Array, "B"]) -> tuple[Array, bool]:
    del size, batched
    return anyone(jnp.any(alive)), False


class _Loop(NamedTuple):
    """The state of an episode in progress; ``trajectory`` and ``rewards`` hold its steps so far."""

    time: Int[Array, ""]
    anyone_alive: Bool[Array, ""]
    alive: Bool[Array, ""]
    state: State
    timestep: TimeStep
    memory: Any
    trajectory: Trajectory
    rewards: Array
    return_: Array
    last_obs: Array
    failed: Array


def run_episode(key: PRNGKeyArray, env: Environment, agent: Agent, task: Task) -> Episode:
    """Run one episode of ``agent`` on ``task``, of at most ``env.spec.horizon`` steps.

    Args:
      key: random key.
      env: the world (static).
      agent: the agent that acts.
      task: one task of the world.
    """
    horizon = env.spec.horizon
    key_reset, key_begin, key_steps = jax.random.split(key, 3)
    state, timestep = env.reset(key_reset, task)
    first_goal = timestep.achieved_goal
    action, quits, memory = agent.begin(key_begin, task, state, timestep)
    loop = _Loop(
        time=jnp.zeros((), jnp.int32),
        anyone_alive=jnp.ones((), bool),
        alive=~quits,
        state=state,
        timestep=timestep,
        memory=memory,
        trajectory=_blank(horizon, action, timestep, _intended(agent, memory)),
        rewards=jnp.zeros(horizon),
        return_=jnp.zeros(()),
        last_obs=timestep.obs,
        failed=jnp.asarray(timestep.failed),
    )
    loop = _act(env, agent, loop, action)

    def advance(loop: _Loop) -> _Loop:
        step_key = jax.random.fold_in(key_steps, loop.time)
        action, quits, memory = agent.proceed(step_key, loop.memory, loop.state, loop.timestep)
        return _act(env, agent, loop._replace(alive=loop.alive & ~quits, memory=memory), action)

    # With a memory of fixed size one segment suffices, which compiles in a fraction of the time.
    grows = agent.grow is not keeps_its_size
    segment = segment_length(horizon, env.engine.max_segments) if grows else horizon
    for start in range(1, horizon, segment):
        end = min(start + segment, horizon)
        loop = loop._replace(memory=agent.grow(loop.memory, end - start))
        loop = jax.lax.while_loop(
            lambda loop, end=end: loop.anyone_alive & (loop.time < end), advance, loop
        )
    return Episode(
        trajectory=loop.trajectory,
        rewards=loop.rewards,
        return_=loop.return_,
        last_obs=loop.last_obs,
        first_goal=first_goal,
        failed=loop.failed,
        decisions=agent.decisions(loop.memory),
    )


def replay(
    key: PRNGKeyArray, env: Environment, task: Task, actions: Array, length: Array
) -> Episode:
    """Replay an episode from its random key and its actions ``[T, ..]``, of which ``length`` are real.

    The actions may be in the compact encoding of logs (``mgpo_jax.adaptation.small_actions``).
    """
    actions = actions.astype(env.spec.zero_action().dtype)

    def begin(key: PRNGKeyArray, task: Task, state: State, timestep: TimeStep) -> tuple:
        del key, task, state, timestep
        return actions[0], length < 1, jnp.ones((), jnp.int32)

    def proceed(key: PRNGKeyArray, time: Array, state: State, timestep: TimeStep) -> tuple:
        del key, state, timestep
        return actions[jnp.minimum(time, len(actions) - 1)], time >= length, time + 1

    return run_episode(key, env, Agent(begin, proceed), task)


def _intended(agent: Agent, memory: Any) -> Array | None:
    """The latest action that an agent intended; None for an agent without ``Agent.intended``."""
    return None if agent.intended is None else agent.intended(memory)


def _blank(horizon: int, action: Array, timestep: TimeStep, intended: Array | None) -> Trajectory:
    """A trajectory without steps, with room for ``horizon`` of them."""

    def rows(row: Array) -> Array:
        return jnp.zeros((horizon, *row.shape), row.dtype)

    return Trajectory(
        obs=rows(timestep.obs),
        actions=rows(action),
        achieved_goals=rows(timestep.achieved_goal),
        goal_reached=jnp.zeros(horizon, bool),
        outcomes=rows(timestep.outcome),
        length=jnp.zeros((), jnp.int32),
        intended=None if intended is None else rows(action),
    )


def _act(env: Environment, agent: Agent, loop: _Loop, action: Array) -> _Loop:
    """Take one action and record the result, unless the episode has ended."""
    alive = loop.alive

    def put(rows: Any, row: Array) -> Array:
        row = jnp.where(alive, row, 0).astype(rows.dtype)
        return jax.lax.dynamic_update_index_in_dim(rows, row, loop.time, 0)

    state, timestep = env.step(loop.state, action)
    record, intended = loop.trajectory, _intended(agent, loop.memory)
    still_alive = alive & ~timestep.terminated & ~timestep.truncated
    return _Loop(
        time=loop.time + 1,
        anyone_alive=anyone(still_alive),
        alive=still_alive,
        state=state,
        timestep=timestep,
        memory=loop.memory,
        trajectory=Trajectory(
            obs=put(record.obs, loop.timestep.obs),
            actions=put(record.actions, action),
            achieved_goals=put(record.achieved_goals, timestep.achieved_goal),
            goal_reached=put(record.goal_reached, timestep.goal_reached),
            outcomes=put(record.outcomes, timestep.outcome),
            length=record.length + alive,
            intended=None if intended is None else put(record.intended, intended),
        ),
        rewards=put(loop.rewards, timestep.reward),
        # Summed step by step, so that equal rewards give equal returns whenever they come.
        return_=loop.return_ + jnp.where(alive, timestep.reward, 0.0),
        last_obs=jnp.where(alive, timestep.obs, loop.last_obs),
        failed=jnp.where(alive, timestep.failed, loop.failed),
    )
