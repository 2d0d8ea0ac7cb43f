"""The paper's numbers, from ``paper.toml``, by table, world and row."""

from __future__ import annotations

import tomllib
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from envs.errors import UsageError
from envs.registry import WORLDS

PAPER = Path(__file__).parent / "paper.toml"


@cache
def _numbers() -> dict[str, Any]:
    return tomllib.loads(PAPER.read_text())


def paper_rows(table: str, world: str) -> dict[str, Any]:
    """The rows of a table for a world; empty if the paper has none."""
    return _numbers().get(table, {}).get(world, {})


def paper_worlds(table: str) -> tuple[str, ...]:
    """The worlds in a table or figure of the paper, in its order, and ours that stand beside them."""
    numbers = _numbers()
    of_paper = numbers.get(table, numbers["figures"].get(table, ()))
    return (*of_paper, *numbers["beside"].get(table, ()))


METHODS_IN = ("table2", "table1", "table8")
"""The tables with a row for each method; their numbers agree if a method is in several of them."""


def paper_final(world: str, method: str) -> str:
    """The final return of a method in a world as the paper prints it; empty if it has none."""
    found = (paper_value(table, world, method) for table in METHODS_IN)
    return next(filter(None, found), "")


def paper_value(table: str, world: str, row: str) -> str:
    """One number as the paper prints it; empty if it has none.

    A world that uses the released policy of another world has that world's numbers. The name may come from
    a file, so a module:attribute is not imported.
    """
    if world in WORLDS.names():
        with suppress(UsageError):  # a world that cannot be imported keeps its name
            world = WORLDS.find(world).home
    return paper_rows(table, world).get(row, "")
