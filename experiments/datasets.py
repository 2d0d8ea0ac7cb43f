"""Collect demonstrations, in one process or in several, and write them as a dataset."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from itertools import count, islice
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

import envs
from envs.agents import Demonstrator
from envs.base import Environment, Episode
from envs.episodes import run_episode
from envs.errors import DataError
from experiments.demonstrators import find_demonstrator
from experiments.runtime import Compiling, refuse_existing
from experiments.store.provenance import provenance, versions
from experiments.store.settings import CollectConfig, dataset_folder
from experiments.store.work import PIECES, long_work
from mgpo_jax import processes
from mgpo_jax.claims import check_place
from mgpo_jax.dataset import Dataset, finish_dataset, hash_task, load_dataset
from mgpo_jax.files import remove_leftovers
from mgpo_jax.growing import GrowingFiles
from mgpo_jax.journal import Journal
from mgpo_jax.lanes import together
from mgpo_jax.manifest import read_manifest
from mgpo_jax.progress import Progress
from mgpo_jax.sharding import fetch
from mgpo_jax.tasks import benchmark_tasks, task_hashes

SMALLEST_TRAJECTORY = 200  # bytes on disk, to tell whether a dataset could fit at all
MAX_TRIES = 20  # attempts at one demonstration
BATCH = 250  # episodes at once: enough to fill the vector units, few enough to stay in cache


class Demonstration(NamedTuple):
    """One attempt at a demonstration."""

    fingerprint: Int[Array, "*batch F"]
    episode: Episode
    variant: Int[Array, "*batch"]
    """Index of the world's variant; the demonstrator has the names."""
    return_: Float[Array, "*batch"]
    """Return on the task that the trajectory happens to solve."""
    good: Bool[Array, "*batch"]
    """Whether to keep the demonstration, unless its task is a test task."""


@cache
def demonstration_program(
    env: Environment, sample_task: Any, agent: Any, judge: Any, variant: Any
) -> Any:
    """``(keys, indices, weights) -> demonstrations``, compiled once per process."""

    def demonstrate(key: PRNGKeyArray, index: Array, weights: Any) -> Demonstration:
        key_task, key_episode = jax.random.split(key)
        task = sample_task(key_task, index)
        episode = run_episode(key_episode, env, agent(weights), task)
        episode = episode._replace(failed=jnp.asarray(episode.failed))
        keeps, hindsight_return = judge
        return_ = hindsight_return(episode.trajectory) if hindsight_return else episode.return_
        good = keeps(episode) & ~episode.failed
        return Demonstration(env.fingerprint(task), episode, variant(task), return_, good)

    return together(env, demonstrate, in_axes=(0, 0, None))


def program_of(env: Environment, demonstrator: Demonstrator) -> Any:
    """The compiled program of a demonstrator, whose weights enter it as data."""
    judge = (demonstrator.keeps, demonstrator.hindsight_return)
    return demonstration_program(
        demonstrator.env or env,
        demonstrator.sample_task,
        demonstrator.agent,
        judge,
        demonstrator.variant,
    )


class _Attempts:
    """A queue of the demonstrations to attempt, by index: failed ones first, then new ones."""

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
        """Queue failed demonstrations for another attempt."""
        self.again = indices
        self.tries.update(indices.tolist())
        if self.tries and (worst := self.tries.most_common(1)[0])[1] >= MAX_TRIES:
            raise DataError(
                f"the demonstrator failed {MAX_TRIES} times at task {worst[0]} of {self.name}"
            )
        self.num_again += len(indices)


def _rows(found: Demonstration, hashes: np.ndarray, rows: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of a dataset for the demonstrations at ``rows``."""
    episode, trajectory = found.episode, found.episode.trajectory
    real = np.arange(trajectory.goal_reached.shape[1]) < trajectory.length[rows, None]
    steps = {name: np.asarray(array)[rows][real] for name, array in trajectory.steps.items()}
    return {
        **steps,
        "lengths": trajectory.length[rows],
        "task_hashes": hashes[rows],
        "rewards": episode.rewards[rows][real],
        "last_obs": episode.last_obs[rows],
        "variants": found.variant[rows],
        "returns": found.return_[rows],
    }


def _record(
    found: Demonstration, indices: np.ndarray, forbidden: np.ndarray, room: int
) -> dict[str, np.ndarray]:
    """Record a batch: the demonstrations to keep, at most ``room``, and what became of the others.

    The first demonstrations belong to ``indices``; those after them are padding.
    """
    found = jax.tree.map(lambda rows: rows[: len(indices)], found)
    hashes = np.array([hash_task(one) for one in found.fingerprint], np.uint64)
    unseen = ~np.isin(hashes, forbidden)
    return {
        **_rows(found, hashes, np.flatnonzero(unseen & found.good)[:room]),
        "again": indices[unseen & ~found.good],
        "num_failed": np.sum(found.episode.failed),
        "num_test": np.sum(~unseen),
    }


OF_TRAJECTORIES = ("lengths", "task_hashes", "last_obs", "variants", "returns")
"""Arrays of a record with an entry per demonstration. Those in neither tuple have one per step."""
COUNTED = ("again", "num_failed", "num_test")
"""Entries of a record on the demonstrations that are not kept."""


def _combine_processes(own: dict[str, np.ndarray], room: int) -> dict[str, np.ndarray]:
    """Combine the records of all processes; processes other than 0 only get the lengths and counts."""
    if processes.count() == 1:
        return own
    whole: dict[str, np.ndarray] = {}

    def combine(pieces: list[bytes]) -> bytes:
        whole.update(_as_one([processes.from_bytes(piece) for piece in pieces], room))
        return processes.to_bytes({name: whole[name] for name in ("lengths", *COUNTED)})

    told = processes.combined(processes.to_bytes(own), combine)
    return whole or processes.from_bytes(told)


def _as_one(records: Sequence[dict[str, np.ndarray]], room: int) -> dict[str, np.ndarray]:
    """Concatenate the records of a batch's parts in order; keeps at most ``room`` demonstrations."""
    joined = {
        name: np.concatenate([np.atleast_1d(record[name]) for record in records])
        for name in records[0]
    }
    lengths = joined["lengths"][:room]
    for name, rows in joined.items():
        if name not in COUNTED:
            joined[name] = rows[: len(lengths) if name in OF_TRAJECTORIES else lengths.sum()]
    return {
        **joined,
        "num_failed": joined["num_failed"].sum(),
        "num_test": joined["num_test"].sum(),
    }


def _own_lanes() -> tuple[np.ndarray, int]:
    """The positions in a batch that this process runs, and how many of them count.

    All processes run the same number of episodes; surplus ones at the end are padding.
    """
    each = -(-BATCH // processes.count())
    first = processes.index() * each
    lanes = np.arange(first, first + each)
    return lanes % BATCH, int(np.sum(lanes < BATCH))


def _batches(
    env: Environment,
    demonstrator: Demonstrator,
    num: int,
    seed: int,
    forbidden: np.ndarray,
    attempts: _Attempts,
    journal: Journal,
) -> Iterator[dict[str, np.ndarray]]:
    """Yield records of batches of attempts until they hold ``num`` demonstrations to keep.

    Several processes share the work of each batch, so that the results do not depend on their number.
    """
    lanes, num_own = _own_lanes()
    demonstrate = program_of(env, demonstrator)
    num_kept = fruitless = 0
    for batch in count():
        indices, name = attempts.next_batch(), f"batch{batch:06}"
        record = journal.read(name)
        if record is None:
            keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), batch), BATCH)
            own, room = indices[lanes], num - num_kept
            found = fetch(demonstrate(keys[lanes], own, demonstrator.weights))
            record = _combine_processes(_record(found, own[:num_own], forbidden, room), room)
            journal.write(name, record)
        attempts.failed(record.pop("again"))
        num_new = len(record["lengths"])
        yield record
        num_kept += num_new
        if num_kept >= num:
            return
        fruitless = 0 if num_new else fruitless + 1
        if fruitless >= MAX_TRIES:
            raise DataError(
                f"nothing to keep in {MAX_TRIES * BATCH} attempts: nearly every task of "
                f"{env.spec.name} is a test task or its demonstrations are dropped"
            )


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
      DataError: if the demonstrator fails ``MAX_TRIES`` times at one task.
    """
    attempts = _Attempts(env.spec.name)
    forbidden = task_hashes(env, benchmark_tasks(env, num_test_tasks))
    lengths, returns, variants = [], [], []
    num_test = num_failed = 0
    with Progress(num, "trajectory") as progress:
        batches = _batches(env, demonstrator, num, seed, forbidden, attempts, journal or Journal())
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
