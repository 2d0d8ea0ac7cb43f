"""A journal of finished pieces of long work on disk, from which a killed process can be resumed.

If several processes work together, process 0 keeps the records and sends the others what it reads.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mgpo_jax import processes
from mgpo_jax.files import hash_arrays, remove_unfinished, write_arrays

_HASH = "sha256"


class Journal:
    """Named records of arrays on disk, which are written atomically.

    Args:
      folder: the folder of the records, in process 0; None keeps no records.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            remove_unfinished(folder)
        self.keeps = processes.from_first(lambda: folder is not None)
        """Whether records are kept; the same in all processes, each of which must make a journal."""

    def read(self, name: str) -> dict[str, np.ndarray] | None:
        """The record of a name; None if it is missing or damaged."""
        return processes.arrays_from_first(lambda: self._read(name)) if self.keeps else None

    def _read(self, name: str) -> dict[str, np.ndarray] | None:
        path = None if self.folder is None else self.folder / f"{name}.npz"
        if path is None or not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = dict(file)
            if str(arrays.pop(_HASH)) != hash_arrays(arrays):
                raise ValueError("hash")
        except Exception:  # numpy and zipfile raise many kinds for a damaged file
            print(f"{path} is damaged; that piece of the work is done again", file=sys.stderr)
            return None
        return arrays

    def write(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Write a record, which is on disk when the call returns."""
        if self.folder is not None:
            sealed = {**arrays, _HASH: np.array(hash_arrays(arrays))}
            write_arrays(self.folder / f"{name}.npz", sealed, compressed=False)
