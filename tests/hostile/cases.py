"""What a case of the fuzz suite is, and the damage that its grammars do to a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

Expected = Literal["refused", "accepted", "either"]
"""What has to become of an input; ``either`` is refused clearly or accepted, and nothing worse."""

USAGE, DATA, BOTH = (2,), (1,), (1, 2)


@dataclass(frozen=True)
class Damage:
    """What is done to one file."""

    text: str
    """In words, for the report."""
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
    """What is bad: ``flags``, or the file."""
    change: str
    """What was done to the file, in words; empty for a bad flag."""
    expected: Expected
    codes: tuple[int, ...] = USAGE
    """Exit codes that a refusal may have."""
    needs: Sequence[str] = ()
    """Which sound folders and files lie in the current folder before the change."""
    prepare: Callable[[Path], None] | None = None
    """Makes the change, in the current folder."""
    names: Sequence[str] = ()
    """A refusal has to hold one of them: the flag or the file."""
    found: Sequence[str] = ()
    """A refusal has to hold one of them, unless there are none: the value that was found."""
    check: Callable[[Path], str] | None = None
    """Called with the current folder after the case was accepted: what is wrong there, or nothing."""
    outputs: Sequence[str] = ()
    """Where a command that is not refused may write."""


def pick(rng: np.random.Generator, choices: Sequence[Any]) -> Any:
    """One of the choices, as it is."""
    return choices[int(rng.integers(len(choices)))]


def written(data: bytes) -> Callable[[Path], None]:
    """Damage that replaces a file, which may be a link to a sound one, by other bytes."""

    def do(path: Path) -> None:
        path.unlink(missing_ok=True)
        path.write_bytes(data)

    return do
