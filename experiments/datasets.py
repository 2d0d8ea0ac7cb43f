"""Collect demonstrations, in one process or in several, and write them as a dataset."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import envs
from envs.agents import Demonstrator
from envs.base import Environment
from experiments.demonstrations import Attempts, recorded_batches
from experiments.demonstrators import find_demonstrator
from experiments.runtime import Compiling, refuse_existing
from experiments.store.provenance import provenance, versions
from experiments.store.settings import CollectConfig, dataset_folder
from experiments.store.work import PIECES, long_work
from mgpo_jax import processes
from mgpo_jax.claims import check_place
from mgpo_jax.dataset import Dataset, finish_dataset, load_dataset
from mgpo_jax.files import remove_leftovers
from mgpo_jax.growing import GrowingFiles
from mgpo_jax.journal import Journal
from mgpo_jax.manifest import read_manifest
from mgpo_jax.progress import Progress
from mgpo_jax.tasks import benchmark_tasks, task_hashes

SMALLEST_TRAJECTORY = 200  # bytes on disk, to tell whether a dataset could fit at all


def collect(
    env: Environment, demonstrator: Demonstrator, num: int, seed: int, num_test_tasks: int
) -> tuple[Dataset, dict[str, Any]]:
    """Collect demonstrations as ``collected`` does.

    Returns:
      The dataset and facts about it, in every process.
    """
    kept: list[dict[str, np.ndarray]] = []
    own = collected(env, demonstrator, num, seed, num_test_tasks, kept.append)
    arrays = processes.arrays_from_first(
        lambda: {name: np.concatenate([part.pop(name) for part in kept]) for name in list(kept[0])}
    )
    facts = processes.from_first(lambda: own)
    assert arrays is not None
    assert facts is not None
    return Dataset(**arrays), facts


def collected(
    env: Environment,
    demonstrator: Demonstrator,
    num: int,
    seed: int,
    num_test_tasks: int,
    keep: Callable[[dict[str, np.ndarray]], None],
    journal: Journal | None = None,
) -> dict[str, Any] | None:
    """Collect demonstrations, none of them of a test task.

    Failed attempts are repeated with another key, so that a demonstrator that goes through all tasks in
    turn demonstrates each of them equally often, except in the last batch.

    Args:
      env: the world.
      demonstrator: the demonstrator.
      num: number of demonstrations to keep.
      seed: random seed of the tasks and the demonstrator.
      num_test_tasks: number of test tasks of the world.
      keep: called in process 0 with the arrays of a ``Dataset``, a batch of demonstrations at a time.
      journal: finished batches; those that it holds are not run again.

    Returns:
      Facts about the dataset; None in processes other than 0.

    Raises:
      DataError: if the demonstrator fails too often at one task, or nothing can be kept.
    """
    attempts, journal = Attempts(env.spec.name), journal or Journal()
    forbidden = task_hashes(env, benchmark_tasks(env, num_test_tasks))
    lengths, returns, variants = [], [], []
    num_test = num_failed = 0
    with Progress(num, "trajectory") as progress:
        batches = recorded_batches(env, demonstrator, num, seed, forbidden, attempts, journal)
        for record in batches:
            num_failed += int(record.pop("num_failed"))
            num_test += int(record.pop("num_test"))
            lengths.append(record["lengths"])
            progress.update(len(record["lengths"]))
            if processes.is_first():
                returns.append(record.pop("returns"))
                if demonstrator.variants:
                    variants.append(record["variants"])
                else:
                    del record["variants"]
                keep(record)
    if not processes.is_first():
        return None
    all_lengths = np.concatenate(lengths)
    return {
        "tried_again": attempts.num_again,
        "failed_episodes": num_failed,
        "dropped_test_tasks": num_test,
        "length": _describe(all_lengths),
        "at_horizon": float(np.mean(all_lengths == env.spec.horizon)),
        "hindsight_return": _describe(np.concatenate(returns)),
        **_count_variants(demonstrator.variants, variants),
    }


def _count_variants(names: Sequence[str], variants: Sequence[np.ndarray]) -> dict[str, Any]:
    """The manifest's entry on the variants of the world, if it has any."""
    if not names:
        return {}
    counts = np.bincount(np.concatenate(variants), minlength=len(names))
    return {"variants": dict(zip(names, counts.tolist(), strict=True))}


def _describe(values: np.ndarray) -> dict[str, Any]:
    """Mean, quartiles and a histogram for the manifest."""
    counts, edges = np.histogram(values, bins=16)
    return {
        "mean": float(values.mean()),
        "quartiles": np.percentile(values, [0, 25, 50, 75, 100]).tolist(),
        "histogram": {"counts": counts.tolist(), "edges": edges.round(3).tolist()},
    }


def collect_and_save(
    config: CollectConfig, wait: bool = False, go_on: str = "continue with --resume"
) -> None:
    """Collect a dataset and write it to its folder.

    Args:
      config: settings of the command.
      wait: whether to wait for another process that collects the same dataset.
      go_on: how to continue after an interruption, for messages.

    Raises:
      DataError: if the folder exists, or another process makes it.
      UsageError: if there is no such demonstrator, or unfinished work without ``--resume``.
    """
    world, env = envs.find(config.env), envs.make(config.env)
    name, demonstrator = find_demonstrator(world, env, config.demonstrator)
    folder = dataset_folder(config, name)
    made = {
        "env": config.env,
        "policy": name,
        "settings": dict(demonstrator.settings),
        "seed": config.seed,
    }
    asked = {**made, "trajectories": config.trajectories}
    if processes.from_first(lambda: config.resume and os.path.isdir(folder)):
        if processes.is_first():
            remove_leftovers(folder, PIECES)
            load_dataset(folder, env.spec, {**made, "num_trajectories": config.trajectories})
            print(f"{folder} is already finished", file=sys.stderr)
        return
    if processes.is_first() and not wait:
        refuse_existing(folder, "remove it", "choose another folder with --out")
    if processes.is_first():
        check_place(folder, num_bytes=config.trajectories * SMALLEST_TRAJECTORY)
    work_on = long_work(folder, asked, provenance(), config.resume, wait, go_on)
    with work_on as work, GrowingFiles(work.place) as files:
        compiling = Compiling(
            f"demonstrations of {name} in {config.env}",
            {"command": "collect", **made, "seed": None, "size": config.trajectories},
        )
        compiling.announce()
        cpu = time.process_time()
        facts = collected(
            env,
            demonstrator,
            config.trajectories,
            config.seed,
            world.num_test_tasks,
            files.append,
            work.journal,
        )
        compiling.done()
        cpu = processes.total(time.process_time() - cpu)
        if facts is not None:
            files.finish()
            finish_dataset(work.place, {**made, "versions": versions(), **facts})
    if facts is not None:
        _report(folder, facts, cpu)


def _report(folder: Path, facts: Mapping[str, Any], cpu: float) -> None:
    """Print what was collected, and the CPU time that it took."""
    _, manifest = read_manifest(folder)
    length, return_ = facts["length"]["mean"], facts["hindsight_return"]["mean"]
    print(
        f"{folder}: {manifest.num_trajectories} trajectories, {manifest.num_steps} steps\n"
        f"  mean length {length:.1f}, {100 * facts['at_horizon']:.1f} % at the horizon, "
        f"mean hindsight return {return_:.2f}\n"
        f"  {cpu:.1f} CPU-seconds with compilation",
        file=sys.stderr,
    )
