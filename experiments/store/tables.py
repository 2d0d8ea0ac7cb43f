"""The layout of all tables that commands print or write, for the terminal and for Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from envs.errors import printable


def table(head: Sequence[str], rows: Sequence[Sequence[str]], markdown: bool = True) -> str:
    """Lay out rows of cells under a head, as Markdown or in aligned columns.

    Whatever a cell contains, it stays a single cell on one line.
    """
    lines = [[printable(cell) for cell in line] for line in (head, *rows)]
    if markdown:
        lines = [[cell.replace("|", r"\|") for cell in line] for line in lines]
        lines.insert(1, ["---"] * len(head))
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)
    lines = lines if any(head) else lines[1:]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(aligned(line, widths) for line in lines)


def aligned(cells: Sequence[str], widths: Sequence[int]) -> str:
    """One line of a table, with cells padded to the widths of their columns."""
    return " ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip()


def block(title: str, rows: Sequence[tuple[str, str]]) -> str:
    """Names and values in two columns under a title."""
    title = printable(title)
    return "\n".join([title, "-" * len(title), table(("", ""), rows, markdown=False)])


def shortened(text: str, longest: int = 60) -> str:
    """The text, with its middle replaced by dots if it is too long."""
    if len(text) <= longest:
        return text
    half = (longest - 3) // 2
    return f"{text[:half]}...{text[-half:]}"


def number(value: float | None, digits: int = 3) -> str:
    """A formatted number; empty if it is unknown."""
    return "" if value is None else f"{value:.{digits}f}"
