"""Trajectories on disk and in memory, and the batches that pre-training draws from them.

On disk a dataset is a folder with ragged arrays (all trajectories concatenated over time, and their
lengths) and ``manifest.json``, which says what the data are, how they were made, and their hash. The arrays
are packed in ``trajectories.npz``, or, if they are large or imported, each has a file of its own that is
mapped into memory (see ``manifest``).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envs.base import Trajectory
from envs.errors import DataError, UsageError, shown
from envs.registry import WORLDS
from envs.specs import ArraySpec, Box, Discrete, EnvSpec
from mgpo_jax.archives import read_arrays
from mgpo_jax.array_fields import ArrayField, Sizes
from mgpo_jax.files import hash_file, new_folder, write_arrays, write_json
from mgpo_jax.manifest import (
    ARRAYS,
    MANIFEST,
    MAPPED,
    PACKED,
    Facts,
    Manifest,
    hash_of_files,
    mend_for,
    read_manifest,
)
from mgpo_jax.mapped import fitted_arrays, let_go, mapped_arrays

SIZES: Sizes = {"trajectory": range(1, 2**31), "step": range(1, 2**31)}
STEP_ARRAYS = tuple(name for name in Trajectory._fields if name != "length")
"""The arrays of trajectories with a row for every step; datasets can have ``rewards`` as well."""


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """N trajectories, concatenated over time; trajectory ``i`` is ``steps[starts[i]:][:lengths[i]]``."""

    obs: np.ndarray  # [total, ...] in the dtype of the world
    actions: np.ndarray  # [total] int32, or [total, A] float32
    achieved_goals: np.ndarray  # [total, G] float32
    goal_reached: np.ndarray  # [total] bool
    outcomes: np.ndarray  # [total, G] float32
    lengths: np.ndarray  # [N] int32
    intended: np.ndarray | None = None  # like actions: what the demonstrator meant to do
    task_hashes: np.ndarray | None = None  # [N] uint64, of ``Environment.fingerprint``
    rewards: np.ndarray | None = None  # [total] float32
    last_obs: np.ndarray | None = None  # [N, ...], the observation after the last action
    variants: np.ndarray | None = None  # [N] int32, of the world; the manifest names them in order
    terminated: np.ndarray | None = None  # [N] bool, whether the last step ended the task
    truncated: np.ndarray | None = None  # [N] bool, whether the last step was cut off

    @property
    def starts(self) -> np.ndarray:
        return np.concatenate([[0], np.cumsum(self.lengths[:-1])])

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that are not None, by name."""
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
        """The first ``lengths`` [B] steps of B trajectories, padded with zeros: ``[B, num_steps, ..]``."""
        time = np.arange(num_steps)
        real = time < lengths[:, None]
        rows = np.where(real, self.starts[indices][:, None] + time, 0)

        def padded(steps: np.ndarray) -> Any:
            mask = real.reshape(real.shape + (1,) * (steps.ndim - 1))
            return np.where(mask, steps[rows], np.zeros((), steps.dtype))

        arrays = {name: padded(self.arrays[name]) for name in STEP_ARRAYS if name in self.arrays}
        for name in arrays:
            let_go(self.arrays[name])
        length: Any = lengths.astype(np.int32)  # a numpy array in place of a jax array
        return Trajectory(**arrays, length=length)


def hash_task(fingerprint: np.ndarray) -> np.uint64:
    """A 64-bit hash of one task's fingerprint."""
    digest = hashlib.blake2b(np.ascontiguousarray(fingerprint, np.int32).tobytes(), digest_size=8)
    return np.frombuffer(digest.digest(), np.uint64)[0]


def save_dataset(
    folder: Path, dataset: Dataset, manifest: dict[str, Any], mapped: bool = False
) -> None:
    """Write a dataset to a new folder, which appears only when it is complete.

    Args:
      folder: the folder, which must not exist.
      dataset: the trajectories.
      manifest: further entries of the manifest.
      mapped: whether to write an uncompressed file for each array, which training maps into memory.
    """
    with new_folder(Path(folder)) as place:
        write_dataset(place, dataset, manifest, mapped)


def write_dataset(
    place: Path, dataset: Dataset, manifest: dict[str, Any], mapped: bool = False
) -> None:
    """Write the files of a dataset into a folder."""
    if mapped:
        for name, array in dataset.arrays.items():
            np.save(place / f"{name}.npy", array, allow_pickle=False)
        finish_mapped(place, dataset.arrays, len(dataset), len(dataset.actions), manifest)
        return
    write_arrays(place / ARRAYS, dataset.arrays)
    facts = {
        "format": PACKED,
        "sha256": hash_file(place / ARRAYS),
        "num_trajectories": len(dataset),
        "num_steps": int(dataset.lengths.sum()),
    }
    write_json(place / MANIFEST, {**facts, **manifest})


LARGE = 2 << 30
"""Number of bytes in memory beyond which collected trajectories are mapped instead of packed."""


def finish_dataset(place: Path, manifest: dict[str, Any]) -> None:
    """Make a dataset of the arrays in the files ``NAME.npy`` of a folder, which may be larger than the
    memory.

    Up to ``LARGE`` bytes they are packed into one compressed file; larger ones stay as they are and are
    mapped into memory.
    """
    arrays = {path.stem: np.load(path, mmap_mode="r") for path in sorted(place.glob("*.npy"))}
    if sum(array.nbytes for array in arrays.values()) > LARGE:
        finish_mapped(place, arrays, len(arrays["lengths"]), len(arrays["actions"]), manifest)
        return
    write_dataset(place, Dataset(**arrays), manifest)
    for name in arrays:
        (place / f"{name}.npy").unlink()


def finish_mapped(
    place: Path, names: Iterable[str], num_trajectories: int, num_steps: int, manifest: Any
) -> None:
    """Write the manifest of a mapped dataset whose arrays are already in the files ``NAME.npy`` of a
    folder."""
    files = {name: hash_file(place / f"{name}.npy") for name in names}
    facts = {
        "format": MAPPED,
        "sha256": hash_of_files(files),
        "num_trajectories": num_trajectories,
        "num_steps": num_steps,
        "files": files,
    }
    write_json(place / MANIFEST, {**facts, **manifest})


def load_dataset(
    folder: Path,
    spec: EnvSpec | None = None,
    made: Mapping[str, Any] | None = None,
    any_value: bool = False,
) -> tuple[Dataset, dict[str, Any]]:
    """Read a dataset and its manifest; if each array has a file of its own, it is mapped into memory.

    Args:
      folder: the folder that ``save_dataset`` wrote.
      spec: the specification of the world that the dataset must fit.
      made: entries that the manifest must not contradict, such as ``env``, ``policy``, ``seed`` and
        ``num_trajectories``.
      any_value: whether to accept NaN, infinity and actions out of range, for code that looks for them.

    Raises:
      DataError: if the dataset is missing or damaged, holds NaN, or belongs to another world.
    """
    folder = Path(folder)
    mend = mend_for(folder)
    document, manifest = read_manifest(folder, mend)
    _check_made(document, made or {}, folder / MANIFEST, mend)
    fields = _fields(spec)
    if manifest.format == 1:
        fields["goals"] = fields.pop("achieved_goals")
    if any_value:
        fields = {
            name: replace(field, any_value=name != "lengths") for name, field in fields.items()
        }
    counted = {"trajectory": manifest.num_trajectories, "step": manifest.num_steps}
    sizes = {**SIZES, **{axis: size for axis, size in counted.items() if size}}
    where = folder if manifest.format == MAPPED else folder / ARRAYS
    if manifest.format == MAPPED:
        arrays = _mapped(folder, fields, sizes, manifest, mend)
    else:
        if not where.is_file() or hash_file(where) != manifest.sha256:
            raise DataError(f"{where} is missing or differs from the hash in its manifest; {mend}")
        arrays = read_arrays(where, fields, sizes, mend)
    if manifest.format == 1:
        arrays["achieved_goals"] = arrays.pop("goals")
    dataset = Dataset(**arrays)
    _check_lengths(dataset, where, mend)
    return dataset, document


def _mapped(
    folder: Path, fields: Mapping[str, ArrayField], sizes: Sizes, manifest: Manifest, mend: str
) -> dict[str, np.ndarray]:
    """The arrays of a mapped dataset, after their hashes were compared with those of its manifest."""
    for name, sha256 in manifest.files.items():
        path = folder / f"{name}.npy"
        if not path.is_file() or hash_file(path) != sha256:
            raise DataError(f"{path} is missing or differs from the hash in its manifest; {mend}")
    listed = {name: f for name, f in fields.items() if f.required or name in manifest.files}
    arrays = mapped_arrays(folder, listed, sizes, mend)
    # Arrays that every batch needs are small, so they are read into memory.
    for name in {"lengths", "task_hashes", "variants", "terminated", "truncated"} & arrays.keys():
        arrays[name] = np.array(arrays[name])
    return arrays


def spec_of(facts: Facts) -> EnvSpec:
    """The specification of an unregistered world, derived from a dataset's manifest and arrays.

    It has no rewards. A policy trained on such data can be loaded and can act, but cannot be evaluated.
    """
    num = facts.num_actions
    return EnvSpec(
        name=facts.spec.name,
        obs=ArraySpec(facts.obs_shape, facts.obs_dtype),
        goal_dim=facts.goal_dim,
        actions=Box(facts.action_dim) if num is None else Discrete(num),
        horizon=facts.spec.horizon,
        return_range=(0.0, 1.0),
        truncate_in_hindsight=facts.spec.truncate_in_hindsight,
    )


def variant_counts(folder: Path, sha256: str) -> dict[str, int]:
    """The number of trajectories of each variant of the world in a dataset, by the variant's name.

    Args:
      folder: the folder of the dataset, which may have been removed.
      sha256: the hash of its arrays. If the folder holds another dataset by now, the result is empty.

    Raises:
      DataError: if the manifest is damaged.
    """
    if not (Path(folder) / MANIFEST).is_file():
        return {}
    _, manifest = read_manifest(folder)
    return manifest.variants if manifest.sha256 == sha256 else {}


def _check_made(
    document: Mapping[str, Any], made: Mapping[str, Any], path: Path, mend: str
) -> None:
    """Raise ``DataError`` for the first entry of a manifest that contradicts ``made``."""
    for name, wanted in made.items():
        found = document.get(name, wanted)
        if found != wanted and not (name == "env" and found and _same_data(found, wanted, path)):
            raise DataError(f"{path}: {name} is {shown(found)}, wanted {shown(wanted)}; {mend}")


def _same_data(first: str, second: str, where: Path) -> bool:
    """Whether two worlds share their datasets."""
    try:
        homes = {WORLDS.known(name, where, "--env").home for name in (first, second)}
    except DataError:
        return False
    return len(homes) == 1


def _fields(spec: EnvSpec | None) -> dict[str, ArrayField]:
    """The declarations of a dataset's arrays, for a given world or for any (None)."""
    if spec is None:
        obs = ArrayField(("step", ...), "anything")
        actions = ArrayField(("step", ...), "numbers")
        goals, horizon = ArrayField(("step", "goal"), "float32"), None
    else:
        obs = ArrayField(("step", *spec.obs.shape), spec.obs.dtype)
        actions = (
            ArrayField(("step",), "int32", low=0, high=spec.action_dim - 1)
            if spec.discrete
            else ArrayField(("step", spec.action_dim), "float32", low=-1, high=1)
        )
        goals, horizon = ArrayField(("step", spec.goal_dim), "float32"), spec.horizon
    return {
        "lengths": ArrayField(("trajectory",), "int32", low=1, high=horizon),
        "obs": obs,
        "actions": actions,
        "achieved_goals": goals,
        "goal_reached": ArrayField(("step",), "bool"),
        "outcomes": goals,
        "task_hashes": ArrayField(("trajectory",), "uint64", required=False),
        "intended": replace(actions, required=False),
        "rewards": ArrayField(("step",), "float32", required=False),
        "last_obs": replace(obs, shape=("trajectory", *obs.shape[1:]), required=False),
        "variants": ArrayField(("trajectory",), "int32", low=0, required=False),
        "terminated": ArrayField(("trajectory",), "bool", required=False),
        "truncated": ArrayField(("trajectory",), "bool", required=False),
    }


def check_dataset(dataset: Dataset, where: Path | str, spec: EnvSpec | None = None) -> None:
    """Raise ``DataError`` for the first fault of a dataset in memory."""
    fitted_arrays(dataset.arrays, _fields(spec), where, SIZES)
    _check_lengths(dataset, where)


def _check_lengths(dataset: Dataset, where: Path | str, mend: str = "") -> None:
    """Raise ``DataError`` if the lengths do not add up to the steps."""
    total, steps = int(dataset.lengths.sum(dtype=np.int64)), len(dataset.actions)
    if total != steps:
        tail = f"; {mend}" if mend else ""
        raise DataError(f"{where}: the lengths add up to {total} steps, found {steps}{tail}")


class BatchPlan(NamedTuple):
    """The plan of one part of a batch (a microbatch): indices of trajectories, the lengths that they are
    cut to, and the number of steps that they are padded to."""

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
    """Plan an endless stream of batches, each in parts of trajectories of nearly equal length.

    Trajectories are drawn uniformly with replacement and, with ``truncate``, cut at a uniformly random step
    (appendix D). The draws of ``pool_steps`` batches are sorted by length and divided into parts of
    ``part_size``, and the parts are shuffled, so that there is little padding and yet every batch is a mix
    of all lengths. The padded lengths are rounded up to multiples of ``bucket``, to bound the number of
    shapes. Parts with more than ``part_steps`` padded steps are halved until they fit, so that parts of
    short and of long trajectories use the same amount of cache; their sizes remain multiples of
    ``min_part``, the number of devices.

    The stream is a function of the seed alone: starting at ``first_step`` skips exactly the batches before
    it.
    """
    if batch_size % part_size:
        raise UsageError(f"batch_size {batch_size} is not a multiple of part_size {part_size}")
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
