"""Attempts at demonstrations, batch by batch, which several processes share.

The record of a batch holds the arrays of the demonstrations to keep, in the form of a dataset, and what
became of the others. It can be kept in a journal, and does not depend on the number of processes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import count, islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.agents import Demonstrator
from envs.base import Environment, Episode
from envs.episodes import run_episode
from envs.errors import DataError
from mgpo_jax import processes
from mgpo_jax.dataset import hash_task
from mgpo_jax.journal import Journal
from mgpo_jax.lanes import together
from mgpo_jax.sharding import fetch

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


class Attempts:
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
                f"the demonstrator failed {MAX_TRIES} times at task {worst[0]} of {self.name}; check that "
                "it can solve this task, or leave such tasks out of sample_task"
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


def recorded_batches(
    env: Environment,
    demonstrator: Demonstrator,
    num: int,
    seed: int,
    forbidden: np.ndarray,
    attempts: Attempts,
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
                f"{env.spec.name} is a test task or its demonstrations are dropped; lower num_test_tasks, "
                "or let the demonstrator keep more"
            )
