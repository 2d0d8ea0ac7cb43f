"""Atomic writing: files and folders are never seen half written.

A file is written under a temporary name in the same folder, flushed to disk and renamed; a folder is filled
under the name ``NAME.partial`` and renamed. A process that is killed at any moment leaves either the old or
the new version. Its temporary files are removed by the next process that works there.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from envs.errors import DataError, UsageError
from mgpo_jax.claims import LOCK, InUseError, claimed, cleaned_on_exit

PLACE = "result"  # the folder within ``NAME.partial`` that becomes the new folder
TEMPORARY = ".writing-"  # prefix of the names of unfinished files


def hash_file(path: Path) -> str:
    """SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def to_json(value: Any) -> Any:
    """Convert dataclasses, paths and numpy scalars to values that ``json`` can write."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return value.item() if hasattr(value, "item") else value


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """A temporary path for the block to write to, which is then flushed to disk and renamed to ``path``.

    It has the same suffix as ``path``. If the block fails, ``path`` is unchanged.
    """
    partial = path.with_name(f"{TEMPORARY}{secrets.token_hex(4)}{path.suffix}")
    with cleaned_on_exit(partial.unlink):
        try:
            yield partial
            with open(partial, "rb") as file:
                os.fsync(file.fileno())
            os.replace(partial, path)
            flush_folder(path.parent)
        finally:
            partial.unlink(missing_ok=True)


def flush_folder(folder: Path) -> None:
    """Flush the entries of a folder to disk, so that a renamed file survives a power failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:  # some network file systems cannot do this; the data itself is on disk
        pass
    finally:
        os.close(descriptor)


def remove_unfinished(folder: Path) -> None:
    """Remove unfinished files of killed processes from a folder; only the process that claims it may do
    so."""
    for path in folder.glob(f"{TEMPORARY}*"):
        path.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with written(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically.

    Raises:
      ValueError: if the value holds NaN or infinity, which JSON cannot represent.
    """
    write_text(path, json.dumps(to_json(value), indent=2, allow_nan=False) + "\n")


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], compressed: bool = True) -> None:
    """Write an npz file atomically."""
    save: Any = np.savez_compressed if compressed else np.savez
    with written(path) as partial:
        save(partial, allow_pickle=False, **arrays)


@contextmanager
def new_folder(folder: Path, keep: str = "", wait: bool = False) -> Iterator[Path]:
    """A temporary folder within ``NAME.partial`` for the block to fill, which then becomes ``folder``.

    ``NAME.partial`` is claimed, so that no other process writes there, and is removed afterwards. Remains
    of a killed process in it are removed first, except for the subfolder ``keep``. This one holds finished
    pieces of work (npz files) from which to resume, and stays until ``folder`` is complete.

    Args:
      folder: the folder to create.
      keep: name of the subfolder of ``NAME.partial`` with finished pieces of work (default: there is none).
      wait: whether to wait for another process that writes there.

    Raises:
      ExistsError: if ``folder`` exists.
      DataError: if another process writes there.
      UsageError: if the place is not writable.
    """
    folder = Path(folder)
    partial = partial_name(folder)
    if os.path.lexists(folder):
        raise exists_already(folder)
    with claimed(partial, wait=wait):
        if os.path.lexists(folder):  # another process has completed it meanwhile
            raise exists_already(folder)
        _check_own(partial, keep)
        clear = functools.partial(_clear, partial, keep)
        clear()
        place = partial / PLACE
        place.mkdir()
        try:
            with cleaned_on_exit(clear):
                yield place
            os.rename(place, folder)
        except BaseException:
            clear()
            raise
        flush_folder(folder.parent)
        _clear(partial)
        if keep:
            shutil.rmtree(partial / keep, ignore_errors=True)


def remove_leftovers(folder: Path, keep: str = "") -> None:
    """Remove the ``NAME.partial`` of a finished folder, left by a process killed right after completing it.

    ``keep`` is the same as for ``new_folder``.
    """
    partial = partial_name(folder)
    if os.path.isdir(folder) and os.path.isdir(partial):
        with suppress(InUseError), claimed(partial):
            _clear(partial)
            if keep:
                shutil.rmtree(partial / keep, ignore_errors=True)


class ExistsError(DataError):
    """The folder to be created already exists."""


def exists_already(folder: Path) -> ExistsError:
    """The error for a folder that already exists."""
    return ExistsError(f"{folder} already exists; remove it or choose another folder with --out")


def partial_name(folder: Path) -> Path:
    """The path ``NAME.partial`` at which a new folder is written."""
    return folder.with_name(f"{folder.name}.partial")


def _clear(partial: Path, keep: str = "") -> None:
    """Remove everything that ``new_folder`` writes in an unfinished folder, except for finished work."""
    shutil.rmtree(partial / PLACE, ignore_errors=True)
    if keep and not has_work(partial / keep):
        shutil.rmtree(partial / keep, ignore_errors=True)


def _check_own(partial: Path, keep: str) -> None:
    """Raise ``UsageError`` if an unfinished folder holds anything that ``new_folder`` did not write."""
    foreign = [path for path in partial.iterdir() if path.name not in (LOCK, PLACE, keep)]
    if foreign:
        raise UsageError(
            f"{foreign[0]} is in the way and was not written by this command; move it, or choose another "
            "folder with --out"
        )


def has_work(folder: Path) -> bool:
    """Whether a folder holds finished pieces of work."""
    return any(not path.name.startswith(TEMPORARY) for path in folder.glob("*.npz"))


def hash_arrays(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of the names, dtypes, shapes and contents of arrays."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        digest.update(f"{name} {array.dtype} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
