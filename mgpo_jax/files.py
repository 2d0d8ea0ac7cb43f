"""Files that are never seen half written, and reading them with errors that say what is wrong."""

from __future__ import annotations

import hashlib
import os
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from mgpo_jax.errors import DataError


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


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A place to write to, which becomes ``folder`` when all is written.

    Raises:
      DataError: if ``folder`` exists.
    """
    if folder.exists():
        raise DataError(f"{folder} exists already; remove it or choose another place with --out")
    partial = folder.with_name(f"{folder.name}.partial-{os.getpid()}")
    partial.mkdir(parents=True)
    yield partial
    partial.rename(folder)
