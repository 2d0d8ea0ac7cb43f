"""Validation of settings and JSON files, with faults reported as plain sentences.

A dataclass declares what is allowed: the types of its fields, to which ``Annotated`` adds ranges, as in
``settings.TrainConfig``. pydantic validates strictly: ``true`` is not a number, ``"1"`` is not an integer,
and NaN and infinity are never allowed.

``mgpo_jax.array_fields`` does the same for arrays.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any

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

MAX_DOCUMENT = 16 << 20  # largest size of a JSON file in bytes; ours have a few kB
STRICT = ConfigDict(strict=True, allow_inf_nan=False, extra="forbid")

SHA256 = r"^[0-9a-f]{64}$"

LIMITS: Mapping[str, str] = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
"""The wording of each kind of limit."""

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
"""Our wording of pydantic's error types."""


def _limit(name: str, limits: Mapping[str, Any]) -> str:
    return f"must be {LIMITS[name]} {limits[name]:.12g}"


def _pattern(pattern: str) -> str:
    if pattern == SHA256:
        return "must be a SHA-256, 64 hexadecimal digits"
    return "is not a name that is allowed here"


def _all_finite(value: Any) -> Any:
    """The JSON value, after a check that it holds neither NaN nor infinity, which the parser accepts."""
    rest = [value]
    while rest:
        item = rest.pop()
        if isinstance(item, float) and not math.isfinite(item):
            raise PydanticCustomError("finite_number", "must hold finite numbers")
        rest += item if isinstance(item, list) else item.values() if isinstance(item, dict) else ()
    return value


Json = Annotated[JsonValue, AfterValidator(_all_finite)]
"""Any JSON value."""
Sha256 = Annotated[str, StringConstraints(pattern=SHA256)]
"""The SHA-256 hash of a file, in hexadecimal."""
Name = Annotated[str, StringConstraints(pattern=r"^\w[\w.-]{0,99}(:\w[\w.]{0,99})?$")]
"""The name of a world or a method, or its place as ``module:attribute``; it is safe in a path."""
DemonstratorName = Annotated[
    str, StringConstraints(max_length=200, pattern=r"^\w[\w.-]*(,\w+=[\w.+-]+)*$")
]
"""The name of a demonstrator with its changed settings; it is safe in a path."""


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
    if isinstance(value, np.generic):  # numpy scalars are accepted like Python numbers
        value = value.item()
    try:
        _adapter(type_).validate_python(value)
    except ValidationError as error:
        return sentence(error, value)
    return None


def sentence(error: ValidationError, value: Any) -> str:
    """The first fault of a value, as the end of a sentence that also says what was found."""
    first = error.errors(include_url=False)[0]
    words = _WORDS.get(first["type"])
    said = words(first.get("ctx", {})) if words else first["msg"][:1].lower() + first["msg"][1:]
    return f"{said}, found {shown(value)}"


def read_document(path: Path, type_: Any, mend: str = "") -> Any:
    """Read and validate a JSON file.

    Args:
      path: the file.
      type_: a pydantic model or a dataclass, with ``STRICT`` as its ``model_config`` or
        ``__pydantic_config__``.
      mend: how to mend a faulty file, the end of the message.

    Returns:
      An instance of ``type_``.

    Raises:
      DataError: if the file is missing, is not JSON, or does not match ``type_``.
    """
    return _validated(read_text(path, mend), type_, path, mend)


def checked_entry(value: Any, type_: Any, path: Path, entry: str, mend: str = "") -> Any:
    """Validate one entry of a JSON file that was read before; returns an instance of ``type_``.

    Raises:
      DataError: if the entry does not match ``type_``; the message names the file and the entry.
    """
    return _validated(json.dumps(value).encode(), type_, path, mend, entry)


def read_json_lines(path: Path, type_: Any, mend: str = "") -> list[Any]:
    """Read and validate a file with one JSON value per line; returns instances of ``type_``.

    Raises:
      DataError: if the file is missing, or a line does not match ``type_``; the message names the file and
        the line.
    """
    lines = read_text(path, mend).splitlines()
    return [_validated(line, type_, f"{path}, line {n}", mend) for n, line in enumerate(lines, 1)]


def _validated(text: bytes, type_: Any, path: Path | str, mend: str, entry: str = "") -> Any:
    try:
        return _document_adapter(type_).validate_json(text)
    except ValidationError as error:
        raise DataError(f"{path}{_document_fault(error, entry)}{tail_of(mend)}") from None


def read_text(path: Path, mend: str = "") -> bytes:
    """The bytes of a small text file.

    Raises:
      DataError: if it is missing, not a file, too large, or cannot be read.
    """
    tail = tail_of(mend)
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


def tail_of(mend: str) -> str:
    """The advice ``mend`` as the end of a message."""
    return f"; {mend}" if mend else ""


def _document_fault(error: ValidationError, entry: str = "") -> str:
    """The first fault of a document, or of one entry of it; the text follows the file's name in a
    message."""
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
