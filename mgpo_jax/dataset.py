"""Trajectories on disk and in memory, and the batches that pre-training draws from them.

On disk a dataset is a folder with ``trajectories.npz`` (ragged arrays concatenated over time, with the
length of each trajectory) and ``manifest.json`` (what it is, how it was made, its hash).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envs.base import EnvSpec, Trajectory
from envs.errors import DataError
from mgpo_jax.files import hash_file, load_arrays, new_folder, read_object

FORMAT = 2  # 1 had neither rewards nor last observations, and called achieved goals "goals"
ARRAYS = "trajectories.npz"
MANIFEST = "manifest.json"
STEP_ARRAYS = Trajectory._fields[:-1]  # those with a row for every step


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """N trajectories, concatenated over time; trajectory ``i`` is ``steps[starts[i]:][:lengths[i]]``."""

    obs: np.ndarray  # [total, ...] in the dtype of the world
    actions: np.ndarray  # [total] int32, or [total, A] float32
    achieved_goals: np.ndarray  # [total, G] float32
    goal_reached: np.ndarray  # [total] bool
    outcomes: np.ndarray  # [total, G] float32
    lengths: np.ndarray  # [N] int32
    task_hashes: np.ndarray | None = None  # [N] uint64, of ``Environment.fingerprint``
    rewards: np.ndarray | None = None  # [total] float32
    last_obs: np.ndarray | None = None  # [N, ...], the observation after the last action

    @property
    def starts(self) -> np.ndarray:
        return np.concatenate([[0], np.cumsum(self.lengths[:-1])])

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that there are, by name."""
        return {name: array for name, array in vars(self).items() if array is not None}

    def slice(self, begin: int, end: int) -> Dataset:
        """Trajectories ``begin`` to ``end``, as a view."""
        first = int(self.lengths[:begin].sum())
        last = int(self.lengths[:end].sum())
        by_step = (*STEP_ARRAYS, "rewards")
        return Dataset(
            **{
                name: array[first:last] if name in by_step else array[begin:end]
                for name, array in self.arrays.items()
            }
        )

    def gather(self, indices: np.ndarray, lengths: np.ndarray, num_steps: int) -> Trajectory:
        """The first ``lengths`` steps of some trajectories, padded with zeros: ``[B, num_steps, ..]``."""
        time = np.arange(num_steps)
        real = time < lengths[:, None]
        rows = np.where(real, self.starts[indices][:, None] + time, 0)

        def padded(steps: np.ndarray) -> Any:
            mask = real.reshape(real.shape + (1,) * (steps.ndim - 1))
            return np.where(mask, steps[rows], np.zeros((), steps.dtype))

        arrays = {name: padded(getattr(self, name)) for name in STEP_ARRAYS}
        length: Any = lengths.astype(np.int32)  # numpy arrays go where jax's do
        return Trajectory(**arrays, length=length)


def hash_task(fingerprint: np.ndarray) -> np.uint64:
    """A 64-bit hash of one task's fingerprint."""
    digest = hashlib.blake2b(np.ascontiguousarray(fingerprint, np.int32).tobytes(), digest_size=8)
    return np.frombuffer(digest.digest(), np.uint64)[0]


def save_dataset(folder: Path, dataset: Dataset, manifest: dict[str, Any]) -> None:
    """Write a dataset; the folder appears only when it is complete."""
    with new_folder(Path(folder)) as partial:
        np.savez_compressed(partial / ARRAYS, allow_pickle=False, **dataset.arrays)
        manifest = {
            "format": FORMAT,
            "sha256": hash_file(partial / ARRAYS),
            "num_trajectories": len(dataset),
            "num_steps": int(dataset.lengths.sum()),
            **manifest,
        }
        (partial / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n")


def load_dataset(folder: Path, spec: EnvSpec | None = None) -> tuple[Dataset, dict[str, Any]]:
    """Read a dataset and its manifest.

    Args:
      folder: where ``save_dataset`` wrote it.
      spec: the world it must fit.

    Raises:
      DataError: if it is missing, damaged, holds NaN or belongs to another world.
    """
    folder = Path(folder)
    remake = f"remove {folder} and collect it again"
    if not (folder / MANIFEST).is_file():
        raise DataError(f"no dataset in {folder} ({MANIFEST} is missing)")
    manifest = read_object(folder / MANIFEST, remake)
    if manifest.get("format") not in (1, FORMAT):
        raise DataError(
            f"{folder} has format {manifest.get('format')}, this version reads 1 and {FORMAT}; "
            f"{remake}"
        )
    path = folder / ARRAYS
    if not path.is_file() or hash_file(path) != manifest.get("sha256"):
        raise DataError(f"{path} is missing or differs from the hash in its manifest; {remake}")
    try:
        arrays = load_arrays(path)
        if manifest["format"] == 1:
            arrays["achieved_goals"] = arrays.pop("goals")
        dataset = Dataset(**arrays)
    except (DataError, KeyError, TypeError):
        raise DataError(f"{path} does not hold the arrays of a dataset; {remake}") from None
    check_dataset(dataset, path, spec)
    return dataset, manifest


def check_dataset(dataset: Dataset, where: Path | str, spec: EnvSpec | None = None) -> None:
    """Raise ``DataError`` with the first thing that is wrong with a dataset."""
    lengths = dataset.lengths
    if lengths.ndim != 1 or not np.issubdtype(lengths.dtype, np.integer):
        raise DataError(f"{where}: lengths must be a list of integers")
    if dataset.task_hashes is not None and dataset.task_hashes.shape != lengths.shape:
        hashes = dataset.task_hashes.size
        raise DataError(f"{where}: {hashes} task hashes for {len(dataset)} trajectories")
    if len(dataset) == 0 or lengths.min() < 1:
        raise DataError(f"{where}: every trajectory needs at least one step")
    total = int(lengths.sum())
    for name, array in dataset.arrays.items():
        by_trajectory = name in ("lengths", "task_hashes", "last_obs")
        if array.ndim == 0 or len(array) != (len(dataset) if by_trajectory else total):
            raise DataError(
                f"{where}: {name} has shape {list(array.shape)}, the lengths add up to {total} steps "
                f"of {len(dataset)} trajectories"
            )
        if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0][0])
            of = "trajectory" if by_trajectory else "step"
            raise DataError(f"{where}: {name} holds NaN or infinity, first at {of} {row}")
    if spec is not None:
        _check_fit(dataset, where, spec)


def _check_fit(dataset: Dataset, where: Path | str, spec: EnvSpec) -> None:
    """Raise ``DataError`` if a dataset cannot be of a world."""
    obs: Any = np.floating if spec.obs.is_float else np.dtype(spec.obs.dtype)
    expected: dict[str, tuple[tuple[int, ...], Any]] = {
        "obs": (spec.obs.shape, obs),
        "last_obs": (spec.obs.shape, obs),
        "actions": ((), np.integer) if spec.discrete else ((spec.action_dim,), np.floating),
        "achieved_goals": ((spec.goal_dim,), np.floating),
        "goal_reached": ((), np.bool_),
        "outcomes": ((spec.goal_dim,), np.floating),
        "rewards": ((), np.floating),
    }
    for name, (shape, kind) in expected.items():
        if name not in dataset.arrays:
            continue
        array = dataset.arrays[name]
        if array.shape[1:] != shape or not np.issubdtype(array.dtype, kind):
            raise DataError(
                f"{where}: {name} is {array.dtype}{list(array.shape[1:])} a step, "
                f"{spec.name} needs {getattr(kind, '__name__', kind)}{list(shape)}"
            )
    if spec.discrete and not (
        0 <= dataset.actions.min() <= dataset.actions.max() < spec.action_dim
    ):
        raise DataError(f"{where}: actions must lie in 0..{spec.action_dim - 1}")
    if not spec.discrete and np.abs(dataset.actions).max() > 1:
        raise DataError(f"{where}: actions must lie in [-1, 1]; clip them")
    if dataset.lengths.max() > spec.horizon:
        raise DataError(
            f"{where}: a trajectory has {dataset.lengths.max()} steps, "
            f"the horizon of {spec.name} is {spec.horizon}"
        )


class BatchPlan(NamedTuple):
    """One part of a batch (a microbatch): which trajectories, cut at which length, padded to how many
    steps."""

    indices: np.ndarray
    lengths: np.ndarray
    num_steps: int


def plan_batches(
    dataset: Dataset,
    *,
    seed: int,
    batch_size: int,
    part_size: int,
    bucket: int,
    truncate: bool,
    part_steps: int | None = None,
    min_part: int = 1,
    first_step: int = 0,
    pool_steps: int = 16,
) -> Iterator[list[BatchPlan]]:
    """Batches of ``batch_size`` trajectories, in parts of nearly equal length.

    Trajectories are drawn uniformly with replacement and, with ``truncate``, cut at a uniformly
    random step (appendix D). The draws of ``pool_steps`` batches are sorted by length, cut into
    parts of ``part_size`` and the parts shuffled, so that little padding is computed and yet every
    batch is a mix of all lengths. Part lengths are rounded up to multiples of ``bucket`` to bound
    the number of shapes; parts with more than ``part_steps`` padded steps are halved until they fit,
    so that short and long trajectories fill the same amount of cache (but not below multiples of
    ``min_part``, the number of devices).

    The stream is a function of the seed alone: starting at ``first_step`` skips exactly the batches
    before it.
    """
    if batch_size % part_size:
        raise ValueError(f"batch_size {batch_size} is not a multiple of part_size {part_size}")
    parts_per_batch = batch_size // part_size
    longest = int(dataset.lengths.max())
    pool_index, offset = divmod(first_step, pool_steps)
    while True:
        rng = np.random.Generator(np.random.Philox(key=[seed, pool_index]))
        indices = rng.integers(len(dataset), size=pool_steps * batch_size)
        lengths = dataset.lengths[indices]
        if truncate:
            lengths = rng.integers(1, lengths + 1)
        order = np.argsort(lengths, kind="stable").reshape(-1, part_size)
        order = order[rng.permutation(len(order))]
        for step in range(offset, pool_steps):
            batch = []
            for rows in order[step * parts_per_batch : (step + 1) * parts_per_batch]:
                num_steps = min(-(-int(lengths[rows].max()) // bucket) * bucket, longest)
                size = part_size
                while part_steps and size * num_steps > part_steps and size % (2 * min_part) == 0:
                    size //= 2
                for piece in rows.reshape(-1, size):
                    batch.append(BatchPlan(indices[piece], lengths[piece], num_steps))
            yield batch
        pool_index, offset = pool_index + 1, 0
