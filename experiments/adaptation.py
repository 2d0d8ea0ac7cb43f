"""Run adaptations and save their results: choose tasks, run a method, summarize, write."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.base import Environment, Task
from envs.errors import UsageError
from envs.registry import World
from experiments.joining import OF_PROCESSES
from experiments.runtime import Compiling
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.layout import META
from experiments.store.policies import check_weights, far_prompts
from experiments.store.provenance import provenance
from experiments.store.result_files import load_results, write_results
from experiments.store.results import Results, results_of
from experiments.store.runs import changes
from experiments.store.summary import ADAPT_AGAIN, judged_episodes, summarize
from experiments.store.work import PIECES, long_work
from mgpo_jax import methods, processes
from mgpo_jax.files import hash_arrays, new_folder, remove_leftovers, to_json
from mgpo_jax.journal import Journal
from mgpo_jax.outcomes import Outcome
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.runner import sweep
from mgpo_jax.schema import Json, read_document
from mgpo_jax.seen_goals import warning_of_goals
from mgpo_jax.tasks import (
    evaluation_tasks,
    load_tasks,
    num_tasks,
    task_arrays,
    test_tasks,
)


def chosen_tasks(
    world: World, env: Environment, path: Path | None, validation: bool, validation_seed: int = 0
) -> Task:
    """The tasks to adapt to: validation tasks, a user's tasks, or the world's test tasks."""
    if validation:
        num = world.num_test_tasks
        return evaluation_tasks(env, num, num, seed=validation_seed)
    return load_tasks(path, env) if path is not None else test_tasks(world)


def _compiling(configs: Sequence[AdaptConfig], policy: LoadedPolicy, tasks: Task) -> Compiling:
    """What decides the programs of some adaptations, for the announcement that they are compiled."""
    first = configs[0]
    facts = {
        "command": "adapt",
        "env": first.env,
        "method": first.method,
        "noise": [first.obs_noise, first.action_noise],
        "network": to_json(policy.config),
        "lanes": [len(configs), first.seeds, num_tasks(tasks)],
    }
    return Compiling(f"{first.method} in {first.env}", facts)


def adapt_all(
    world: World,
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
    configs: Sequence[AdaptConfig],
    journal: Journal | None = None,
) -> list[Outcome]:
    """Adapt with each config; returns one outcome for each.

    The configs may only differ in the method's hyper-parameters. Finished pieces are kept in ``journal``.
    """
    first = configs[0]
    processes.check_agreed(
        {name: value for name, value in deciding(first, policy, tasks).items() if "sha256" in name}
    )

    compiling = _compiling(configs, policy, tasks)

    def begin() -> None:
        if processes.is_first():
            warn_of_goals(env, policy, tasks)
        compiling.announce()

    num_judged = judged_episodes(to_json(first), world)
    assert num_judged is not None
    judged = dataclasses.replace(world.judged, episodes=num_judged)
    outcomes = sweep(
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
        stop_at=first.stop_at,
        journal=journal,
        begin=begin,
    )
    compiling.done()
    return outcomes


NOT_DECIDING = (
    "config", "debug", "dry_run", "figures", "json", "out", "policy", "quiet", "resume", "sweep", "tasks",
    *OF_PROCESSES,
)  # fmt: skip
"""Settings that do not affect results, or whose content is hashed instead."""
ADDED = ("obs_noise", "action_noise", "stop_at")
"""Settings that were added later. They only count if they are not at their defaults, so that work begun
before they existed can be continued."""


def warn_of_goals(env: Environment, policy: LoadedPolicy, tasks: Task) -> None:
    """Warn on stderr if task goals are far from the goals that the policy was trained on."""
    goals = np.asarray(jax.vmap(env.task_goal)(tasks))
    if text := warning_of_goals(policy.seen_goals, goals, "task goals"):
        print(f"warning: {text}", file=sys.stderr)


def deciding(config: AdaptConfig, policy: LoadedPolicy, tasks: Task) -> dict[str, Any]:
    """All settings and hashes that determine the results of an adaptation, as JSON values."""
    settings = {k: v for k, v in to_json(config).items() if k not in NOT_DECIDING}
    for name in ADDED:
        if settings[name] == getattr(AdaptConfig, name):
            del settings[name]
    hashes = {"policy_sha256": policy.sha256, "tasks_sha256": hash_arrays(task_arrays(tasks))}
    return {**settings, **hashes}


def finished(folder: Path, config: AdaptConfig, policy: LoadedPolicy, tasks: Task) -> Results:
    """Load the results of an adaptation that was finished before ``--resume`` was given.

    Raises:
      UsageError: if they were made with other settings or tasks.
      DataError: if a file is damaged, or they were made with other weights.
    """
    remove_leftovers(folder, PIECES)
    results = load_results(folder)
    check_weights(results, policy, f"remove {folder}, or choose another folder with --out")
    made = read_document(folder / META, dict[str, Json], ADAPT_AGAIN).get("settings")
    now = deciding(config, policy, tasks)
    changed = changes(made, now) if isinstance(made, dict) else "made by an older version"
    if changed:
        raise UsageError(
            f"{folder} holds results of other settings: {changed}; choose another folder with --out"
        )
    return results


def adapt_and_save(
    folder: Path,
    config: AdaptConfig,
    world: World,
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
) -> Results | None:
    """Adapt to all tasks as ``config`` says, and write the results to a new folder.

    Returns:
      The results; None in processes other than 0.

    Raises:
      UsageError: if there is unfinished work, and ``--resume`` is not given or the settings differ.
      DataError: if the folder exists, another process makes it, or a return is not finite.
    """
    settings = deciding(config, policy, tasks)
    with long_work(folder, settings, provenance(), config.resume) as work:
        (outcome,) = adapt_all(world, env, policy, tasks, [config], work.journal)
        if not processes.is_first():
            return None
        results = results_with_summary(config, env, policy, tasks, outcome)
        write_results(work.place, results, folder, work.meta)
    return results


def save_outcome(
    folder: Path,
    config: AdaptConfig,
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
    outcome: Outcome,
    meta: Mapping[str, Any],
) -> None:
    """Write the results of an adaptation to a new folder; ``meta`` says how they were made."""
    with new_folder(folder) as place:
        results = results_with_summary(config, env, policy, tasks, outcome)
        write_results(place, results, folder, meta)


def _count_idle_episodes(results: Results) -> int:
    """The number of search and evaluation episodes that were not run because a search had stopped early."""
    used, last = results.episodes_used, results.last_judgement
    if used is None or last is None:
        return 0
    judged = judged_episodes(results.config, results.world)
    assert judged is not None
    later = (results.eval_returns.shape[-1] - 1 - last).sum()
    return int((results.returns.shape[-1] - used).sum() + judged * later)


def results_with_summary(
    config: AdaptConfig, env: Environment, policy: LoadedPolicy, tasks: Task, outcome: Outcome
) -> Results:
    """The results of an outcome, with the summary that tables show.

    Warns on stderr if optimized prompts are far from the goals that the policy was trained on.
    """
    optimum = np.asarray(jax.jit(jax.vmap(env.optimal_return))(tasks))
    results = results_of(outcome, to_json(config), env, tasks, optimum)
    summary = summarize(
        results,
        policy_sha256=policy.sha256,
        num_episodes=outcome.num_episodes - _count_idle_episodes(results),
        num_failed=outcome.num_failed,
        cpu_seconds=outcome.cpu_seconds,
    )
    results = dataclasses.replace(results, summary=summary)
    if text := far_prompts(results, f"optimized prompts of {config.folder}"):
        print(f"warning: {text}", file=sys.stderr)
    return results
