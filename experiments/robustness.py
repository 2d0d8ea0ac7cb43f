"""Table 3: the returns of optimized prompts under noise, row by row.

A row is the optimized prompts of one adaptation under one noise, evaluated as ``experiments.evaluate``
does, and is kept in its own file. The adaptations are the cells of the other comparisons. Published rows
under ``results/`` are used if they belong to the same adaptation.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from annotated_types import Ge
from pydantic import BaseModel, Field

from envs.errors import DataError, UsageError
from experiments.comparison_tables import Compared, Notes, files_of, gap
from experiments.comparisons import (
    PUBLISHED,
    Cell,
    made,
    methods_of,
    num_seeds,
    table_of,
    worlds_of,
)
from experiments.evaluation import OFFICIAL, Noise, evaluate_cases, open_case
from experiments.signals import farewell, kept
from experiments.store.layout import SUMMARY
from experiments.store.paper import paper_value
from experiments.store.provenance import provenance
from experiments.store.reproduce_settings import ReproduceConfig
from experiments.store.seals import check_replaceable, write_sealed
from experiments.store.settings import file_name
from experiments.store.statistics import SeedSpread
from experiments.store.summary import Summary, read_summary
from experiments.store.tables import table
from mgpo_jax import methods
from mgpo_jax.files import write_json
from mgpo_jax.schema import STRICT, read_document

SIZES = (
    *(Noise(obs=size) for size in (OFFICIAL, 0.01, 0.03, 0.1)),
    *(Noise(action=size) for size in (0.02, 0.05, 0.1)),
)
"""The noises of the table; the paper does not say how much noise it added."""
SMOKE_SIZES = (Noise(obs=0.01), Noise(action=0.05))
EPISODES = 4  # episodes under each prompt
CLOSE = 1e-6  # final returns that differ by less belong to the same adaptation
HEAD = (
    "world", "method", "noise", "paper (change)", "ours (mean ± std over seeds)", "change", "gap",
    "tasks x seeds x episodes", "CPU-minutes",
)  # fmt: skip


class Behind(BaseModel):
    """A measurement under one noise: a row of ``experiments.evaluate --json``, perhaps with its cost."""

    model_config = {**STRICT, "extra": "ignore"}

    env: str
    method: str = Field(alias="optimizer")
    num_tasks: Annotated[int, Ge(1)]
    num_seeds: Annotated[int, Ge(1)]
    episodes: Annotated[int, Ge(1)]
    """Number of episodes under each prompt."""
    obs_noise: float | Literal["official"]
    action_noise: float
    adapted: float
    """The final return of the adaptation, without noise."""
    return_: float = Field(alias="return")
    std_over_seeds: float | None
    change: float
    cpu_seconds: float | None = None
    """CPU time with compilation; rows of ``experiments.evaluate`` do not have it."""

    def is_of(self, world: str, method: str, noise: Noise, summary: Summary) -> bool:
        """Whether this is the measurement of an adaptation under a noise, judged by their numbers."""
        same = (self.env, self.method, self.obs_noise, self.action_noise) == (world, method, *noise)
        size = (self.num_tasks, self.num_seeds) == (summary["num_tasks"], summary["num_seeds"])
        return same and size and abs(self.adapted - summary["final_return"]) < CLOSE


class _Rows(BaseModel):
    """A file that ``experiments.evaluate --json`` wrote."""

    model_config = {**STRICT, "extra": "ignore"}

    rows: list[Behind]


class Row(NamedTuple):
    """A row of the table."""

    world: str
    method: str
    noise: Noise
    found: Behind | None
    """The measurement; None if it is not available."""
    reason: str = ""
    """Why it is not available."""
    failed: bool = False
    """Whether it is not available because the adaptation failed."""


def sizes_of(config: ReproduceConfig) -> Sequence[Noise]:
    """The noises of the table."""
    return SMOKE_SIZES if config.scale == "smoke" else SIZES


def place_of_row(config: ReproduceConfig, cell: Cell, noise: Noise) -> Path:
    """The file of a row, in a folder beside those of the adaptations."""
    name = f"{file_name(cell.method)}-{config.scale}-{num_seeds(config)}seeds"
    folder = config.out / file_name(cell.world) / "noise" / name
    return folder / f"{str(noise).replace(' ', '-')}.json"


def known(config: ReproduceConfig, cell: Cell, noise: Noise) -> Behind | None:
    """An existing measurement, made before or published; None if there is none.

    Raises:
      DataError: if its file is damaged, or is from another adaptation.
    """
    if cell.results is None:
        return None
    summary = read_summary(cell.results)
    place = place_of_row(config, cell, noise)
    mend = f"remove {place} to measure it again"
    if place.is_file():
        found: Behind = read_document(place, Behind, mend)
        if not found.is_of(cell.world, cell.method, noise, summary):
            raise DataError(
                f"{place} is not of the adaptation in {cell.results / SUMMARY}, whose final return is "
                f"{summary['final_return']:.6f}; {mend}"
            )
        return found
    if config.scale != "cpu":
        return None
    of_world = published_rows(cell.world)
    return next((r for r in of_world if r.is_of(cell.world, cell.method, noise, summary)), None)


def published_rows(world: str) -> tuple[Behind, ...]:
    """The published measurements of a world."""
    return _rows_in((PUBLISHED / file_name(world)).absolute())


@cache
def _rows_in(folder: Path) -> tuple[Behind, ...]:
    """The rows in the files of a folder; a damaged file is left out, with a line on stderr."""
    found: list[Behind] = []
    for path in sorted(folder.glob("noise*.json")):
        try:
            found += read_document(path, _Rows).rows
        except DataError as error:
            print(f"ignoring {path}: {error}", file=sys.stderr)
    return tuple(found)


def rows_of(config: ReproduceConfig, world: str, method: str) -> list[Row]:
    """All rows of a method in a world; missing ones are measured."""
    cell = made(config, world, method)
    sizes = sizes_of(config)
    if cell.results is None:
        return [Row(world, method, noise, None, cell.reason, cell.failed) for noise in sizes]
    rows = {noise: Row(world, method, noise, known(config, cell, noise)) for noise in sizes}
    cases = {}
    for noise, row in rows.items():
        if row.found is None:
            try:
                cases[noise] = open_case(cell.results, None, [noise])
            except UsageError as error:  # a noise that this world does not have
                rows[noise] = row._replace(reason=str(error))
    with farewell(kept):
        spent = time.process_time()
        measured = evaluate_cases(list(cases.values()), num_episodes(config), 0) if cases else ()
        for noise, values in zip(cases, measured, strict=True):
            values["cpu_seconds"] = time.process_time() - spent
            _keep(place_of_row(config, cell, noise), values)
            rows[noise] = rows[noise]._replace(found=known(config, cell, noise))
            spent = time.process_time()
    return list(rows.values())


def num_episodes(config: ReproduceConfig) -> int:
    """The number of episodes under each prompt."""
    return 1 if config.scale == "smoke" else EPISODES


def _keep(place: Path, values: dict[str, Any]) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    write_json(place, {**values, **provenance()})


def as_table(rows: Sequence[Row]) -> str:
    """The table in Markdown, with notes on what is missing and what the numbers mean."""
    notes = Notes()
    notes.add(
        "The paper does not state its noise level, so its number is repeated beside each of ours. The "
        "change is relative to the return without noise."
    )
    lines = [_line(row, notes) for row in rows]
    return f"{table(HEAD, lines)}\n\n" + "".join(f"- {note}\n" for note in notes.lines)


def _line(row: Row, notes: Notes) -> list[str]:
    kind = "actions" if row.noise.action else "observations"
    paper = paper_value("table3", row.world, f"{row.method}, {kind}")
    title = methods.find(row.method).title or row.method
    begin, found = [row.world, title, str(row.noise), paper], row.found
    if found is None:
        notes.add(f"{row.world}: {row.reason}")
        return [*begin, *["-"] * (len(HEAD) - len(begin))]
    return [
        *begin,
        str(SeedSpread(found.return_, found.std_over_seeds)),
        f"{found.change:+.3f}",
        gap(paper, found.return_),
        f"{found.num_tasks} x {found.num_seeds} x {found.episodes}",
        "" if found.cpu_seconds is None else f"{found.cpu_seconds / 60:.1f}",
    ]


def compare(config: ReproduceConfig) -> Compared:
    """Measure all missing rows, and write the table."""
    place = files_of(config)[0]
    check_replaceable([place])
    rows = [
        row
        for world in worlds_of(config)
        for method in methods_of(config)
        for row in rows_of(config, world, method)
    ]
    text = f"{table_of(config).title}\n\n{as_table(rows)}"
    place.parent.mkdir(parents=True, exist_ok=True)
    write_sealed(place, lambda path: path.write_text(text, encoding="utf-8"))
    failed = dict.fromkeys(f"{row.method} in {row.world}" for row in rows if row.failed)
    return Compared(text, list(failed))
