"""Reading arrays from untrusted npz files, as their fields declare them, with faults reported as sentences.

``read_arrays`` reads all such files except those of ``journal``, which hold their own hash. Before it
allocates any memory, it compares the headers with the declaration and with the size of the file. It never
executes anything from a file, and converts valid but foreign data, such as big-endian numbers.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from envs.errors import DataError, printable
from mgpo_jax.array_fields import (
    CHUNK,
    ArrayField,
    ArrayHeader,
    FaultError,
    Sizes,
    check_kinds,
    check_shapes,
    check_values,
    damaged,
    read_header,
)
from mgpo_jax.schema import tail_of

MAX_MEMBERS = 10_000
FREE, MAX_RATIO = 512 << 20, 100
"""Arrays whose sizes are not known beforehand may together unpack to ``FREE`` bytes, or to ``MAX_RATIO``
times the size of their file, whichever is more."""
DEFLATE = 1032  # largest compression ratio of the deflate format
_UNREADABLE = (
    OSError, EOFError, NotImplementedError, OverflowError, RuntimeError, ValueError, struct.error,
    zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error,
)  # fmt: skip
"""The exceptions that ``zipfile`` raises for files that are damaged or use unsupported features."""


def array_names(path: Path, mend: str = "") -> list[str]:
    """The names of the arrays in an npz file, from its directory alone.

    Raises:
      DataError: if the file is missing or is not an npz file.
    """
    with _opened(path, mend) as archive:
        return list(_members(archive))


def array_headers(path: Path, mend: str = "") -> dict[str, ArrayHeader]:
    """Shapes and dtypes of the arrays in an npz file, without reading them.

    Raises:
      DataError: if the file is missing or is not an npz file, or an array cannot be as large as it claims.
    """
    with _opened(path, mend) as archive:
        members = _members(archive)
        headers = {name: _header(archive, name, info) for name, info in members.items()}
        _check_claims(headers, members)
        return headers


def read_arrays(
    path: Path,
    fields: Mapping[str, ArrayField],
    sizes: Sizes | None = None,
    mend: str = "",
    *,
    only: bool = False,
) -> dict[str, np.ndarray]:
    """Read arrays of an npz file, checked and converted according to their fields.

    Args:
      path: the file.
      fields: the arrays to read, by name; others are not read.
      sizes: known sizes of axes, by name.
      mend: how to mend a faulty file, the end of the message.
      only: whether other arrays in the file are an error.

    Raises:
      DataError: if the file is missing or damaged, or an array differs from its field.
    """
    with _opened(path, mend) as archive:
        members = _members(archive)
        if only and (foreign := sorted(members.keys() - fields.keys())):
            raise FaultError(f" has the unexpected array {printable(foreign[0])}")
        headers = {
            name: _header(archive, name, members[name]) for name in fields if name in members
        }
        check_kinds(headers, fields)
        _check_claims(headers, members)
        check_shapes(headers, fields, sizes or {})
        _check_unpacked_size(headers, fields, sizes or {}, path.stat().st_size)
        return {
            name: _read_member(archive, members[name], name, header, fields[name])
            for name, header in headers.items()
        }


@contextmanager
def _opened(path: Path, mend: str) -> Iterator[zipfile.ZipFile]:
    """Open an npz file for reading; any fault within the block becomes a ``DataError``."""
    if not path.is_file():
        raise DataError(f"{path} is missing{tail_of(mend)}")
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except PermissionError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}){tail_of(mend)}") from None
    except FaultError as fault:
        raise DataError(f"{path}{fault}{tail_of(mend)}") from None
    except _UNREADABLE:
        raise DataError(f"{path} is not a readable npz file{tail_of(mend)}") from None


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """The members of an archive, by the names of the arrays."""
    infos = archive.infolist()
    if len(infos) > MAX_MEMBERS:
        raise FaultError(f" is not a readable npz file: it has {len(infos)} members")
    found: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        name = info.filename.removesuffix(".npy")
        if name in found:
            raise damaged(name, "occurs twice")
        found[name] = info
    return found


def _header(archive: zipfile.ZipFile, name: str, info: zipfile.ZipInfo) -> ArrayHeader:
    """The header of the array in a member, without reading the array."""
    if info.flag_bits & 1:
        raise damaged(name, "is encrypted")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise damaged(name, f"has the unknown compression method {info.compress_type}")
    try:
        with archive.open(info) as file:
            return read_header(name, file)
    except _UNREADABLE:
        raise damaged(name, "is damaged") from None


def _check_claims(
    headers: Mapping[str, ArrayHeader], members: Mapping[str, zipfile.ZipInfo]
) -> None:
    """Raise if an array cannot have the size that its header claims, before memory is allocated for it."""
    for name, header in headers.items():
        info = members[name]
        held = info.file_size - header.offset
        stored = info.compress_type == zipfile.ZIP_STORED
        most = info.compress_size * (1 if stored else DEFLATE) + (0 if stored else DEFLATE)
        if header.size * header.dtype.itemsize != held or not info.file_size <= most:
            raise FaultError(
                f": {name} declares shape {list(header.shape)} of {header.dtype}, but the file holds "
                f"{min(held, most)} bytes of it"
            )


def _check_unpacked_size(
    headers: Mapping[str, ArrayHeader],
    fields: Mapping[str, ArrayField],
    sizes: Sizes,
    file_size: int,
) -> None:
    """Raise if a small file would unpack to unexpectedly large arrays (a decompression bomb)."""
    total = sum(
        header.size * fields[name].target(header.dtype).itemsize
        for name, header in headers.items()
        if not _is_expected(fields[name], sizes)
    )
    if total > max(FREE, MAX_RATIO * file_size):
        raise FaultError(
            f" declares {total >> 20} MB of arrays in a file of {file_size >> 20} MB, so it must be damaged"
        )


def _is_expected(field: ArrayField, sizes: Sizes) -> bool:
    """Whether the sizes of all axes of an array are known before its file is opened."""
    known = {name for name, size in sizes.items() if isinstance(size, int)}
    return all(isinstance(axis, int) or axis in known for axis in field.shape)


def _read_member(
    archive: zipfile.ZipFile,
    info: zipfile.ZipInfo,
    name: str,
    header: ArrayHeader,
    field: ArrayField,
) -> np.ndarray:
    """Read one array, checked and converted piece by piece, so that it is never in memory twice."""
    array = np.empty(header.shape, field.target(header.dtype))
    # Numbers are stored in C order (last axis fastest), or in Fortran order (first axis fastest).
    flat = array.T.flat if header.fortran else array.reshape(-1)
    step, itemsize, first = max(1, CHUNK // header.dtype.itemsize), header.dtype.itemsize, 0
    try:
        with archive.open(info) as file:
            file.read(header.offset)
            while first < array.size:
                raw = file.read(min(step, array.size - first) * itemsize)
                if not raw or len(raw) % itemsize:
                    raise EOFError
                # Any byte but 0 means true.
                values = (
                    np.frombuffer(raw, np.uint8) != 0
                    if header.dtype.kind == "b"
                    else np.frombuffer(raw, header.dtype)
                )
                check_values(values, name, header, field, first)
                with np.errstate(all="ignore"):  # with `any_value`, a number may overflow the dtype
                    flat[first : first + len(values)] = values
                first += len(values)
            file.read(1)  # reaching the end makes zipfile verify the checksum
    except _UNREADABLE:
        raise damaged(name, "is damaged") from None
    return array
