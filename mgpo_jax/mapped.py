"""Arrays that are mapped into memory from npy files, or lie there already, checked as they are declared.

Nothing is read at once: values are checked piece by piece, and large mapped arrays give their pages back.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from envs.errors import DataError
from mgpo_jax.array_fields import (
    CHUNK,
    ArrayField,
    ArrayHeader,
    FaultError,
    Sizes,
    check_kinds,
    check_shapes,
    check_values,
    read_header,
)
from mgpo_jax.schema import tail_of


def mapped_headers(folder: Path, names: Iterable[str], mend: str = "") -> dict[str, ArrayHeader]:
    """Shapes and dtypes of the arrays in the files ``NAME.npy`` of a folder, without reading them.

    Raises:
      DataError: if a file is missing, is not an npy file, or has another size than its header claims.
    """
    found = {}
    for name in names:
        path = folder / f"{name}.npy"
        try:
            with open(path, "rb") as file:
                header = read_header(path.name, file)
                held = os.fstat(file.fileno()).st_size - header.offset
            if header.size * header.dtype.itemsize != held:
                raise FaultError(
                    f" declares shape {list(header.shape)} of {header.dtype}, but holds {held} bytes of "
                    "data"
                )
        except FileNotFoundError:
            raise DataError(f"{path} is missing{tail_of(mend)}") from None
        except OSError as error:
            raise DataError(f"{path} cannot be read ({error.strerror}){tail_of(mend)}") from None
        except FaultError as fault:
            raise DataError(f"{path}{fault}{tail_of(mend)}") from None
        found[name] = header
    return found


def mapped_arrays(
    folder: Path,
    fields: Mapping[str, ArrayField],
    sizes: Sizes | None = None,
    mend: str = "",
) -> dict[str, np.ndarray]:
    """Map the arrays in the files ``NAME.npy`` of a folder into memory, read-only.

    Nothing is converted, so dtypes must be those of the fields. Values are checked piece by piece, and
    checked pieces do not stay in memory. An empty array cannot be mapped and is created instead.

    Args:
      folder: the folder of the files.
      fields: the arrays to map, by name. Those that are not required may be missing.
      sizes: known sizes of axes, by name.
      mend: how to mend a faulty file, the end of the message.

    Raises:
      DataError: if a file is missing or damaged, or an array differs from its field.
    """
    there = [name for name, f in fields.items() if f.required or _npy(folder, name).is_file()]
    headers = mapped_headers(folder, there, mend)
    found = {}
    try:
        check_kinds(headers, fields)
        check_shapes(headers, fields, sizes or {})
        for name, header in headers.items():
            if header.fortran or header.dtype != fields[name].target(header.dtype):
                order = " in Fortran order" if header.fortran else ""
                raise FaultError(
                    f": {name} has the wrong dtype or memory order, found {header.dtype}{order}, expected "
                    f"{fields[name].target(header.dtype)} in C order"
                )
            place = _npy(folder, name)
            array = (
                np.memmap(place, header.dtype, "r", header.offset, header.shape)
                if header.size
                else np.zeros(header.shape, header.dtype)
            )
            _check_pieces(array, name, header, fields[name])
            found[name] = array
    except FaultError as fault:
        raise DataError(f"{folder}{fault}{tail_of(mend)}") from None
    return found


def _npy(folder: Path, name: str) -> Path:
    return folder / f"{name}.npy"


def _check_pieces(array: np.ndarray, name: str, header: ArrayHeader, field: ArrayField) -> None:
    """Apply ``check_values`` to a whole array, piece by piece, so that little of it is in memory at a
    time."""
    if field.any_value or header.dtype.kind == "b":
        return
    flat = array.reshape(-1)
    step = max(1, 16 * CHUNK // header.dtype.itemsize)
    for first in range(0, len(flat), step):
        check_values(flat[first : first + step], name, header, field, first)
        let_go(array)


RESIDENT = 64 << 20
"""Number of bytes of a mapped array that may stay resident in memory."""


def let_go(array: np.ndarray) -> None:
    """Drop the pages of a large mapped array from the process's resident memory.

    They stay in the kernel's page cache as long as there is room, so that reading them again is cheap.
    Without this, the process's reported memory grows by every page that it has ever touched.
    """
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, mmap.mmap) and len(base) > RESIDENT and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


def fitted_arrays(
    arrays: Mapping[str, np.ndarray],
    fields: Mapping[str, ArrayField],
    where: Path | str,
    sizes: Sizes | None = None,
    mend: str = "",
) -> dict[str, np.ndarray]:
    """Check and convert arrays in memory, in the same way as ``read_arrays``.

    Raises:
      DataError: if an array is missing or differs from its field.
    """
    headers = {
        name: ArrayHeader(arrays[name].shape, arrays[name].dtype)
        for name in fields
        if name in arrays
    }
    try:
        check_kinds(headers, fields)
        check_shapes(headers, fields, sizes or {})
        for name, header in headers.items():
            _check_pieces(arrays[name], name, header, fields[name])
    except FaultError as fault:
        raise DataError(f"{where}{fault}{tail_of(mend)}") from None
    return {
        name: arrays[name].astype(fields[name].target(header.dtype), copy=False)
        for name, header in headers.items()
    }
