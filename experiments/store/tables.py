"""Tables of commands: one function lays them out, for the terminal and for Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from experiments.store.paper import paper_value


def table(head: Sequence[str], rows: Sequence[Sequence[str]], markdown: bool = True) -> str:
    """Rows of cells under a head: as Markdown, or in columns of equal width."""
    if markdown:
        lines = [head, ["---"] * len(head), *rows]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)
    lines = [head, *rows] if any(head) else list(rows)
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(aligned(line, widths) for line in lines)


def aligned(cells: Sequence[str], widths: Sequence[int]) -> str:
    """One line of a table, its cells as wide as their columns."""
    return " ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip()


def block(title: str, rows: Sequence[tuple[str, str]]) -> str:
    """Names and values under a title."""
    return "\n".join([title, "-" * len(title), table(("", ""), rows, markdown=False)])


def number(value: float | None, digits: int = 3) -> str:
    """A number, or nothing where it is unknown."""
    return "" if value is None else f"{value:.{digits}f}"


def comparison(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Adaptations beside the paper's Table 2, one row for each, in the order given."""
    head = [
        "env", "method", "initial", "final (mean ± std over seeds)", "IQM [95 %]", "optimum",
        "regret", "after 40", "solved optimally", "paper: final",
    ]  # fmt: skip
    rows = []
    for summary in summaries:
        low, high = summary["final_return_iqm_95"]
        solved = summary["solved_optimally"]
        method = summary.get("method", summary["optimizer"])
        rows.append(
            [
                summary["env"],
                method,
                f"{summary['initial_return']:.2f}",
                f"{summary['final_return']:.3f} ± {summary['final_return_std_over_seeds']:.3f}",
                f"{summary['final_return_iqm']:.3f} [{low:.3f}, {high:.3f}]",
                number(summary["optimal_return"]),
                number(summary["regret"]),
                number(summary["regret_after_40"]),
                "" if solved is None else f"{100 * solved:.0f} %",
                paper_value("table2", summary["env"], method),
            ]
        )
    return table(head, rows)
