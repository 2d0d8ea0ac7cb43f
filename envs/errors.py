"""Errors that a person reads: one line that says what is wrong, what was found and what mends it."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable
from typing import Any

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 80
_SHORT.maxlevel = 2


class UsageError(ValueError):
    """The request cannot be met as written (command lines exit with 2)."""


class DataError(Exception):
    """Data is missing, damaged, does not fit or cannot be made (command lines exit with 1)."""


class NotAvailableError(UsageError):
    """A world does not offer something that is optional, such as goals drawn at random."""


class MissingExtraError(ImportError):
    """Packages that a world needs are missing, too old, incomplete or do not fit together."""


def nearest(name: str, known: Iterable[str], what: str) -> UsageError:
    """The error for an unknown name, with the nearest known one."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return UsageError(f"unknown {what} {shown(name)}{hint} (known: {', '.join(known)})")


def shown(value: Any) -> str:
    """A value as a message shows it: its ``repr``, short and on one line whatever the value holds."""
    try:
        return printable(_SHORT.repr(value))
    except ValueError:  # Python prints no integer of more than 4,300 digits
        return "a number that is too long to show"


def printable(text: str) -> str:
    """The text with line breaks and other control characters as escapes.

    What comes from a file goes through here before it reaches a terminal, a table or a picture.
    """
    return "".join(
        char if char.isprintable() else char.encode("unicode_escape").decode() for char in text
    )
