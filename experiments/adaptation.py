"""Adaptations as results on disk: choosing tasks, running a method, summarizing, saving."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from envs.base import Environment, Task
from envs.registry import World
from experiments.store.results import Results, results_of, save_results
from experiments.store.settings import AdaptConfig
from experiments.store.summary import summarize
from mgpo_jax import methods
from mgpo_jax.files import to_json
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.runner import Outcome, sweep
from mgpo_jax.tasks import evaluation_tasks, load_tasks, test_tasks


def chosen_tasks(world: World, env: Environment, path: Path | None, validation: bool) -> Task:
    """A user's tasks, the world's test tasks, or as many others."""
    if validation:
        return evaluation_tasks(env, world.num_test_tasks, world.num_test_tasks)
    return load_tasks(path, env) if path is not None else test_tasks(world)


def adapt_all(
    world: World,
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
    configs: Sequence[AdaptConfig],
) -> list[Outcome]:
    """One outcome for each config; they may differ in the method's hyper-parameters only."""
    first = configs[0]
    judged = world.judged
    if first.eval_episodes is not None:
        judged = dataclasses.replace(judged, episodes=first.eval_episodes)
    return sweep(
        env,
        policy,
        tasks,
        methods.find(first.method),
        [config.hyper for config in configs],
        seeds=first.seeds,
        episodes=first.episodes,
        seed=first.seed,
        eval_every=first.eval_every,
        judged=judged,
        keep_actions=first.keep_actions,
    )


def adapt_and_save(
    folder: Path,
    config: AdaptConfig,
    world: World,
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
) -> Results:
    """Adapt to all tasks as an ``AdaptConfig`` says, and write the results to a new folder."""
    (outcome,) = adapt_all(world, env, policy, tasks, [config])
    return save_outcome(folder, config, env, policy, tasks, outcome)


def save_outcome(
    folder: Path,
    config: AdaptConfig,
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
    outcome: Outcome,
) -> Results:
    """Write the results of an adaptation to a new folder."""
    optimum = np.asarray(jax.jit(jax.vmap(env.optimal_return))(tasks))
    results = results_of(outcome, to_json(config), env, tasks, optimum)
    summary = summarize(
        results,
        policy_sha256=policy.sha256,
        num_episodes=outcome.num_episodes,
        num_failed=outcome.num_failed,
        cpu_seconds=outcome.cpu_seconds,
    )
    results = dataclasses.replace(results, summary=summary)
    save_results(folder, results)
    return results
