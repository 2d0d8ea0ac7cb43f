"""Task sets: the fixed test tasks of each world, and a user's own."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.base import Environment, Task
from mgpo_jax.dataset import hash_task
from mgpo_jax.errors import DataError, UsageError
from mgpo_jax.files import load_arrays

# Streams of task seeds that never meet: test, evaluation while training; data seeds count from 0.
TEST_SEED, EVAL_SEED = 1_000_003, 1_000_033


def sample_tasks(env: Environment, seed: int, num: int) -> Task:
    """``num`` random tasks, stacked on a leading axis."""
    return _task_sampler(env)(jax.random.split(jax.random.key(seed), num))


@cache
def _task_sampler(env: Environment) -> Any:
    return jax.jit(jax.vmap(env.sample_task))


def benchmark_tasks(env: Environment, num: int | None = None) -> Task:
    """The test tasks of a world, all different: the same for everyone, and in no dataset."""
    num = num or env.spec.num_test_tasks
    drawn = sample_tasks(env, TEST_SEED, 2 * num)
    rows = [np.asarray(leaf).reshape(2 * num, -1) for leaf in jax.tree.leaves(drawn)]
    _, first = np.unique(np.concatenate(rows, axis=1), axis=0, return_index=True)
    if len(first) < num:
        raise ValueError(f"{env.spec.name} has too few tasks to test on {num} different ones")
    chosen = np.sort(first)[:num]
    return jax.tree.map(lambda leaf: leaf[chosen], drawn)


def evaluation_tasks(env: Environment, num: int) -> Task:
    """Tasks to watch a training by: none of them is a test task."""
    drawn = sample_tasks(env, EVAL_SEED, 2 * num)
    allowed = ~np.isin(task_hashes(env, drawn), task_hashes(env, benchmark_tasks(env)))
    chosen = np.flatnonzero(allowed)[:num]
    if len(chosen) < num:
        raise ValueError(f"{env.spec.name} has too few tasks to evaluate on {num} others")
    return jax.tree.map(lambda leaf: leaf[chosen], drawn)


def task_hashes(env: Environment, tasks: Task) -> np.ndarray:
    """A hash of each task's fingerprint, [N] uint64."""
    prints = np.asarray(jax.vmap(env.fingerprint)(tasks))
    return np.array([hash_task(one) for one in prints], np.uint64)


def num_tasks(tasks: Task) -> int:
    return len(jax.tree.leaves(tasks)[0])


def save_tasks(path: Path, tasks: Task) -> None:
    np.savez_compressed(path, allow_pickle=False, **jax.tree.map(np.asarray, tasks._asdict()))


def load_tasks(path: Path, env: Environment) -> Task:
    """Read tasks from an npz file with one array for each field of the world's task.

    Raises:
      UsageError: if there is no such file.
      DataError: if it cannot be read or holds something that is no task.
    """
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"no task file {path}")
    example: Any = jax.eval_shape(env.sample_task, jax.random.key(0))
    fields = type(example)._fields
    arrays = load_arrays(path)
    if missing := [name for name in fields if name not in arrays]:
        raise DataError(
            f"{path} lacks {', '.join(missing)}; tasks of {env.spec.name} need the arrays "
            f"{', '.join(fields)}"
        )
    tasks = type(example)(*(arrays[name] for name in fields))
    if any(array.ndim == 0 or len(array) == 0 for array in tasks):
        raise DataError(f"{path} holds no tasks")
    try:
        env.check_task(tasks)
    except ValueError as error:
        raise DataError(f"{path}: {error}") from None
    return jax.tree.map(lambda array, like: array.astype(like.dtype), tasks, example)
