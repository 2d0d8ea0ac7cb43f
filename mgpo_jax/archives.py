"""Reading arrays from untrusted files, with a schema and with faults reported as plain sentences.

``ArrayField`` declares an array of an npz file: its axes, its kind of numbers and their range.
``read_arrays`` reads all such files except those of ``journal``, which hold their own hash. Before it
allocates any memory, it compares the headers with the declaration and with the size of the file. It never
executes anything from a file, and converts valid but foreign data, such as big-endian numbers.
``mapped_arrays`` does the same for arrays in npy files, which it maps into memory without conversion.
"""

from __future__ import annotations

import ast
import math
import mmap
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import EllipsisType
from typing import Any, Literal, NamedTuple

import numpy as np

from envs.errors import DataError, printable
from mgpo_jax.schema import tail_of

MAX_MEMBERS = 10_000
MAX_HEADER = 4096  # bytes; numpy writes 118
FREE, MAX_RATIO = 512 << 20, 100
"""Arrays whose sizes are not known beforehand may together unpack to ``FREE`` bytes, or to ``MAX_RATIO``
times the size of their file, whichever is more."""
DEFLATE = 1032  # largest compression ratio of the deflate format
CHUNK = 1 << 20  # bytes that are read, checked and converted at a time
LARGEST = 1e18  # largest magnitude of a number, unless its field says otherwise
_KINDS = {"integers": "iu", "numbers": "iuf", "anything": "biuf"}
_WORDS_OF_KINDS = {
    "b": "booleans",
    "iu": "integers",
    "iuf": "numbers",
    "biuf": "numbers or booleans",
}
_UNREADABLE = (
    OSError, EOFError, NotImplementedError, OverflowError, RuntimeError, ValueError, struct.error,
    zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error,
)  # fmt: skip
"""The exceptions that ``zipfile`` raises for files that are damaged or use unsupported features."""


@dataclass(frozen=True)
class ArrayField:
    """The declaration of one array of a file.

    Attributes:
      shape: its axes. A number is a size. A word is the name of a size, which is the same for all axes of
        that name, and stands for the axis in messages. ``...`` at the end stands for any further axes.
      dtype: the dtype that the array is converted to. With ``integers``, ``numbers`` or ``anything`` (which
        includes booleans) it keeps its own dtype. Integers are accepted as numbers, but not the reverse.
      required: whether the array must be present.
      low: smallest allowed value (default: the smallest of the dtype, -1e18 for floats).
      high: largest allowed value (default: the largest of the dtype, 1e18 for floats).
      any_value: whether any value is allowed, including NaN and infinity.
    """

    shape: tuple[int | str | EllipsisType, ...]
    dtype: str
    required: bool = True
    low: int | float | None = None
    high: int | float | None = None
    any_value: bool = False

    @property
    def kinds(self) -> str:
        """The numpy kinds (``dtype.kind``) that can be converted to the dtype of the field."""
        if self.dtype in _KINDS:
            return _KINDS[self.dtype]
        kind = np.dtype(self.dtype).kind
        return "iuf" if kind == "f" else "iu" if kind in "iu" else kind

    def target(self, found: np.dtype) -> np.dtype:
        """The dtype that an array of dtype ``found`` is converted to."""
        return found.newbyteorder("=") if self.dtype in _KINDS else np.dtype(self.dtype)

    def limits(self, target: np.dtype) -> tuple[Any, Any]:
        """The smallest and the largest value that an array may hold after conversion to ``target``."""
        if target.kind == "f":
            most = min(LARGEST, float(np.finfo(target).max))
            least: Any = -most
        else:
            info = np.iinfo(target)
            least, most = int(info.min), int(info.max)
        return (
            least if self.low is None else max(least, self.low),
            most if self.high is None else min(most, self.high),
        )


class ArrayHeader(NamedTuple):
    """The header of an array, which is known before the array is read."""

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran: bool = False
    offset: int = 0
    """Size of the header in bytes, after which the numbers begin."""

    @property
    def size(self) -> int:
        return math.prod(self.shape)


Sizes = Mapping[str, int | range]
"""Sizes of axes by name: a number, or the range in which it must lie."""


class _FaultError(Exception):
    """A fault of an npz file; the text follows the file's name in a message."""


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
                header = _read_header(path.name, file)
                held = os.fstat(file.fileno()).st_size - header.offset
            if header.size * header.dtype.itemsize != held:
                raise _FaultError(
                    f" declares shape {list(header.shape)} of {header.dtype}, but holds {held} bytes of "
                    "data"
                )
        except FileNotFoundError:
            raise DataError(f"{path} is missing{tail_of(mend)}") from None
        except OSError as error:
            raise DataError(f"{path} cannot be read ({error.strerror}){tail_of(mend)}") from None
        except _FaultError as fault_:
            raise DataError(f"{path}{fault_}{tail_of(mend)}") from None
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
        _check_kinds(headers, fields)
        _check_shapes(headers, fields, sizes or {})
        for name, header in headers.items():
            if header.fortran or header.dtype != fields[name].target(header.dtype):
                order = " in Fortran order" if header.fortran else ""
                raise _FaultError(
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
    except _FaultError as fault_:
        raise DataError(f"{folder}{fault_}{tail_of(mend)}") from None
    return found


def _npy(folder: Path, name: str) -> Path:
    return folder / f"{name}.npy"


def _check_pieces(array: np.ndarray, name: str, header: ArrayHeader, field: ArrayField) -> None:
    """Apply ``_check_values`` to a whole array, piece by piece, so that little of it is in memory at a
    time."""
    if field.any_value or header.dtype.kind == "b":
        return
    flat = array.reshape(-1)
    step = max(1, 16 * CHUNK // header.dtype.itemsize)
    for first in range(0, len(flat), step):
        _check_values(flat[first : first + step], name, header, field, first)
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
            raise _FaultError(f" has the unexpected array {printable(foreign[0])}")
        headers = {
            name: _header(archive, name, members[name]) for name in fields if name in members
        }
        _check_kinds(headers, fields)
        _check_claims(headers, members)
        _check_shapes(headers, fields, sizes or {})
        _check_unpacked_size(headers, fields, sizes or {}, path.stat().st_size)
        return {
            name: _read_member(archive, members[name], name, header, fields[name])
            for name, header in headers.items()
        }


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
        _check_kinds(headers, fields)
        _check_shapes(headers, fields, sizes or {})
        for name, header in headers.items():
            _check_pieces(arrays[name], name, header, fields[name])
    except _FaultError as fault_:
        raise DataError(f"{where}{fault_}{tail_of(mend)}") from None
    return {
        name: arrays[name].astype(fields[name].target(header.dtype), copy=False)
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
    except _FaultError as fault_:
        raise DataError(f"{path}{fault_}{tail_of(mend)}") from None
    except _UNREADABLE:
        raise DataError(f"{path} is not a readable npz file{tail_of(mend)}") from None


def _damaged(name: str, what: str) -> _FaultError:
    return _FaultError(f" is not a readable npz file: {printable(name[:200])} {what}")


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """The members of an archive, by the names of the arrays."""
    infos = archive.infolist()
    if len(infos) > MAX_MEMBERS:
        raise _FaultError(f" is not a readable npz file: it has {len(infos)} members")
    found: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        name = info.filename.removesuffix(".npy")
        if name in found:
            raise _damaged(name, "occurs twice")
        found[name] = info
    return found


def _header(archive: zipfile.ZipFile, name: str, info: zipfile.ZipInfo) -> ArrayHeader:
    """The header of the array in a member, without reading the array."""
    if info.flag_bits & 1:
        raise _damaged(name, "is encrypted")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise _damaged(name, f"has the unknown compression method {info.compress_type}")
    try:
        with archive.open(info) as file:
            return _read_header(name, file)
    except _UNREADABLE:
        raise _damaged(name, "is damaged") from None


def _read_header(name: str, file: Any) -> ArrayHeader:
    """Read the header from the first bytes of an array in npy format."""
    start = file.read(8)
    if start[:6] != b"\x93NUMPY":
        raise _damaged(name, "is not an array")
    width = {1: 2, 2: 4, 3: 4}.get(start[6], 0) if len(start) == 8 else 0
    length = int.from_bytes(file.read(width), "little")
    if not width or length > MAX_HEADER:
        raise _damaged(name, "has a damaged header")
    return _parsed_header(name, file.read(length), 8 + width + length)


def _parsed_header(name: str, text: bytes, offset: int) -> ArrayHeader:
    try:
        if sum(text.count(bracket) for bracket in b"([{") > 8:  # deep nesting exhausts the parser
            raise ValueError
        said = ast.literal_eval(text.decode("latin1").strip())
        descr, fortran, shape = (said[key] for key in ("descr", "fortran_order", "shape"))
        if not isinstance(descr, str):
            raise _damaged(name, "has a structured dtype")
        if not re.fullmatch(r"[<>|=]?[biufcSUVOmM?]\d{0,9}(\[\w{1,9}\])?", descr):
            raise ValueError
        dtype = np.dtype(descr)
        sound = isinstance(shape, tuple) and all(
            type(size) is int and 0 <= size < 2**63 for size in shape
        )
        if not sound or type(fortran) is not bool or len(shape) > 32:
            raise ValueError
    except (KeyError, MemoryError, RecursionError, SyntaxError, TypeError, ValueError):
        raise _damaged(name, "has a damaged header") from None
    return ArrayHeader(shape, dtype, fortran, offset)


def _check_kinds(headers: Mapping[str, ArrayHeader], fields: Mapping[str, ArrayField]) -> None:
    """Raise if arrays are missing, or for the first array with another kind of numbers than its field."""
    missing = [name for name, field in fields.items() if field.required and name not in headers]
    if missing:
        raise _FaultError(f" lacks {', '.join(missing)}")
    for name, header in headers.items():
        if header.dtype.kind not in fields[name].kinds:
            words = _WORDS_OF_KINDS[fields[name].kinds]
            raise _FaultError(f": {name} must hold {words}, found {header.dtype}")


def _check_shapes(
    headers: Mapping[str, ArrayHeader], fields: Mapping[str, ArrayField], sizes: Sizes
) -> None:
    """Raise for the first array whose shape does not match its field, given the sizes of named axes so
    far."""
    known = {
        axis: _exact_range(size) if isinstance(size, int) else size for axis, size in sizes.items()
    }
    for name, header in headers.items():
        if not _fits(header.shape, fields[name], known):
            wanted = ", ".join(_axis_text(axis, known) for axis in fields[name].shape)
            raise _FaultError(f": {name} has shape {list(header.shape)}, wanted [{wanted}]")


def _exact_range(size: int) -> range:
    return range(size, size + 1)


def _fits(shape: Sequence[int], field: ArrayField, known: dict[str, range]) -> bool:
    """Whether a shape matches a field; sizes of named axes that were not known are added to ``known``."""
    axes = [axis for axis in field.shape if not isinstance(axis, EllipsisType)]
    if len(shape) < len(axes) or (len(shape) > len(axes) and ... not in field.shape):
        return False
    for axis, size in zip(axes, shape, strict=False):
        if size not in (
            _exact_range(axis) if isinstance(axis, int) else known.get(axis, _exact_range(size))
        ):
            return False
        if isinstance(axis, str):
            known[axis] = _exact_range(size)
    return True


def _axis_text(axis: int | str | EllipsisType, known: Mapping[str, range]) -> str:
    """An axis of a field as text for a message, with its size if that is known."""
    if not isinstance(axis, str):
        return "..." if isinstance(axis, EllipsisType) else str(axis)
    sizes = known.get(axis)
    if sizes is None:
        return axis
    return f"{axis} {sizes[0]}" if len(sizes) == 1 else f"{axis} {sizes[0]} to {sizes[-1]}"


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
            raise _FaultError(
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
        raise _FaultError(
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
                _check_values(values, name, header, field, first)
                with np.errstate(all="ignore"):  # with `any_value`, a number may overflow the dtype
                    flat[first : first + len(values)] = values
                first += len(values)
            file.read(1)  # reaching the end makes zipfile verify the checksum
    except _UNREADABLE:
        raise _damaged(name, "is damaged") from None
    return array


def _check_values(
    values: np.ndarray, name: str, header: ArrayHeader, field: ArrayField, first: int = 0
) -> None:
    """Raise for the first value that its field does not allow; ``first`` is the flat index of
    ``values[0]``."""
    if field.any_value or values.dtype.kind == "b" or not len(values):
        return
    low, high = field.limits(field.target(header.dtype))
    with np.errstate(all="ignore"):
        if values.min() >= low and values.max() <= high:  # false if there is a NaN
            return
        index = int(np.flatnonzero(~((values >= low) & (values <= high)))[0])
    value = values[index]
    found = f"{value:g}" if math.isfinite(value) else "NaN" if math.isnan(value) else "infinity"
    order: Literal["F", "C"] = "F" if header.fortran else "C"
    place = [int(axis) for axis in np.unravel_index(first + index, header.shape, order)]
    named = zip(field.shape, place, strict=False)
    words = [f"{axis} {number}" for axis, number in named if isinstance(axis, str)]
    where = ", ".join(words) if words else str(place)
    at = f" at {where}" if place else ""
    raise _FaultError(f": {name} holds {found}{at}, must be from {low:.12g} to {high:.12g}")
