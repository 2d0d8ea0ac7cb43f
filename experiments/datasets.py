"""Datasets of demonstrations: collecting them, and having the one that a training needs."""

from __future__ import annotations

import sys
import time
from collections import Counter
from functools import cache
from itertools import count, islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from tqdm import tqdm

import envs
from envs.base import Demonstrator, Environment, Episode
from envs.episodes import run_episode
from envs.errors import DataError, UsageError, nearest
from envs.registry import World
from experiments.runtime import refuse_existing
from experiments.store.provenance import versions
from experiments.store.settings import CollectConfig, PretrainConfig, dataset_folder
from mgpo_jax.dataset import STEP_ARRAYS, Dataset, hash_task, load_dataset, save_dataset
from mgpo_jax.runner import together
from mgpo_jax.sharding import fetch
from mgpo_jax.tasks import benchmark_tasks, task_hashes

MAX_TRIES = 20  # at one demonstration
BATCH = 250  # episodes at once: enough to fill the vector units, few enough to stay in cache


def find_demonstrator(world: World, env: Environment, name: str | None) -> tuple[str, Demonstrator]:
    """The demonstrator of that name; the world's first for None.

    Raises:
      UsageError: if the world has none, or none of that name.
    """
    known = world.demonstrators(env)
    if not known:
        raise UsageError(
            f"{world.name} has no demonstrators, so no dataset can be collected; train on one of your own "
            "with mgpo_jax.pretrain"
        )
    name = name or next(iter(known))
    if name not in known:
        raise nearest(name, known, "demonstrator")
    return name, known[name]


class Demonstration(NamedTuple):
    """One attempt at a demonstration."""

    fingerprint: Int[Array, "*batch F"]
    episode: Episode
    return_: Float[Array, "*batch"]
    """On the task that the trajectory happens to solve."""
    good: Bool[Array, "*batch"]
    """Whether to keep it, if its task is no test task."""


@cache
def demonstration_program(env: Environment, sample_task: Any, agent: Any, judge: Any) -> Any:
    """``(keys, indices, weights) -> demonstrations``, compiled once a process."""

    def demonstrate(key: PRNGKeyArray, index: Array, weights: Any) -> Demonstration:
        key_task, key_episode = jax.random.split(key)
        task = sample_task(key_task, index)
        episode = run_episode(key_episode, env, agent(weights), task)
        episode = episode._replace(failed=jnp.asarray(episode.failed))
        keeps, hindsight_return = judge
        return_ = hindsight_return(episode.trajectory) if hindsight_return else episode.return_
        good = keeps(episode) & ~episode.failed
        return Demonstration(env.fingerprint(task), episode, return_, good)

    return together(env, demonstrate, in_axes=(0, 0, None))


def program_of(env: Environment, demonstrator: Demonstrator) -> Any:
    """The program that demonstrates; the demonstrator's weights enter it as data."""
    judge = (demonstrator.keeps, demonstrator.hindsight_return)
    return demonstration_program(env, demonstrator.sample_task, demonstrator.agent, judge)


class _Attempts:
    """Numbers of the demonstrations to try next: fresh ones, after those that failed before."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.fresh = count()
        self.again = np.zeros(0, int)
        self.num_again = 0
        self.tries: Counter[int] = Counter()

    def next_batch(self) -> np.ndarray:
        new = list(islice(self.fresh, BATCH - len(self.again)))
        return np.concatenate([self.again, new]).astype(np.int32)

    def failed(self, indices: np.ndarray) -> None:
        """Note the ones to try again."""
        self.again = indices
        self.tries.update(indices.tolist())
        if self.tries and (worst := self.tries.most_common(1)[0])[1] >= MAX_TRIES:
            raise DataError(
                f"the demonstrator failed {MAX_TRIES} times at task {worst[0]} of {self.name}"
            )
        self.num_again += len(indices)


def _rows(found: Demonstration, hashes: np.ndarray, rows: np.ndarray) -> dict[str, np.ndarray]:
    """What a dataset keeps of some demonstrations."""
    episode, trajectory = found.episode, found.episode.trajectory
    real = np.arange(trajectory.goal_reached.shape[1]) < trajectory.length[rows, None]
    steps = {name: np.asarray(getattr(trajectory, name))[rows][real] for name in STEP_ARRAYS}
    return {
        **steps,
        "lengths": trajectory.length[rows],
        "task_hashes": hashes[rows],
        "rewards": episode.rewards[rows][real],
        "last_obs": episode.last_obs[rows],
        "returns": found.return_[rows],
    }


def collect(
    env: Environment,
    demonstrator: Demonstrator,
    num: int,
    seed: int,
    num_test_tasks: int,
) -> tuple[Dataset, dict[str, Any]]:
    """Demonstrations, none of them of a test task, and facts about them.

    Those that are not worth keeping are tried again with another key, so that a demonstrator that goes
    through all tasks in turn demonstrates each of them equally often, but for the last batch.

    Raises:
      DataError: if the demonstrator fails ``MAX_TRIES`` times at one of them.
    """
    demonstrate = program_of(env, demonstrator)
    forbidden = task_hashes(env, benchmark_tasks(env, num_test_tasks))
    attempts = _Attempts(env.spec.name)
    kept: list[dict[str, np.ndarray]] = []
    num_kept = num_test = num_failed = fruitless = 0
    with tqdm(total=num, unit="trajectory", disable=None) as progress:
        for batch in count():
            keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), batch), BATCH)
            indices = attempts.next_batch()
            found = fetch(demonstrate(keys, indices, demonstrator.weights))
            hashes = np.array([hash_task(one) for one in found.fingerprint], np.uint64)
            unseen = ~np.isin(hashes, forbidden)
            attempts.failed(indices[unseen & ~found.good])
            rows = np.flatnonzero(unseen & found.good)[: num - num_kept]
            kept.append(_rows(found, hashes, rows))
            num_kept += len(rows)
            num_failed += int(found.episode.failed.sum())
            num_test += int((~unseen).sum())
            progress.update(len(rows))
            if num_kept >= num:
                break
            fruitless = 0 if len(rows) else fruitless + 1
            if fruitless >= MAX_TRIES:
                raise DataError(
                    f"nothing to keep in {MAX_TRIES * BATCH} attempts: nearly every task of "
                    f"{env.spec.name} is a test task or its demonstrations are dropped"
                )
    arrays = {name: np.concatenate([part[name] for part in kept]) for name in kept[0]}
    returns = arrays.pop("returns")
    dataset = Dataset(**arrays)
    facts = {
        "tried_again": attempts.num_again,
        "failed_episodes": num_failed,
        "dropped_test_tasks": num_test,
        "length": _describe(dataset.lengths),
        "at_horizon": float(np.mean(dataset.lengths == env.spec.horizon)),
        "hindsight_return": _describe(returns),
    }
    return dataset, facts


def _describe(values: np.ndarray) -> dict[str, Any]:
    """Mean, quartiles and a histogram for the manifest."""
    counts, edges = np.histogram(values, bins=16)
    return {
        "mean": float(values.mean()),
        "quartiles": np.percentile(values, [0, 25, 50, 75, 100]).tolist(),
        "histogram": {"counts": counts.tolist(), "edges": edges.round(3).tolist()},
    }


def collect_and_save(config: CollectConfig) -> None:
    """Collect a dataset and write it to its folder.

    Raises:
      UsageError: if the folder exists.
    """
    world, env = envs.find(config.env), envs.make(config.env)
    name, demonstrator = find_demonstrator(world, env, config.demonstrator)
    folder = dataset_folder(config, name)
    refuse_existing(folder, "remove it", "choose another with --out")
    cpu = time.process_time()
    dataset, facts = collect(
        env, demonstrator, config.trajectories, config.seed, world.num_test_tasks
    )
    cpu = time.process_time() - cpu
    made = {
        "env": config.env,
        "policy": name,
        "settings": dict(demonstrator.settings),
        "seed": config.seed,
        "versions": versions(),
    }
    save_dataset(folder, dataset, {**made, **facts})
    length, return_ = facts["length"]["mean"], facts["hindsight_return"]["mean"]
    print(
        f"{folder}: {len(dataset)} trajectories, {dataset.lengths.sum()} steps\n"
        f"  mean length {length:.1f}, {100 * facts['at_horizon']:.1f} % at the horizon, "
        f"mean hindsight return {return_:.2f}\n"
        f"  {cpu:.1f} CPU-seconds with compilation",
        file=sys.stderr,
    )


def prepare_dataset(config: PretrainConfig, world: World, env: Environment) -> Dataset:
    """The dataset of a training, collected first where it is not there yet; no test task is in it.

    Raises:
      DataError: if the dataset there is damaged, out of date or holds a test task.
      UsageError: if nothing of it would be left to train on.
    """
    name, demonstrator = find_demonstrator(world, env, config.data.demonstrator)
    wanted = CollectConfig(
        env=config.env,
        demonstrator=name,
        trajectories=config.data.trajectories,
        seed=config.data.data_seed,
    )
    folder = dataset_folder(wanted, name)
    if not folder.exists():
        text = f"no dataset in {folder} yet: collecting {wanted.trajectories} trajectories"
        print(text, file=sys.stderr)
        collect_and_save(wanted)
    dataset, manifest = load_dataset(folder, env.spec)
    settings, made_with = dict(demonstrator.settings), manifest.get("settings", {})
    if made_with != settings:
        raise DataError(
            f"{folder} was collected by the demonstrator with {made_with or 'no settings'}, which now "
            f"has {settings or 'none'}; remove it, and it is collected again"
        )
    forbidden = task_hashes(env, benchmark_tasks(env, world.num_test_tasks))
    if dataset.task_hashes is not None and np.isin(dataset.task_hashes, forbidden).any():
        raise DataError(f"{folder} holds a test task; remove it and collect it again")
    if config.holdout >= len(dataset):
        raise UsageError(
            f"--holdout {config.holdout} leaves nothing of {len(dataset)} trajectories"
        )
    return dataset
