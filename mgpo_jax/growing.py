"""Arrays in npy files that grow row by row, so that data of any size are written with little memory."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np


class GrowingFile:
    """An npy file to which rows are appended; ``finish`` writes their number into its header.

    Args:
      path: the file, which is replaced.
      rows: rows of the shape and dtype of those that will be appended.
    """

    def __init__(self, path: Path, rows: np.ndarray) -> None:
        self.file = open(path, "wb")  # noqa: SIM115 (GrowingFiles closes it)
        self.shape, self.dtype, self.num = rows.shape[1:], rows.dtype, 0
        self._write_header()
        self.start = self.file.tell()

    def _write_header(self) -> None:
        # The header of an npy file has padding for the first axis to grow.
        header = {
            "descr": np.lib.format.dtype_to_descr(self.dtype),
            "fortran_order": False,
            "shape": (self.num, *self.shape),
        }
        np.lib.format.write_array_header_1_0(self.file, header)

    def append(self, rows: np.ndarray) -> None:
        if (rows.shape[1:], rows.dtype) != (self.shape, self.dtype):
            raise ValueError(
                f"rows of {rows.dtype}{list(rows.shape[1:])} do not fit into {self.file.name}, which has "
                f"{self.dtype}{list(self.shape)}"
            )
        self.file.write(np.ascontiguousarray(rows).tobytes())
        self.num += len(rows)

    def finish(self) -> None:
        self.file.seek(0)
        self._write_header()
        if self.file.tell() != self.start:
            raise RuntimeError("the header of an npy file has grown")
        self.file.close()


class GrowingFiles:
    """The files ``NAME.npy`` of a folder, one for each array, to which rows are appended.

    It is a context manager, which closes the files. They can be read only after ``finish``.

    Args:
      folder: the folder of the files.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.files = folder, dict[str, GrowingFile]()

    def __enter__(self) -> GrowingFiles:
        return self

    def __exit__(self, *args: object) -> None:
        for file in self.files.values():
            file.file.close()

    def append(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Append the rows of each array to its file.

        Raises:
          ValueError: if the names, shapes or dtypes of the arrays differ from those of the first call.
        """
        if not self.files:
            self.files = {n: GrowingFile(self.folder / f"{n}.npy", a) for n, a in arrays.items()}
        if arrays.keys() != self.files.keys():
            raise ValueError(f"arrays {sorted(arrays)} do not fit the files {sorted(self.files)}")
        for name, file in self.files.items():
            file.append(arrays[name])

    def finish(self) -> dict[str, Path]:
        """Finish all files; returns their paths by the names of the arrays."""
        for file in self.files.values():
            file.finish()
        return {name: self.folder / f"{name}.npy" for name in self.files}
