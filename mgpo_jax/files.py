"""Files and folders that are never seen half written.

A file is written beside its place, flushed to disk and renamed; a folder is filled under the name
``NAME.partial`` and renamed. A process that is killed at any moment leaves either the old or the new, and
what it was writing is removed by the next one that works there.
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

PLACE = "result"  # what is being written, in an unfinished folder
TEMPORARY = ".writing-"  # how the names of files begin that are being written


def hash_file(path: Path) -> str:
    """SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def to_json(value: Any) -> Any:
    """Dataclasses, paths and numpy scalars as what ``json`` can write."""
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
    """A place beside ``path`` to write a file to, which takes its name when all of it is on disk.

    It has the same suffix. If writing fails, ``path`` stays as it was.
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
    """Bring the names in a folder to disk, so that a renamed file survives a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:  # some network file systems cannot; the data itself is on disk
        pass
    finally:
        os.close(descriptor)


def remove_unfinished(folder: Path) -> None:
    """Remove the files that a killed process was writing in a folder; only its owner may do so."""
    for path in folder.glob(f"{TEMPORARY}*"):
        path.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with written(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file, whole or not at all.

    Raises:
      ValueError: for NaN or infinity, which JSON does not have.
    """
    write_text(path, json.dumps(to_json(value), indent=2, allow_nan=False) + "\n")


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], compressed: bool = True) -> None:
    """Write an npz file, whole or not at all."""
    save: Any = np.savez_compressed if compressed else np.savez
    with written(path) as partial:
        save(partial, allow_pickle=False, **arrays)


@contextmanager
def new_folder(folder: Path, keep: str = "", wait: bool = False) -> Iterator[Path]:
    """A place to write to, in ``NAME.partial``, which becomes ``folder`` when all is written.

    ``NAME.partial`` is claimed, so that no other process writes there, and removed afterwards. What a
    killed process left in it is removed as well, except for a folder ``keep`` in it with finished pieces of
    work (npz files) to go on from, which stays until ``folder`` is there.

    With ``wait``, another process that writes there is waited for.

    Raises:
      ExistsError: if ``folder`` exists.
      DataError: if another process writes there.
      UsageError: if nothing can be written there.
    """
    folder = Path(folder)
    partial = partial_name(folder)
    if os.path.lexists(folder):
        raise exists_already(folder)
    with claimed(partial, wait=wait):
        if os.path.lexists(folder):  # another process has finished it meanwhile
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
    """Remove what a process left beside a finished folder, if it was killed right after making it.

    ``keep`` is that of ``new_folder``.
    """
    partial = partial_name(folder)
    if os.path.isdir(folder) and os.path.isdir(partial):
        with suppress(InUseError), claimed(partial):
            _clear(partial)
            if keep:
                shutil.rmtree(partial / keep, ignore_errors=True)


class ExistsError(DataError):
    """A folder that was to be made exists."""


def exists_already(folder: Path) -> ExistsError:
    """The error for a folder that exists."""
    return ExistsError(f"{folder} exists already; remove it or choose another place with --out")


def partial_name(folder: Path) -> Path:
    """Where a new folder is written."""
    return folder.with_name(f"{folder.name}.partial")


def _clear(partial: Path, keep: str = "") -> None:
    """Remove what ``new_folder`` writes in an unfinished folder, but for finished work in ``keep``."""
    shutil.rmtree(partial / PLACE, ignore_errors=True)
    if keep and not has_work(partial / keep):
        shutil.rmtree(partial / keep, ignore_errors=True)


def _check_own(partial: Path, keep: str) -> None:
    """Raise ``UsageError`` if an unfinished folder holds what ``new_folder`` did not write."""
    foreign = [path for path in partial.iterdir() if path.name not in (LOCK, PLACE, keep)]
    if foreign:
        raise UsageError(
            f"{foreign[0]} is in the way, which is no work of a command; move it, or choose another place "
            "with --out"
        )


def has_work(folder: Path) -> bool:
    """Whether a folder holds finished pieces of work."""
    return any(not path.name.startswith(TEMPORARY) for path in folder.glob("*.npz"))


def hash_arrays(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of names, dtypes, shapes and contents of arrays."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        digest.update(f"{name} {array.dtype} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
