"""Collect a dataset: ``python -m experiments.collect --env maze15 --policy astar4``."""

from __future__ import annotations

import sys
import time
from collections import Counter
from dataclasses import dataclass
from functools import cache, partial
from itertools import count, islice
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from envs.base import Demonstrator, Environment
from envs.experts import demonstrators
from experiments.configs import data_root, make_env, positive
from experiments.runtime import Common, jit_with, refuse_existing, run, versions
from experiments.tasks import benchmark_tasks, task_hashes
from mgpo_jax.dataset import Dataset, hash_task, save_dataset
from mgpo_jax.errors import DataError, nearest
from mgpo_jax.rollout import run_episode
from mgpo_jax.types import Trajectory

LANES = "lanes"
MAX_TRIES = 20  # at one demonstration
BATCH = 250  # episodes at once: enough to fill the vector units, few enough to stay in cache


@dataclass(frozen=True)
class CollectConfig(Common):
    """Settings of ``experiments.collect``."""

    env: str = "maze15"
    """The world: maze15, maze30, gridworld or kitchen."""
    policy: str | None = None
    """The demonstrator: astar1, astar2, astar4 or random in mazes (default: the world's first)."""
    episodes: int = 10_000
    """Trajectories to keep [10,000 in mazes, 13,600 in gridworld, 9,000 in kitchen]."""
    seed: int = 0
    """Seed of tasks and demonstrator."""
    out: Path | None = None
    """Folder to write (default: data/ENV/POLICY-EPISODES-seedSEED, under $MGPO_DATA if set)."""


def dataset_folder(config: CollectConfig, policy: str) -> Path:
    name = f"{policy}-{config.episodes}-seed{config.seed}"
    return config.out or data_root() / make_env(config.env).spec.name / name


def find_demonstrator(env: Environment, policy: str | None) -> tuple[str, Demonstrator]:
    """The demonstrator of that name; the world's first for None."""
    known = demonstrators(env)
    name = policy or next(iter(known))
    if name not in known:
        raise nearest(name, known, "demonstrator")
    return name, known[name]


@cache
def demonstration_program(env: Environment, demonstrator: Demonstrator) -> Any:
    """``(keys, indices) -> (task fingerprints, trajectories, hindsight returns, which to keep, failed)``.

    Compiled once a process.
    """

    @jit_with(env)
    @partial(jax.vmap, axis_name=LANES)
    def demonstrate(
        key: jax.Array, index: jax.Array
    ) -> tuple[jax.Array, Trajectory, jax.Array, jax.Array, jax.Array]:
        key_task, key_episode = jax.random.split(key)
        task = demonstrator.sample_task(key_task, index)
        episode = run_episode(key_episode, env, demonstrator.agent, task, LANES)
        return_ = demonstrator.hindsight_return(episode.trajectory)
        keep, failed = demonstrator.keeps(episode), jnp.asarray(episode.failed)
        return env.fingerprint(task), episode.trajectory, return_, keep & ~failed, failed

    return demonstrate


def collect(
    env: Environment, demonstrator: Demonstrator, episodes: int, seed: int
) -> tuple[Dataset, dict[str, Any]]:
    """Demonstrations, none of them of a test task, and facts about them.

    Those that are not worth keeping are tried again with another key, so that a demonstrator that goes
    through all tasks in turn demonstrates each of them equally often, but for the last batch.

    Raises:
      DataError: if the demonstrator fails ``MAX_TRIES`` times at one of them.
    """
    demonstrate = demonstration_program(env, demonstrator)
    forbidden = task_hashes(env, benchmark_tasks(env))
    kept: list[tuple[Any, ...]] = []
    num_kept = num_test = num_failed = batch = 0
    fresh, again, num_again = count(), np.zeros(0, int), 0
    tries: Counter[int] = Counter()
    with tqdm(total=episodes, unit="episode", disable=None) as progress:
        while num_kept < episodes:
            keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), batch), BATCH)
            new = list(islice(fresh, BATCH - len(again)))
            indices = np.concatenate([again, new]).astype(np.int32)
            prints, trajectory, returns, good, failed = jax.device_get(demonstrate(keys, indices))
            hashes = np.array([hash_task(one) for one in prints], np.uint64)
            unseen = ~np.isin(hashes, forbidden)
            again = indices[unseen & ~good]
            tries.update(again.tolist())
            if tries and (worst := tries.most_common(1)[0])[1] >= MAX_TRIES:
                raise DataError(
                    f"the demonstrator failed {MAX_TRIES} times at task {worst[0]} of {env.spec.name}"
                )
            rows = np.flatnonzero(unseen & good)[: episodes - num_kept]
            real = np.arange(trajectory.goal_reached.shape[1]) < trajectory.length[rows, None]
            steps = [np.asarray(array)[rows][real] for array in trajectory[:-1]]
            kept.append((*steps, trajectory.length[rows], hashes[rows], returns[rows]))
            num_kept += len(rows)
            num_again += len(again)
            num_failed += int(failed.sum())
            num_test += int((~unseen).sum())
            batch += 1
            progress.update(len(rows))
    *arrays, all_returns = (np.concatenate(parts) for parts in zip(*kept, strict=True))
    dataset = Dataset(*arrays)
    if np.isin(dataset.task_hashes, forbidden).any():
        raise AssertionError("a test task is in the dataset")
    facts = {
        "tried_again": num_again,
        "failed_episodes": num_failed,
        "dropped_test_tasks": num_test,
        "length": _describe(dataset.lengths),
        "at_horizon": float(np.mean(dataset.lengths == env.spec.horizon)),
        "hindsight_return": _describe(all_returns),
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


def main(config: CollectConfig) -> None:
    """Collect demonstrations on random tasks, none of them a test task."""
    positive(config, "episodes")
    env = make_env(config.env)
    policy, demonstrator = find_demonstrator(env, config.policy)
    folder = dataset_folder(config, policy)
    refuse_existing(folder, "remove it", "choose another with --out")
    cpu = time.process_time()
    dataset, facts = collect(env, demonstrator, config.episodes, config.seed)
    cpu = time.process_time() - cpu
    made = {
        "env": config.env,
        "policy": policy,
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


if __name__ == "__main__":
    run(CollectConfig, main)
