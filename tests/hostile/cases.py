"""The records of the fuzz suite: a case, and the damage that its grammars do to a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

Expected = Literal["refused", "accepted", "either"]
"""How a command must treat an input; ``either`` means that it may refuse it clearly or accept it."""

USAGE, DATA, BOTH = (2,), (1,), (1, 2)


@dataclass(frozen=True)
class Damage:
    """A change to one file."""

    text: str
    """The change in words, for the report."""
    expected: Expected
    do: Callable[[Path], None]
    """Called with the path of the file."""
    codes: tuple[int, ...] = DATA
    """Exit codes that a refusal may have."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One command line, on inputs that may be damaged."""

    command: str
    words: Sequence[str]
    """The command line, without the name of the command."""
    kind: str
    """The kind of the bad input: ``flags``, or the file."""
    change: str
    """The change to the file, in words; empty for a bad flag."""
    expected: Expected
    codes: tuple[int, ...] = USAGE
    """Exit codes that a refusal may have."""
    needs: Sequence[str] = ()
    """Sound folders and files to put into the current folder before the change."""
    prepare: Callable[[Path], None] | None = None
    """Makes the change, given the current folder."""
    names: Sequence[str] = ()
    """Names of the flag or the file, one of which a refusal must contain."""
    found: Sequence[str] = ()
    """Spellings of the bad value, one of which a refusal must contain, if there are any."""
    check: Callable[[Path], str] | None = None
    """Called with the current folder if the command accepted; returns what is wrong, or an empty text."""
    outputs: Sequence[str] = ()
    """Where a command that accepts its input may write."""


def pick(rng: np.random.Generator, choices: Sequence[Any]) -> Any:
    """Draw one of the choices, without converting it to a numpy type."""
    return choices[int(rng.integers(len(choices)))]


def written(data: bytes) -> Callable[[Path], None]:
    """Damage that replaces a file, which may be a link to a sound one, with other content."""

    def do(path: Path) -> None:
        path.unlink(missing_ok=True)
        path.write_bytes(data)

    return do
