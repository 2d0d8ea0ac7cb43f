"""Tables of the paper's comparisons, and their learning curves (Tables 1, 2 and 8; Figures 6 and 7).

A row is a cell (``experiments.comparisons``). Cells that are missing are made before the table is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from experiments.comparisons import SMOKE_EPISODES, Cell, cells, table_of
from experiments.drawing import write
from experiments.figures import later, learning_curves
from experiments.store.paper import paper_final
from experiments.store.reproduce_settings import ReproduceConfig
from experiments.store.result_files import load_results
from experiments.store.rows import PAPER_EPISODES
from experiments.store.seals import check_replaceable, write_sealed
from experiments.store.statistics import SeedSpread
from experiments.store.summary import read_summary
from experiments.store.tables import number, table
from mgpo_jax import methods

HEAD = (
    "world", "method", "paper", "ours (mean ± std over seeds)", "gap", "best single episode",
    "tasks x seeds x episodes", "CPU-minutes",
)  # fmt: skip


class Compared(NamedTuple):
    """A table of a comparison."""

    text: str
    failed: Sequence[str]
    """The cells whose adaptations failed, each as "METHOD in WORLD"."""


@dataclass(frozen=True)
class Notes:
    """The notes below a table, without duplicates."""

    lines: list[str] = field(default_factory=list)

    def add(self, line: str) -> None:
        if line not in self.lines:
            self.lines.append(line)


def as_table(found: Sequence[Cell], scale: str = "cpu") -> str:
    """The table in Markdown, with notes on what is missing or scaled down."""
    notes = Notes()
    rows = [_row(cell, scale, notes) for cell in found]
    below = "".join(f"- {line}\n" for line in notes.lines)
    return f"{table(HEAD, rows)}\n" + (f"\n{below}" if below else "")


def _row(cell: Cell, scale: str, notes: Notes) -> list[str]:
    paper = paper_final(cell.world, cell.method)
    title = methods.find(cell.method).title or cell.method
    if cell.results is None:
        notes.add(f"{cell.world}: {cell.reason}")
        return [cell.world, title, paper, *["-"] * (len(HEAD) - 3)]
    summary = read_summary(cell.results)
    ours = SeedSpread(summary["final_return"], summary["final_return_std_over_seeds"])
    size = (summary["num_tasks"], summary["num_seeds"], summary["num_episodes"])
    if scale == "smoke":
        notes.add(
            f"Scaled down: {size[0]} tasks, {size[1]} seed, {SMOKE_EPISODES} episodes, where the paper has "
            f"3 seeds and {PAPER_EPISODES} episodes. These numbers only show that everything runs."
        )
    elif size[1] < 3:
        notes.add(f"{cell.world}, {title}: {size[1]} seed(s), where the paper has 3.")
    if fresh := summary.get("fresh"):
        notes.add(
            f"{cell.world}, fresh: the mean of {fresh['episodes']} sampled episodes outside of the search. "
            "The best single episode is of the search, and is luck for the most part."
        )
    if not methods.find(cell.method).learns:
        notes.add(f"{title} learns nothing, so the number of its episodes does not matter.")
    return [
        cell.world,
        title,
        paper,
        f"{ours} (fresh)" if fresh else str(ours),
        gap(paper, summary["final_return"]),
        number(summary.get("best_episode_return")),
        " x ".join(map(str, size)),
        f"{summary['cpu_seconds'] / 60:.1f}",
    ]


def gap(paper: str, ours: float) -> str:
    """Our value minus the paper's, which is the first word of ``paper``; empty if the paper has none."""
    return f"{ours - float(paper.split()[0]):+.3f}" if paper else ""


def files_of(config: ReproduceConfig) -> tuple[Path, Path]:
    """The files of a comparison's table and learning curves."""
    place = config.out / f"{config.what}-{config.scale}"
    return place.with_suffix(".md"), place.with_suffix(".png")


def compare(config: ReproduceConfig) -> Compared:
    """Make all missing cells, and write the table and the learning curves."""
    place, picture = files_of(config)
    check_replaceable((place, picture))
    found = list(cells(config))
    text = f"{table_of(config).title}\n\n{as_table(found, config.scale)}"
    place.parent.mkdir(parents=True, exist_ok=True)
    write_sealed(place, lambda path: path.write_text(text, encoding="utf-8"))
    curves = _curves(found, table_of(config).methods)
    if curves:
        write(picture, later(learning_curves, curves))
    return Compared(text, [f"{cell.method} in {cell.world}" for cell in found if cell.failed])


def _curves(found: Sequence[Cell], of_paper: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The results in a figure of learning curves, by world and method.

    Those are of methods that learn, and of the paper's methods that do not, but not of our references.
    """
    curves: dict[str, dict[str, Any]] = {}
    for cell in found:
        shown = methods.find(cell.method).learns or cell.method in of_paper
        if cell.results is not None and shown:
            curves.setdefault(cell.world, {})[cell.method] = load_results(cell.results)
    return curves
