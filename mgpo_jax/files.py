"""Files that are never seen half written, and reading them with errors that say what is wrong."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from envs.errors import DataError


def hash_file(path: Path) -> str:
    """SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an npz file.

    Raises:
      DataError: if it is missing or damaged, or is something else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    # TypeError: a lone array, whatever the name of its file says
    except (OSError, EOFError, TypeError, ValueError, zipfile.BadZipFile, zlib.error):
        raise DataError(f"{path} is not a readable npz file") from None


def read_object(path: Path, mend: str = "") -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
      DataError: if it is missing, is not JSON or is something else; the message ends in ``mend``.
    """
    tail = f"; {mend}" if mend else ""
    try:
        value = json.loads(path.read_text())
    except OSError:
        raise DataError(f"{path} is missing{tail}") from None
    except ValueError:
        raise DataError(f"{path} is not readable JSON{tail}") from None
    if not isinstance(value, dict):
        raise DataError(f"{path} does not hold a JSON object{tail}")
    return value


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


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file that is never seen half written."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(to_json(value), indent=2) + "\n")
    partial.rename(path)


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A place to write to, which becomes ``folder`` when all is written.

    If writing fails, what was written so far is removed.

    Raises:
      DataError: if ``folder`` exists.
    """
    if folder.exists():
        raise DataError(f"{folder} exists already; remove it or choose another place with --out")
    partial = folder.with_name(f"{folder.name}.partial-{os.getpid()}")
    partial.mkdir(parents=True)
    try:
        yield partial
        partial.rename(folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
