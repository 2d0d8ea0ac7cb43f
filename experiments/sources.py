"""Readers of logs: Minari, HDF5, npz, parquet. Each of them yields one episode after the other.

An episode is a dictionary of arrays by name, with a row for each action or observation. Nested names are
joined by slashes, such as ``observations/achieved_goal`` or ``infos/qpos``.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from envs.errors import DataError, UsageError, printable, shown
from experiments.store.extras import import_extra
from mgpo_jax.archives import array_headers, read_arrays
from mgpo_jax.array_fields import ArrayField

ACTIONS = ("actions", "action")
TERMINATED = ("terminals", "terminations", "terminated")
TRUNCATED = ("timeouts", "truncations", "truncated")
LENGTHS = ("lengths", "episode_lengths")
SIZED = (
    "horizon", "num_actions", "action_low", "action_high", "cut_in_hindsight", "without_rewards",
    "without_ends",
)  # fmt: skip
"""Arrays of our own exports that hold for all episodes."""
OWN = "mgpo"
"""The group that our exports add to the infos of a Minari dataset, and the prefix of their metadata."""
HDF5 = (".hdf5", ".h5", ".hdf")


@dataclass
class Source:
    """Opened logs.

    Attributes:
      kind: their format, for the manifest.
      episodes: yields what messages call an episode, and its arrays.
      num: number of episodes.
      num_actions: number of discrete actions, if the source says so.
      horizon: steps after which an episode is truncated, if the source says so.
      sized: entries of our own exports that hold for all episodes (``SIZED``).
      author: author of the logs, if the source says so.
    """

    kind: str
    episodes: Iterator[tuple[str, dict[str, np.ndarray]]]
    num: int
    num_actions: int | None = None
    horizon: int | None = None
    sized: dict[str, np.ndarray] = field(default_factory=dict)
    author: str = ""


def first_of(names: Sequence[str], arrays: Mapping[str, Any]) -> Any:
    """The array with the first of several names that exists; None if none does."""
    return next((arrays[name] for name in names if name in arrays), None)


@contextmanager
def opened(source: str) -> Iterator[Source]:
    """Open logs, whatever their format.

    Args:
      source: a file, a folder, or the id of a Minari dataset.

    Raises:
      UsageError: if there are no such logs, or the package that reads them is not installed.
      DataError: if they cannot be read.
    """
    path = Path(source)
    if path.is_dir():
        if (path / "data").is_dir():
            yield _minari(import_extra("minari", "minari").MinariDataset(path / "data"))
        else:
            files = _files(path)
            yield Source("episodes", _folder(files), len(files))
    elif path.suffix.lower() in HDF5 and path.is_file():
        with _hdf5(path) as arrays:
            yield _flat("hdf5", arrays, path)
    elif path.suffix == ".npz" and path.is_file():
        yield _flat("npz", _npz(path), path)
    elif path.is_file():
        raise UsageError(
            f"{source} is not a file that can be imported; give a file that ends in .npz or "
            f"{', '.join(HDF5)}, a folder of episodes, or a Minari dataset"
        )
    else:
        yield _minari(_minari_by_id(source))


def _minari_by_id(source: str) -> Any:
    """A local Minari dataset by its id."""
    if os.sep in source and source.startswith((".", os.sep)):
        raise UsageError(f"there is no file or folder {source}; give the place of your logs")
    try:
        minari = import_extra("minari", "minari")
    except UsageError as error:
        raise UsageError(f"there is no file or folder {source}, and {error}") from None
    try:
        return minari.load_dataset(source)
    except (OSError, ValueError) as error:
        known = ", ".join(sorted(minari.list_local_datasets())) or "none"
        raise UsageError(
            f"there is no file, folder or local Minari dataset {source} ({printable(str(error))[:120]}); "
            f"known datasets: {known}; fetch one with `minari download ID`"
        ) from None


def _minari(dataset: Any) -> Source:
    """A Minari dataset, read one episode at a time."""
    space, env = dataset.action_space, None
    try:
        env = dataset.env_spec
    except Exception:  # some versions of Minari raise for datasets without an environment
        env = None
    num = int(space.n) if type(space).__name__ == "Discrete" else None
    first = int(space.start) if num is not None else 0
    metadata = dataset.storage.metadata
    own = {name: metadata.get(f"{OWN}_{name}") for name in SIZED}
    sized = {name: np.asarray(value) for name, value in own.items() if value is not None}

    def episodes() -> Iterator[tuple[str, dict[str, np.ndarray]]]:
        for episode in dataset.iterate_episodes():
            arrays: dict[str, np.ndarray] = {}
            for name in ("observations", "actions", "infos"):
                arrays |= dict(_leaves(getattr(episode, name), name))
            arrays = {name.removeprefix(f"infos/{OWN}/"): rows for name, rows in arrays.items()}
            if "actions" in arrays and num is not None:
                arrays["actions"] = arrays["actions"] - first
            arrays["rewards"] = np.asarray(episode.rewards)
            arrays["terminations"] = np.asarray(episode.terminations)
            arrays["truncations"] = np.asarray(episode.truncations)
            yield f"episode {episode.id}", arrays

    author = metadata.get("author") or metadata.get("algorithm_name") or ""
    return Source(
        "minari",
        episodes(),
        len(dataset),
        num,
        getattr(env, "max_episode_steps", None),
        sized,
        str(author if isinstance(author, str) else ", ".join(map(str, author))),
    )


def _leaves(value: Any, name: str) -> Iterator[tuple[str, np.ndarray]]:
    """The numeric arrays in nested dictionaries, by their names joined with slashes."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _leaves(part, f"{name}/{key}")
    elif value is not None:
        array = np.asarray(value)
        if array.dtype.kind in "biuf" and array.ndim:
            yield name, array


@contextmanager
def _hdf5(path: Path) -> Iterator[dict[str, Any]]:
    """The arrays of an HDF5 file, which are read slice by slice."""
    h5py = import_extra("h5py", "minari")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise DataError(
            f"{path} is not a readable HDF5 file ({printable(str(error))[:120]}); copy it again"
        ) from None
    with file:
        arrays: dict[str, Any] = {}

        def note(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and item.dtype.kind in "biuf" and item.ndim:
                arrays[name] = item

        file.visititems(note)
        yield arrays


def _npz(path: Path) -> dict[str, np.ndarray]:
    """The numeric arrays in an npz file."""
    headers = array_headers(path)
    names = [name for name, header in headers.items() if header.dtype.kind in "biuf"]
    return read_arrays(
        path, {name: ArrayField((...,), "anything", any_value=True) for name in names}
    )


def _flat(kind: str, arrays: Mapping[str, Any], path: Path) -> Source:
    """Episodes that are stored one after the other in flat arrays."""
    actions = first_of(ACTIONS, arrays)
    if actions is None:
        raise DataError(f"{path} lacks actions; it has {', '.join(sorted(arrays)) or 'no arrays'}")
    if not actions.ndim or not len(actions):
        raise DataError(f"{path} has no steps: its actions are {list(actions.shape)}")
    ends = _ends(arrays, len(actions), path)
    starts = np.concatenate([[0], ends[:-1]])

    def episodes() -> Iterator[tuple[str, dict[str, np.ndarray]]]:
        for index, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
            found = {}
            for name, array in arrays.items():
                if name in SIZED or name in LENGTHS or not array.ndim:
                    continue
                if len(array) == len(actions):
                    found[name] = np.asarray(array[start:end])
                elif len(array) == len(actions) + len(ends):
                    found[name] = np.asarray(array[start + index : end + index + 1])
                elif len(array) == len(ends):
                    found[name] = np.asarray(array[index])
            yield f"episode {index}", found

    sized = {name: np.asarray(arrays[name]) for name in SIZED if name in arrays}
    return Source(kind, episodes(), len(ends), sized=sized)


def _ends(arrays: Mapping[str, Any], num_steps: int, path: Path) -> np.ndarray:
    """Where the episodes in flat arrays end: the number of steps up to the end of each."""
    lengths = first_of(LENGTHS, arrays)
    if lengths is not None:
        ends = np.cumsum(np.asarray(lengths), dtype=np.int64)
        sound = np.asarray(lengths).ndim == 1 and len(ends) and int(np.min(lengths)) >= 1
        if not sound or ends[-1] != num_steps:
            total = int(ends[-1]) if len(ends) else 0
            raise DataError(
                f"{path}: the lengths add up to {total} steps, found {num_steps} actions; "
                "they must be the numbers of actions of the episodes, in order"
            )
        return ends
    flags = [first_of(names, arrays) for names in (TERMINATED, TRUNCATED)]
    if all(flag is None for flag in flags):
        raise DataError(
            f"{path} has no terminals, timeouts or lengths, so the ends of its episodes are unknown; add "
            "an array named lengths with the number of actions in each episode"
        )
    over = np.zeros(num_steps, bool)
    for flag in flags:
        if flag is not None:
            rows = np.asarray(flag).reshape(-1)
            if len(rows) != num_steps:
                raise DataError(
                    f"{path}: terminals and timeouts must have a row for each of {num_steps} actions, "
                    f"found {len(rows)}"
                )
            over |= rows.astype(bool)
    over[-1:] = True  # steps after the last end are an unfinished episode
    return 1 + np.flatnonzero(over)


def _files(path: Path) -> list[Path]:
    """The files of a folder with one file per episode, sorted by name."""
    files = sorted(file for file in path.iterdir() if file.suffix in (".npz", ".parquet"))
    if not files:
        raise UsageError(
            f"{path} holds neither npz nor parquet files, nor a folder data as Minari datasets do; give "
            "the folder of your logs"
        )
    return files


def _folder(files: Sequence[Path]) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    for file in files:
        yield file.name, _npz(file) if file.suffix == ".npz" else _parquet(file)


def _parquet(path: Path) -> dict[str, np.ndarray]:
    """The columns of a parquet file as arrays; a column of lists becomes an array with another axis.

    The last row may be for the observation after the last action only: columns that are null there are
    shorter by one row.
    """
    parquet = import_extra("pyarrow.parquet", "parquet")
    try:
        table = parquet.read_table(path)
    except (OSError, ValueError) as error:  # pyarrow's own errors derive from these
        raise DataError(
            f"{path} is not a readable parquet file ({printable(str(error))[:120]}); write it again"
        ) from None
    found = {}
    for name in table.column_names:
        rows = table.column(name).to_pylist()
        if rows and rows[-1] is None:
            rows = rows[:-1]
        if any(row is None for row in rows):
            first = rows.index(None)
            raise DataError(
                f"{path}: column {shown(name)} is null in row {first}, not only in the last"
            )
        try:
            array = np.array(rows)
        except ValueError:
            raise DataError(
                f"{path}: column {shown(name)} holds lists of different lengths, which cannot form an "
                "array; pad them or leave the column out"
            ) from None
        if array.dtype.kind in "biuf":
            found[name] = array
    return found
