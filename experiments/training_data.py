"""The dataset of a training: a user's own, or demonstrations that are collected if they are missing."""

from __future__ import annotations

import sys
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

import envs
from envs.base import Environment
from envs.errors import DataError
from envs.registry import World
from experiments.datasets import collect_and_save
from experiments.demonstrators import find_demonstrator
from experiments.store.presets import check_holdout
from experiments.store.settings import CollectConfig, PretrainConfig, dataset_folder
from experiments.store.work import PIECES
from mgpo_jax import processes
from mgpo_jax.dataset import Dataset, load_dataset, spec_of
from mgpo_jax.files import ExistsError, remove_leftovers
from mgpo_jax.manifest import mend_for, read_facts
from mgpo_jax.tasks import benchmark_tasks, task_hashes


def own_dataset(config: PretrainConfig, env: Environment | None) -> tuple[Dataset, Path, str]:
    """Load a user's own dataset.

    Args:
      config: settings of the training.
      env: the world that the dataset must fit, if any.

    Returns:
      The dataset, its folder and its hash.

    Raises:
      DataError: if the dataset is damaged, does not fit the world or contains a test task.
    """
    folder = config.data.data_folder
    assert folder is not None
    spec = env.spec if env is not None else spec_of(read_facts(folder))
    try:
        dataset, manifest = load_dataset(folder, spec)
    except DataError as error:
        if env is None:
            raise
        mend = f"import it again as it is in {config.env}, or leave --env out if it is of no world"
        raise DataError(str(error).replace(mend_for(folder), mend)) from None
    dataset = dataset.slice(0, config.data.trajectories)
    if env is not None and dataset.task_hashes is not None:
        mend = "leave its trajectory out of your logs and import them again"
        refuse_test_tasks(dataset, env, envs.find(config.env), folder, mend)
    return dataset, folder, manifest["sha256"]


def refuse_test_tasks(
    dataset: Dataset, env: Environment, world: World, folder: Path, mend: str
) -> None:
    """Raise ``DataError``, with ``mend`` in its message, if a trajectory is of a test task."""
    forbidden = task_hashes(env, benchmark_tasks(env, world.num_test_tasks))
    if dataset.task_hashes is not None and np.isin(dataset.task_hashes, forbidden).any():
        raise DataError(f"{folder} holds a test task; {mend}")


def prepare_dataset(
    config: PretrainConfig, world: World, env: Environment, go_on: str
) -> tuple[Dataset, Path, str]:
    """Load the dataset of a training, and collect it first if it does not exist.

    If another process is collecting it, this one waits.

    Args:
      config: settings of the training.
      world: the world's record.
      env: its environment.
      go_on: how to continue after an interruption, for messages.

    Returns:
      The dataset, its folder and its hash.

    Raises:
      DataError: if the dataset is damaged, out of date or contains a test task.
      UsageError: if the holdout leaves nothing to train on.
    """
    name, demonstrator = find_demonstrator(world, env, config.data.demonstrator)
    wanted = CollectConfig(
        env=config.env,
        demonstrator=name,
        trajectories=config.data.trajectories,
        seed=config.data.data_seed,
    )
    folder = dataset_folder(wanted, name)
    if processes.is_first():
        remove_leftovers(folder, PIECES)
    if not processes.from_first(folder.exists):
        text = f"no dataset in {folder} yet: {wanted.trajectories} trajectories are collected first"
        print(text, file=sys.stderr)
        # A single process may find that another command has just collected it; that is fine, too.
        alone = processes.count() == 1
        with suppress(ExistsError) if alone else nullcontext():
            collect_and_save(replace(wanted, resume=True), True, go_on)
        processes.exchange(b"")  # wait until every process can see it
    made = {
        "env": config.env,
        "policy": name,
        "seed": wanted.seed,
        "num_trajectories": wanted.trajectories,
    }
    dataset, manifest = load_dataset(folder, env.spec, made)
    settings, made_with = dict(demonstrator.settings), manifest.get("settings", {})
    if made_with != settings:
        raise DataError(
            f"{folder} was collected by the demonstrator with {made_with or 'no settings'}, which now "
            f"has {settings or 'none'}; remove it, and it is collected again"
        )
    refuse_test_tasks(dataset, env, world, folder, "remove it and collect it again")
    check_holdout(config.holdout, len(dataset))
    return dataset, folder, manifest["sha256"]
