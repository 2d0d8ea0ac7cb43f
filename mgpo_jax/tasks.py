"""Task sets: the fixed test tasks of each world, validation tasks, and a user's own tasks.

A set of N tasks is one pytree whose leaves are stacked on a leading axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.base import Environment, Task
from envs.errors import DataError, UsageError
from envs.registry import World, find
from mgpo_jax.archives import read_arrays
from mgpo_jax.array_fields import ArrayField, Sizes
from mgpo_jax.dataset import hash_task
from mgpo_jax.files import write_arrays
from mgpo_jax.mapped import fitted_arrays
from mgpo_jax.released import released_folder
from mgpo_jax.trees import named_leaves

# Seeds of disjoint streams of tasks: for tests, and for evaluation during training; data seeds count from
# 0.
TEST_SEED, EVAL_SEED = 1_000_003, 1_000_033
NUM_TASKS: Sizes = {"task": range(1, 100_001)}
"""The number of tasks that a file may hold."""


def sample_tasks(env: Environment, seed: int, num: int) -> Task:
    """Sample ``num`` random tasks, stacked."""
    return _task_sampler(env)(jax.random.split(jax.random.key(seed), num))


@cache
def _task_sampler(env: Environment) -> Any:
    return jax.jit(jax.vmap(env.sample_task))


def benchmark_tasks(env: Environment, num: int) -> Task:
    """The first ``num`` test tasks of a world, all different. They are fixed, and in no dataset."""
    drawn = sample_tasks(env, TEST_SEED, 2 * num)
    rows = [np.asarray(leaf).reshape(2 * num, -1) for leaf in jax.tree.leaves(drawn)]
    _, first = np.unique(np.concatenate(rows, axis=1), axis=0, return_index=True)
    if len(first) < num:
        raise DataError(
            f"{2 * num} random tasks of {env.spec.name} include only {len(first)} different ones, too few "
            f"for {num} test tasks; lower num_test_tasks"
        )
    chosen = np.sort(first)[:num]
    return jax.tree.map(lambda leaf: leaf[chosen], drawn)


def test_tasks(world: World | str) -> Task:
    """The test tasks of a world, given its record, name or place; the released ones, if there are any."""
    world = find(world) if isinstance(world, str) else world
    env, released = world.make(), released_folder(world) / "tasks.npz"
    if released.is_file():
        # Released tasks were checked before their release, so whether they can be solved is not computed
        # again.
        return _assembled(read_arrays(released, task_fields(env), NUM_TASKS), env)
    return benchmark_tasks(env, world.num_test_tasks)


def evaluation_tasks(
    env: Environment,
    num: int,
    num_test_tasks: int,
    tested: Environment | None = None,
    seed: int = 0,
    num_watched: int = 64,
) -> Task:
    """Validation tasks, for evaluation during training and for choosing settings; none is a test task.

    Args:
      env: the world of the tasks.
      num: the number of tasks.
      num_test_tasks: the number of test tasks, which are excluded.
      tested: the world of the test tasks, if that is another world with the same fingerprints [``env``].
      seed: index of one of several sets. Set 0 is used during training; the others share no task with it.
      num_watched: number of tasks that training evaluates, which the other sets leave out (default: that of
        ``pretrain --eval-tasks``).

    Raises:
      DataError: if the world has too few tasks.
    """
    drawn = sample_tasks(env, EVAL_SEED + seed, 2 * num)
    forbidden = task_hashes(env, benchmark_tasks(tested or env, num_test_tasks))
    if seed:
        watched = task_hashes(env, sample_tasks(env, EVAL_SEED, 2 * max(num, num_watched)))
        # Those that training evaluates are the first that are no test tasks.
        evaluated = watched[~np.isin(watched, forbidden)][:num_watched]
        forbidden = np.concatenate([forbidden, watched[: 2 * num], evaluated])
    allowed = ~np.isin(task_hashes(env, drawn), forbidden)
    chosen = np.flatnonzero(allowed)[:num]
    if len(chosen) < num:
        others = "neither test tasks nor used during training" if seed else "not test tasks"
        raise DataError(
            f"of {2 * num} random tasks of {env.spec.name}, only {len(chosen)} are {others}, too few for "
            f"{num} validation tasks; ask for fewer, or lower num_test_tasks"
        )
    return jax.tree.map(lambda leaf: leaf[chosen], drawn)


def task_hashes(env: Environment, tasks: Task) -> np.ndarray:
    """A hash of each task's fingerprint, [N] uint64."""
    prints = np.asarray(jax.vmap(env.fingerprint)(tasks))
    return np.array([hash_task(one) for one in prints], np.uint64)


def num_tasks(tasks: Task) -> int:
    return len(jax.tree.leaves(tasks)[0])


def task_at(tasks: Task, index: int) -> Task:
    """One task of a set."""
    return jax.tree.map(lambda leaf: leaf[index], tasks)


def task_arrays(tasks: Task) -> dict[str, np.ndarray]:
    """The arrays of a task set by the names of their fields."""
    return {name: np.asarray(leaf) for name, leaf in named_leaves(tasks, "task").items()}


def task_fields(env: Environment) -> dict[str, ArrayField]:
    """The declarations of the arrays of a task set."""
    example = jax.eval_shape(env.sample_task, jax.random.key(0))
    return {
        name: ArrayField(("task", *like.shape), str(like.dtype))
        for name, like in named_leaves(example, "task").items()
    }


def save_tasks(path: Path, tasks: Task) -> None:
    """Write tasks to an npz file with one array for each field of the world's task."""
    write_arrays(Path(path), task_arrays(tasks))


MEND = "fix that task or leave it out"


def load_tasks(path: Path, env: Environment) -> Task:
    """Read tasks that were written by ``save_tasks`` or made elsewhere.

    Raises:
      UsageError: if there is no such file.
      DataError: if it cannot be read, or holds an invalid or an unsolvable task.
    """
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"no task file {path}; name an npz file of tasks with --tasks")
    fields = task_fields(env)
    tasks = _checked(read_arrays(path, fields, NUM_TASKS, _required_arrays(env, fields)), env, path)
    try:
        env.check_solvable(tasks)
    except ValueError as error:
        raise DataError(f"{path}: {error}; {MEND}") from None
    return tasks


def tasks_from(
    arrays: Mapping[str, np.ndarray], env: Environment, where: Path | str, trusted: bool = False
) -> Task:
    """Make a task set from arrays by the names of their fields.

    Args:
      arrays: the arrays.
      env: the world.
      where: where the arrays come from, for messages.
      trusted: whether to check only shapes and kinds of numbers.

    Raises:
      DataError: if an array is missing or a task is invalid; the message begins with ``where``.
    """
    fields = task_fields(env)
    fitted = fitted_arrays(arrays, fields, where, NUM_TASKS, _required_arrays(env, fields))
    return _assembled(fitted, env) if trusted else _checked(fitted, env, where)


def _required_arrays(env: Environment, fields: Mapping[str, ArrayField]) -> str:
    return f"tasks of {env.spec.name} need the arrays {', '.join(fields)}"


def _assembled(arrays: Mapping[str, np.ndarray], env: Environment) -> Task:
    """Assemble the arrays of all fields into the world's task record."""
    example = jax.eval_shape(env.sample_task, jax.random.key(0))
    leaves = [arrays[name] for name in named_leaves(example, "task")]
    return jax.tree.unflatten(jax.tree.structure(example), leaves)


def _checked(arrays: Mapping[str, np.ndarray], env: Environment, where: Path | str) -> Task:
    """Assemble the tasks and let the world check them."""
    tasks = _assembled(arrays, env)
    try:
        env.check_task(tasks)
    except ValueError as error:
        raise DataError(f"{where}: {error}; {MEND}") from None
    return tasks
