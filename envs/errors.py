"""Errors that a person reads: one line that says what is wrong, what was found and what mends it."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class UsageError(ValueError):
    """The request cannot be met as written (command lines exit with 2)."""


class DataError(Exception):
    """Data is missing, damaged, does not fit or cannot be made (command lines exit with 1)."""


class NotAvailableError(UsageError):
    """A world does not offer something that is optional, such as goals drawn at random."""


def nearest(name: str, known: Iterable[str], what: str) -> UsageError:
    """The error for an unknown name, with the nearest known one."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return UsageError(f"unknown {what} {name!r}{hint} (known: {', '.join(known)})")
