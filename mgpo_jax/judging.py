"""Episodes of a policy under given prompts: their returns, the policy's uncertainty, or the episodes."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.base import Environment, Episode, Task
from envs.errors import DataError, NotAvailableError, UsageError
from mgpo_jax.adaptation import (
    CHECK_RETURNS,
    Judged,
    achieved_goals,
    judge,
)
from mgpo_jax.lanes import Grid, Lanes, Layout, cache_bytes, lay_out, over_lanes, together
from mgpo_jax.network_configs import TransformerConfig
from mgpo_jax.policy import LoadedPolicy, check_fits, transformer_policy
from mgpo_jax.rollout import Query, rollout
from mgpo_jax.settings import check_positive
from mgpo_jax.sharding import fetch, replicate, split
from mgpo_jax.tasks import num_tasks
from mgpo_jax.transformer import GoalTransformer


def evaluate(
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
    queries: Query,
    *,
    episodes: int,
    seed: int = 0,
) -> tuple[np.ndarray, int]:
    """Mean returns ``[S, N]`` of queries with leaves ``[S, N, ..]``, one for each seed and task.

    The second result is the number of episodes that ended because the simulation failed. The arguments are
    those of ``evaluate_fully``, which returns more.

    Raises:
      UsageError: for no episodes, or if the queries are not for as many tasks.
      DataError: if the policy was trained for another world, or a return is not finite.
    """
    judged = evaluate_fully(env, policy, tasks, queries, episodes=episodes, seed=seed)
    return np.asarray(judged.return_), int(judged.num_failed.sum())


def evaluate_fully(
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
    queries: Query,
    *,
    episodes: int,
    seed: int = 0,
) -> Judged:
    """Judge queries in fresh episodes.

    Args:
      env: the world.
      policy: the policy that acts.
      tasks: N tasks, stacked.
      queries: with leaves ``[S, N, ..]``, one for each seed and task.
      episodes: the number of episodes in which each query is judged.
      seed: random seed of the episodes.

    Returns:
      Numpy arrays: ``return_`` [S, N], ``num_failed`` [S, N] and, in worlds with M named goals,
      ``achieved`` [S, N, M].

    Raises:
      UsageError: for no episodes, or if the queries are not for as many tasks.
      DataError: if the policy was trained for another world, or a return is not finite.
    """
    check_positive(episodes=episodes)
    run = partial(_measurement, num_episodes=episodes)
    return _run_queries(run, env, policy, tasks, queries, seed)


class Uncertainty(NamedTuple):
    """How uncertain a policy was about its actions in its own episodes."""

    entropy: Float[Array, "*batch"]
    """Entropy of the action distributions in nats, averaged over the steps of the episode; NaN if the
    policy's head has no closed form of it."""
    return_: Float[Array, "*batch"]
    num_steps: Int[Array, "*batch"]


def uncertainty(
    env: Environment, policy: LoadedPolicy, tasks: Task, queries: Query, *, seed: int = 0
) -> Uncertainty:
    """The uncertainty of a policy about its actions under each query, in one fresh episode of each.

    Args:
      env: the world.
      policy: the policy that acts.
      tasks: N tasks, stacked.
      queries: with leaves ``[S, N, ..]``, one for each seed and task.
      seed: random seed of the episodes.

    Returns:
      Numpy arrays [S, N].

    Raises:
      UsageError: if the queries are not for as many tasks.
      DataError: if the policy was trained for another world, or a return is not finite.
    """
    return _run_queries(_uncertainty, env, policy, tasks, queries, seed)


@cache
def _uncertainty(env: Environment, network: TransformerConfig, layout: Layout) -> Any:
    """The program ``((lanes, queries), params) -> uncertainty``, compiled once per process."""

    def measure(own: tuple[Lanes, Query], params: Any) -> Uncertainty:
        lane, query = own
        done = rollout(lane.key, env, transformer_policy(network, params), lane.task, query)
        # One full pass over the episode gives the same distributions as its steps did.
        episode = done.trajectory
        distribution: Any = GoalTransformer(network).apply(
            params, query.prompt, episode.obs, episode.actions
        )
        real = jnp.arange(len(episode.obs)) < episode.length
        try:
            entropy = jnp.sum(jnp.where(real, distribution.entropy(), 0.0)) / episode.length
        except NotAvailableError:
            entropy = jnp.float32(jnp.nan)
        return Uncertainty(entropy, done.return_, episode.length)

    return over_lanes(env, layout, measure)


def _run_queries(
    program: Callable,
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
    queries: Query,
    seed: int,
) -> Any:
    """Run a program over queries with leaves ``[S, N, ..]``; returns numpy arrays with these axes.

    ``program(env, network, layout)`` makes a function ``((lanes, queries), params) -> result`` over all
    lanes, whose result has a field ``return_``.
    """
    check_fits(policy.config, env.spec)
    seeds, num = queries.prompt.mask.shape[:2]
    if num_tasks(tasks) != num:
        raise UsageError(
            f"there are {num_tasks(tasks)} tasks, and queries for {num}; the leaves of queries must be "
            "[S, N, ..] for N tasks"
        )
    grid = Grid(variants=1, seeds=seeds, tasks=num)
    layout = lay_out(env, grid.size, cache_bytes(policy.config))
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), queries)
    index = grid.padded(layout)
    own = (
        grid.lanes(layout, tasks, seed, {}),
        jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], flat),
    )
    run = program(env, policy.config, layout)
    found = fetch(run(split(layout.mesh, own), replicate(layout.mesh, policy.params)))
    found = jax.tree.map(lambda rows: grid.shape(rows)[0], found)
    if not (finite := np.isfinite(found.return_)).all():
        which, task = np.argwhere(~finite)[0]
        raise DataError(
            f"the return of an evaluation episode on task {task} with seed number {which} is "
            f"{found.return_[which, task]}; {CHECK_RETURNS}"
        )
    return found


@cache
def _measurement(
    env: Environment, network: TransformerConfig, layout: Layout, num_episodes: int
) -> Any:
    """The program ``((lanes, queries), params) -> judged``, compiled once per process."""

    def measure(own: tuple[Lanes, Query], params: Any) -> Judged:
        lane, query = own
        policy = transformer_policy(network, params)

        def episode(key: PRNGKeyArray) -> tuple[Array, Array, Array | None]:
            done = rollout(key, env, policy, lane.task, query)
            achieved = achieved_goals(env, done.trajectory)
            return done.return_, jnp.asarray(done.failed), achieved

        return judge(*jax.lax.map(episode, jax.random.split(lane.key, num_episodes)))

    return over_lanes(env, layout, measure)


@cache
def _player(env: Environment, network: TransformerConfig) -> Any:
    def episode(key: PRNGKeyArray, params: Any, task: Task, query: Query) -> Episode:
        return rollout(key, env, transformer_policy(network, params), task, query)

    return together(env, episode, in_axes=(0, None, None, None))


def play(
    key: PRNGKeyArray, env: Environment, policy: LoadedPolicy, task: Task, query: Query, num: int
) -> Episode:
    """Run ``num`` episodes of a policy on one task; the leaves are numpy arrays ``[num, ..]``."""
    keys = jax.random.split(key, num)
    return fetch(_player(env, policy.config)(keys, policy.params, task, query))
