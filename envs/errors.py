"""Errors for users: one line that says what is wrong, what was found, and how to mend it."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable
from typing import Any

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 80
_SHORT.maxlevel = 2


class UsageError(ValueError):
    """The request is invalid as written (commands exit with status 2)."""


class DataError(Exception):
    """Data are missing, damaged, do not fit, or cannot be made (commands exit with status 1)."""


class NotAvailableError(UsageError):
    """A world does not offer an optional feature, such as random goals."""


class MissingExtraError(ImportError):
    """Packages that a world needs are missing, too old, incomplete, or incompatible with each other."""


def nearest(name: str, known: Iterable[str], what: str) -> UsageError:
    """The error for an unknown name, with the nearest known one."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return UsageError(f"unknown {what} {shown(name)}{hint} (known: {', '.join(known)})")


def shown(value: Any) -> str:
    """A value for a message: its ``repr``, shortened and on one line whatever the value holds."""
    try:
        return printable(_SHORT.repr(value))
    except ValueError:  # Python does not print integers of more than 4,300 digits
        return "a number that is too long to show"


def printable(text: str) -> str:
    """The text with line breaks and other control characters escaped.

    Any text from a file passes through here before it is shown in a terminal, a table or a picture.
    """
    return "".join(
        char if char.isprintable() else char.encode("unicode_escape").decode() for char in text
    )
