"""What settings and files must look like, with faults as plain sentences.

A dataclass declares what is allowed in settings and JSON files: the type of a field is its type, and
``Annotated`` adds its range, as in ``settings.TrainConfig``. pydantic checks it strictly: ``true`` is no
number, ``"1"`` is no integer, and NaN and infinity are never allowed.

``ArrayField`` declares an array of an npz file: its axes, its kind of numbers and their range.
``read_arrays`` reads all such files but those of ``journal``, which hold their own hash. It compares what
the headers claim with what is declared and with the size of the file before it allocates any memory, runs
nothing that a file holds, and converts what is valid but foreign, such as big-endian numbers.
``mapped_arrays`` does the same for arrays in npy files, which it maps into memory as they are.
"""

from __future__ import annotations

import ast
import json
import math
import mmap
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import EllipsisType
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import (
    AfterValidator,
    ConfigDict,
    JsonValue,
    StringConstraints,
    TypeAdapter,
    ValidationError,
)
from pydantic_core import PydanticCustomError

from envs.errors import DataError, printable, shown

MAX_DOCUMENT = 16 << 20  # bytes of a JSON file; ours have some kB
STRICT = ConfigDict(strict=True, allow_inf_nan=False, extra="forbid")

SHA256 = r"^[0-9a-f]{64}$"

LIMITS: Mapping[str, str] = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
"""The limits of a range in words."""

_WORDS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "greater_than": lambda limits: _limit("gt", limits),
    "greater_than_equal": lambda limits: _limit("ge", limits),
    "less_than": lambda limits: _limit("lt", limits),
    "less_than_equal": lambda limits: _limit("le", limits),
    "string_too_short": lambda limits: "must not be empty",
    "finite_number": lambda limits: "must be a finite number",
    "literal_error": lambda limits: f"must be {limits['expected']}",
    "int_type": lambda limits: "must be an integer",
    "float_type": lambda limits: "must be a number",
    "bool_type": lambda limits: "must be true or false",
    "string_type": lambda limits: "must be text",
    "is_instance_of": lambda limits: f"must be a {limits['class']}",
    "none_required": lambda limits: "must be null",
    "string_pattern_mismatch": lambda limits: _pattern(limits["pattern"]),
    "string_too_long": lambda limits: f"must have at most {limits['max_length']} characters",
    "too_long": lambda limits: f"must have at most {limits['max_length']} entries",
    "too_short": lambda limits: f"must have at least {limits['min_length']} entries",
    **dict.fromkeys(("tuple_type", "list_type"), lambda limits: "must be a list"),
    **dict.fromkeys(
        ("dict_type", "model_type", "dataclass_type"), lambda limits: "must be an object"
    ),
}
"""What pydantic calls a fault, in the words of a message."""


def _limit(name: str, limits: Mapping[str, Any]) -> str:
    return f"must be {LIMITS[name]} {limits[name]:.12g}"


def _pattern(pattern: str) -> str:
    if pattern == SHA256:
        return "must be a SHA-256, 64 hexadecimal digits"
    return "is not a name that is allowed here"


def _all_finite(value: Any) -> Any:
    """The JSON value, if it holds neither NaN nor infinity, which the parser lets pass."""
    rest = [value]
    while rest:
        item = rest.pop()
        if isinstance(item, float) and not math.isfinite(item):
            raise PydanticCustomError("finite_number", "must hold finite numbers")
        rest += item if isinstance(item, list) else item.values() if isinstance(item, dict) else ()
    return value


Json = Annotated[JsonValue, AfterValidator(_all_finite)]
"""Anything that JSON can hold."""
Sha256 = Annotated[str, StringConstraints(pattern=SHA256)]
"""The hash of a file."""
Name = Annotated[str, StringConstraints(pattern=r"^\w[\w.-]{0,99}(:\w[\w.]{0,99})?$")]
"""The name of a world or a method, or its place as ``module:attribute``; it can stand in a path."""
DemonstratorName = Annotated[
    str, StringConstraints(max_length=200, pattern=r"^\w[\w.-]*(,\w+=[\w.+-]+)*$")
]
"""The name of a demonstrator, with the settings that were changed; it can stand in a path."""


@cache
def _adapter(type_: Any) -> TypeAdapter:
    return TypeAdapter(type_, config=STRICT)


@cache
def _document_adapter(type_: Any) -> TypeAdapter:
    return TypeAdapter(type_)


def fault(type_: Any, value: Any) -> str | None:
    """What is wrong with a value, as the end of a sentence; None if nothing is.

    >>> fault(Annotated[float, Gt(0)], -1.0)
    'must be above 0, found -1.0'
    """
    if isinstance(value, np.generic):  # a number of numpy is as good as one of Python
        value = value.item()
    try:
        _adapter(type_).validate_python(value)
    except ValidationError as error:
        return sentence(error, value)
    return None


def sentence(error: ValidationError, value: Any) -> str:
    """The first fault of a value, as the end of a sentence with what was found."""
    first = error.errors(include_url=False)[0]
    words = _WORDS.get(first["type"])
    said = words(first.get("ctx", {})) if words else first["msg"][:1].lower() + first["msg"][1:]
    return f"{said}, found {shown(value)}"


def read_document(path: Path, type_: Any, mend: str = "") -> Any:
    """The record in a JSON file.

    Args:
      path: the file.
      type_: a pydantic model or a dataclass, with ``STRICT`` as its ``model_config`` or
        ``__pydantic_config__``.
      mend: what mends a file that is not as it should be, the end of the message.

    Raises:
      DataError: if the file is missing, is no JSON, or differs from what ``type_`` declares.
    """
    return _validated(read_text(path, mend), type_, path, mend)


def checked_entry(value: Any, type_: Any, path: Path, entry: str, mend: str = "") -> Any:
    """The record in one entry of a JSON file that was read before.

    Raises:
      DataError: if it differs from what ``type_`` declares; the message names file and entry.
    """
    return _validated(json.dumps(value).encode(), type_, path, mend, entry)


def read_json_lines(path: Path, type_: Any, mend: str = "") -> list[Any]:
    """The records in a file with one JSON value a line.

    Raises:
      DataError: if the file is missing, or a line differs from what ``type_`` declares; the message names
        file and line.
    """
    lines = read_text(path, mend).splitlines()
    return [_validated(line, type_, f"{path}, line {n}", mend) for n, line in enumerate(lines, 1)]


def _validated(text: bytes, type_: Any, path: Path | str, mend: str, entry: str = "") -> Any:
    try:
        return _document_adapter(type_).validate_json(text)
    except ValidationError as error:
        raise DataError(f"{path}{_document_fault(error, entry)}{_tail(mend)}") from None


def read_text(path: Path, mend: str = "") -> bytes:
    """The bytes of a small text file.

    Raises:
      DataError: if it is missing, no file, too large or cannot be read.
    """
    tail = _tail(mend)
    try:
        if not path.is_file():
            raise DataError(f"{path} is missing{tail}")
        if path.stat().st_size > MAX_DOCUMENT:
            raise DataError(
                f"{path} has more than {MAX_DOCUMENT >> 20} MB, which is too large{tail}"
            )
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}){tail}") from None


def _tail(mend: str) -> str:
    """What mends a fault, as the end of a message."""
    return f"; {mend}" if mend else ""


def _document_fault(error: ValidationError, entry: str = "") -> str:
    """The first fault of a document, or of one entry of it, to stand after the name of its file."""
    first = error.errors(include_url=False)[0]
    place = printable(".".join([entry] * bool(entry) + list(map(str, first["loc"]))))
    if first["type"] == "json_invalid":
        return " is not readable JSON"
    if not place:
        return " does not hold a JSON object"
    if first["type"] in ("missing", "missing_argument"):
        return f" lacks {place}"
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f" has the unknown entry {place}"
    return f": {place} {sentence(error, first['input'])}"


# Arrays in npz files

MAX_MEMBERS = 10_000
MAX_HEADER = 4096  # bytes; numpy writes 118
FREE, MAX_RATIO = 512 << 20, 100
"""Arrays whose sizes are not known beforehand may have ``FREE`` bytes together, or ``MAX_RATIO`` times
those of their file."""
DEFLATE = 1032  # bytes that one deflated byte can stand for
CHUNK = 1 << 20  # bytes that are read, checked and converted at a time
LARGEST = 1e18  # of a number, unless its field says otherwise
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
"""What ``zipfile`` raises for files that are damaged or use what it does not know."""


@dataclass(frozen=True)
class ArrayField:
    """What one array of a file must look like.

    Attributes:
      shape: its axes. A number is a size. A word stands for the size that all axes of this name have, and
        names them in messages. ``...`` at the end stands for any further axes.
      dtype: the dtype that it is converted to, or ``integers``, ``numbers`` or ``anything`` (with
        booleans): then it keeps its own. Integers are numbers, but no number is taken as an integer.
      required: whether it has to be there.
      low: its smallest value (default: the smallest of the dtype, -1e18 for floats).
      high: its largest value, likewise.
      any_value: whether it may hold anything, NaN and infinity included.
    """

    shape: tuple[int | str | EllipsisType, ...]
    dtype: str
    required: bool = True
    low: int | float | None = None
    high: int | float | None = None
    any_value: bool = False

    @property
    def kinds(self) -> str:
        """The kinds of dtypes that can be converted to that of the field."""
        if self.dtype in _KINDS:
            return _KINDS[self.dtype]
        kind = np.dtype(self.dtype).kind
        return "iuf" if kind == "f" else "iu" if kind in "iu" else kind

    def target(self, found: np.dtype) -> np.dtype:
        """The dtype that an array of dtype ``found`` is converted to."""
        return found.newbyteorder("=") if self.dtype in _KINDS else np.dtype(self.dtype)

    def limits(self, target: np.dtype) -> tuple[Any, Any]:
        """The smallest and the largest value that an array may hold."""
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
    """What is known of an array before it is read."""

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran: bool = False
    offset: int = 0
    """Bytes of the header."""

    @property
    def size(self) -> int:
        return math.prod(self.shape)


Sizes = Mapping[str, int | range]
"""Sizes of axes by name: a number, or the range in which it must lie."""


class _FaultError(Exception):
    """What is wrong with an npz file, to stand after its name."""


def array_names(path: Path, mend: str = "") -> list[str]:
    """The names of the arrays in an npz file, from its directory alone.

    Raises:
      DataError: if it is missing or no npz file.
    """
    with _opened(path, mend) as archive:
        return list(_members(archive))


def array_headers(path: Path, mend: str = "") -> dict[str, ArrayHeader]:
    """Shapes and dtypes of the arrays in an npz file, without reading them.

    Raises:
      DataError: if it is missing, no npz file, or an array cannot be as large as it claims.
    """
    with _opened(path, mend) as archive:
        members = _members(archive)
        headers = {name: _header(archive, name, info) for name, info in members.items()}
        _check_claims(headers, members)
        return headers


def mapped_headers(folder: Path, names: Iterable[str], mend: str = "") -> dict[str, ArrayHeader]:
    """Shapes and dtypes of the arrays in the files ``NAME.npy`` of a folder, without reading them.

    Raises:
      DataError: if one is missing, no npy file, or has another size than its header claims.
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
                    f" claims shape {list(header.shape)} of {header.dtype}, the file has {held} bytes of it"
                )
        except FileNotFoundError:
            raise DataError(f"{path} is missing{_tail(mend)}") from None
        except OSError as error:
            raise DataError(f"{path} cannot be read ({error.strerror}){_tail(mend)}") from None
        except _FaultError as fault_:
            raise DataError(f"{path}{fault_}{_tail(mend)}") from None
        found[name] = header
    return found


def mapped_arrays(
    folder: Path,
    fields: Mapping[str, ArrayField],
    sizes: Sizes | None = None,
    mend: str = "",
) -> dict[str, np.ndarray]:
    """Arrays in the files ``NAME.npy`` of a folder, as their fields say, mapped into memory to read.

    Nothing is converted, so dtypes have to be those of the fields. Values are checked piece by piece, and
    what was looked at does not stay in memory. An empty array is none that can be mapped, and is made.

    Args:
      folder: where the files lie.
      fields: what is wanted, by name. Those that are not required may be missing.
      sizes: what is known of the sizes of axes.
      mend: what mends a file that is not as it should be, the end of the message.

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
                raise _FaultError(f": {name} has the dtype or order {header.dtype}, not its own")
            place = _npy(folder, name)
            array = (
                np.memmap(place, header.dtype, "r", header.offset, header.shape)
                if header.size
                else np.zeros(header.shape, header.dtype)
            )
            _check_pieces(array, name, header, fields[name])
            found[name] = array
    except _FaultError as fault_:
        raise DataError(f"{folder}{fault_}{_tail(mend)}") from None
    return found


def _npy(folder: Path, name: str) -> Path:
    return folder / f"{name}.npy"


def _check_pieces(array: np.ndarray, name: str, header: ArrayHeader, field: ArrayField) -> None:
    """``_check_values`` of all of an array, of which little is in memory at a time."""
    if field.any_value or header.dtype.kind == "b":
        return
    flat = array.reshape(-1)
    step = max(1, 16 * CHUNK // header.dtype.itemsize)
    for first in range(0, len(flat), step):
        _check_values(flat[first : first + step], name, header, field, first)
        let_go(array)


RESIDENT = 64 << 20
"""Bytes of a mapped array that may stay in memory."""


def let_go(array: np.ndarray) -> None:
    """Take what was read of a large mapped array out of the process's memory.

    It stays in the kernel's cache as long as there is room, so that reading it again is cheap. Without
    this, a process seems to grow by every page that it has ever looked at.
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
    """Arrays of an npz file, as their fields say; nothing else in the file is read.

    Args:
      path: the file.
      fields: what is wanted, by name.
      sizes: what is known of the sizes of axes.
      mend: what mends a file that is not as it should be, the end of the message.
      only: whether other arrays are an error.

    Raises:
      DataError: if the file is missing or damaged, or an array differs from its field.
    """
    with _opened(path, mend) as archive:
        members = _members(archive)
        if only and (foreign := sorted(members.keys() - fields.keys())):
            raise _FaultError(f": {printable(foreign[0])} is foreign")
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
    """Arrays in memory, checked and converted like those that ``read_arrays`` reads.

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
        raise DataError(f"{where}{fault_}{_tail(mend)}") from None
    return {
        name: arrays[name].astype(fields[name].target(header.dtype), copy=False)
        for name, header in headers.items()
    }


@contextmanager
def _opened(path: Path, mend: str) -> Iterator[zipfile.ZipFile]:
    """An npz file to read; whatever is wrong with it becomes a ``DataError``."""
    if not path.is_file():
        raise DataError(f"{path} is missing{_tail(mend)}")
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except PermissionError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}){_tail(mend)}") from None
    except _FaultError as fault_:
        raise DataError(f"{path}{fault_}{_tail(mend)}") from None
    except _UNREADABLE:
        raise DataError(f"{path} is not a readable npz file{_tail(mend)}") from None


def _damaged(name: str, what: str) -> _FaultError:
    return _FaultError(f" is not a readable npz file: {printable(name[:200])} {what}")


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """What the archive holds, by the names of the arrays."""
    infos = archive.infolist()
    if len(infos) > MAX_MEMBERS:
        raise _FaultError(f" is not a readable npz file: it has {len(infos)} members")
    found: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        name = info.filename.removesuffix(".npy")
        if name in found:
            raise _damaged(name, "is there twice")
        found[name] = info
    return found


def _header(archive: zipfile.ZipFile, name: str, info: zipfile.ZipInfo) -> ArrayHeader:
    """What a member says of its array, without reading it."""
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
    """What the first bytes of an array in the format npy say of it."""
    start = file.read(8)
    if start[:6] != b"\x93NUMPY":
        raise _damaged(name, "is no array")
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
            raise _damaged(name, "holds records")
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
    """Raise for arrays that are missing, or the first that has another kind of numbers than its field."""
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
    """Raise for the first array that has another shape than its field and those before it."""
    known = {axis: _only(size) if isinstance(size, int) else size for axis, size in sizes.items()}
    for name, header in headers.items():
        if not _fits(header.shape, fields[name], known):
            wanted = ", ".join(_described(axis, known) for axis in fields[name].shape)
            raise _FaultError(f": {name} has shape {list(header.shape)}, wanted [{wanted}]")


def _only(size: int) -> range:
    return range(size, size + 1)


def _fits(shape: Sequence[int], field: ArrayField, known: dict[str, range]) -> bool:
    """Whether a shape is that of a field; sizes of axes that were not known are noted."""
    axes = [axis for axis in field.shape if not isinstance(axis, EllipsisType)]
    if len(shape) < len(axes) or (len(shape) > len(axes) and ... not in field.shape):
        return False
    for axis, size in zip(axes, shape, strict=False):
        if size not in (_only(axis) if isinstance(axis, int) else known.get(axis, _only(size))):
            return False
        if isinstance(axis, str):
            known[axis] = _only(size)
    return True


def _described(axis: int | str | EllipsisType, known: Mapping[str, range]) -> str:
    """An axis of a field in a message, with its size where it is known."""
    if not isinstance(axis, str):
        return "..." if isinstance(axis, EllipsisType) else str(axis)
    sizes = known.get(axis)
    if sizes is None:
        return axis
    return f"{axis} {sizes[0]}" if len(sizes) == 1 else f"{axis} {sizes[0]} to {sizes[-1]}"


def _check_claims(
    headers: Mapping[str, ArrayHeader], members: Mapping[str, zipfile.ZipInfo]
) -> None:
    """Raise if an array cannot have the size that its header claims, before memory is taken for it."""
    for name, header in headers.items():
        info = members[name]
        held = info.file_size - header.offset
        stored = info.compress_type == zipfile.ZIP_STORED
        most = info.compress_size * (1 if stored else DEFLATE) + (0 if stored else DEFLATE)
        if header.size * header.dtype.itemsize != held or not info.file_size <= most:
            raise _FaultError(
                f": {name} claims shape {list(header.shape)} of {header.dtype}, the file has "
                f"{min(held, most)} bytes of it"
            )


def _check_unpacked_size(
    headers: Mapping[str, ArrayHeader],
    fields: Mapping[str, ArrayField],
    sizes: Sizes,
    file_size: int,
) -> None:
    """Raise if a small file would fill the memory with arrays that nobody expects to be so large."""
    total = sum(
        header.size * fields[name].target(header.dtype).itemsize
        for name, header in headers.items()
        if not _is_expected(fields[name], sizes)
    )
    if total > max(FREE, MAX_RATIO * file_size):
        raise _FaultError(
            f" claims {total >> 20} MB of arrays in a file of {file_size >> 20} MB, which cannot be sound"
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
    """Read one array; it is checked and converted piece by piece, so that it is never there twice."""
    array = np.empty(header.shape, field.target(header.dtype))
    # Numbers lie in the order of the last axis, or of the first one for Fortran.
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
                with np.errstate(all="ignore"):  # where any value is allowed, it may be too large
                    flat[first : first + len(values)] = values
                first += len(values)
            file.read(1)  # compares the checksum of the member
    except _UNREADABLE:
        raise _damaged(name, "is damaged") from None
    return array


def _check_values(
    values: np.ndarray, name: str, header: ArrayHeader, field: ArrayField, first: int = 0
) -> None:
    """Raise for the first of some numbers, counted from ``first``, that its field does not allow."""
    if field.any_value or values.dtype.kind == "b" or not len(values):
        return
    low, high = field.limits(field.target(header.dtype))
    with np.errstate(all="ignore"):
        if values.min() >= low and values.max() <= high:  # neither is true of NaN
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
