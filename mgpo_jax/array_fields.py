"""How arrays of files are declared, and whether a header, a shape and values are as declared.

``ArrayField`` declares an array: its axes, its kind of numbers and their range. ``archives`` reads such
arrays from npz files, and ``mapped`` maps them from npy files or takes them as they lie in memory.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import EllipsisType
from typing import Any, Literal, NamedTuple

import numpy as np

from envs.errors import printable

MAX_HEADER = 4096  # bytes; numpy writes 118
CHUNK = 1 << 20  # bytes that are read, checked and converted at a time
LARGEST = 1e18  # largest magnitude of a number, unless its field says otherwise
_KINDS = {"integers": "iu", "numbers": "iuf", "anything": "biuf"}
_WORDS_OF_KINDS = {
    "b": "booleans",
    "iu": "integers",
    "iuf": "numbers",
    "biuf": "numbers or booleans",
}


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


class FaultError(Exception):
    """A fault of a file of arrays; the text follows the file's name in a message."""


def damaged(name: str, what: str) -> FaultError:
    """The fault of an array that cannot be read at all."""
    return FaultError(f" is not a readable npz file: {printable(name[:200])} {what}")


def read_header(name: str, file: Any) -> ArrayHeader:
    """Read the header from the first bytes of an array in npy format."""
    start = file.read(8)
    if start[:6] != b"\x93NUMPY":
        raise damaged(name, "is not an array")
    width = {1: 2, 2: 4, 3: 4}.get(start[6], 0) if len(start) == 8 else 0
    length = int.from_bytes(file.read(width), "little")
    if not width or length > MAX_HEADER:
        raise damaged(name, "has a damaged header")
    return _parsed_header(name, file.read(length), 8 + width + length)


def _parsed_header(name: str, text: bytes, offset: int) -> ArrayHeader:
    try:
        if sum(text.count(bracket) for bracket in b"([{") > 8:  # deep nesting exhausts the parser
            raise ValueError
        said = ast.literal_eval(text.decode("latin1").strip())
        descr, fortran, shape = (said[key] for key in ("descr", "fortran_order", "shape"))
        if not isinstance(descr, str):
            raise damaged(name, "has a structured dtype")
        if not re.fullmatch(r"[<>|=]?[biufcSUVOmM?]\d{0,9}(\[\w{1,9}\])?", descr):
            raise ValueError
        dtype = np.dtype(descr)
        sound = isinstance(shape, tuple) and all(
            type(size) is int and 0 <= size < 2**63 for size in shape
        )
        if not sound or type(fortran) is not bool or len(shape) > 32:
            raise ValueError
    except (KeyError, MemoryError, RecursionError, SyntaxError, TypeError, ValueError):
        raise damaged(name, "has a damaged header") from None
    return ArrayHeader(shape, dtype, fortran, offset)


def check_kinds(headers: Mapping[str, ArrayHeader], fields: Mapping[str, ArrayField]) -> None:
    """Raise if arrays are missing, or for the first array with another kind of numbers than its field."""
    missing = [name for name, field in fields.items() if field.required and name not in headers]
    if missing:
        raise FaultError(f" lacks {', '.join(missing)}")
    for name, header in headers.items():
        if header.dtype.kind not in fields[name].kinds:
            words = _WORDS_OF_KINDS[fields[name].kinds]
            raise FaultError(f": {name} must hold {words}, found {header.dtype}")


def check_shapes(
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
            raise FaultError(f": {name} has shape {list(header.shape)}, wanted [{wanted}]")


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


def check_values(
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
    raise FaultError(f": {name} holds {found}{at}, must be from {low:.12g} to {high:.12g}")
