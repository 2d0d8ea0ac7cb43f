"""Measure the speed of the hot paths in CPU time: ``python -m experiments.bench``.

CPU time is used instead of wall time, so that other load and the number of cores matter little. The
machine's rate of matrix multiplication is measured between the rows, for comparison. With ``--distributed``
the processes share the work, and their CPU times are added; ``--layouts`` starts such processes on this
machine and compares ways to divide it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import tyro

import envs
from experiments.joining import Joined, check_flags, join
from experiments.layouts import check_layouts, measured
from experiments.runtime import refuse_existing_file, run, say
from experiments.signals import farewell
from experiments.store.settings import DEFAULT_WORLD
from mgpo_jax import processes
from mgpo_jax.settings import Name, NumTrajectories

COLUMNS = (18, 10, 18, 0)  # widths of name, value, unit and note
STOPPED = "stopped; the measurements so far are valid; run the command again for the others"


@dataclass(frozen=True)
class BenchConfig(Joined):
    """Settings of ``experiments.bench``."""

    env: Name = DEFAULT_WORLD
    """The world, by name or as module:attribute."""
    demonstrator: Annotated[Name | None, tyro.conf.arg(aliases=("--policy",))] = None
    """The demonstrator to collect and train on (default: that of the world's preset)."""
    quick: bool = False
    """Do a tenth to a half of the work, depending on the row, for rough numbers."""
    trajectories: Annotated[NumTrajectories | None, tyro.conf.arg(aliases=("--episodes",))] = None
    """Number of trajectories to collect (default: 5,000, or 500 with ``--quick``)."""
    rows: Literal["all", "shared", "step"] = "all"
    """Rows to measure: all; shared, those whose work processes share; step, those up to the gradient
    step."""
    layouts: tuple[str, ...] = ()
    """Ways to divide this machine, as PROCESSESxDEVICES (devices per process), such as ``1x2 2x1 1x8``;
    measures the shared rows, or with ``--rows step`` those up to the gradient step."""
    json: Path | None = None
    """JSON file to write the rows to."""


def main(config: BenchConfig) -> None:
    """Measure the speed of collection, training and adaptation in CPU time."""
    check_flags(config)
    envs.find(config.env)
    if config.layouts:
        check_layouts(config.layouts, config.distributed)
    if config.json is not None:
        refuse_existing_file(config.json, "--json")
    if config.layouts:
        show_layouts(config)
        return
    join(config)
    from experiments.demonstrators import find_demonstrator
    from experiments.measurements import measurements
    from experiments.store.tables import aligned

    if config.demonstrator is not None:
        find_demonstrator(envs.find(config.env), envs.make(config.env), config.demonstrator)
    rows: list[Any] = []
    num = config.trajectories or (500 if config.quick else 5_000)
    with writing(config, "rows", rows):
        for row in measurements(config.env, config.demonstrator, num, config.quick, config.rows):
            rows.append(row)
            cells = (row.name, f"{row.value:>10.3f}", row.unit, row.note)
            say(aligned(cells, COLUMNS))


def show_layouts(config: BenchConfig) -> None:
    """Measure and print the rows of the bench for each layout."""
    from experiments.store.tables import aligned

    rows_wanted = "step" if config.rows == "step" else "shared"
    words = ["--env", config.env, "--rows", rows_wanted, *(["--quick"] if config.quick else [])]
    if config.demonstrator is not None:
        words += ["--demonstrator", config.demonstrator]
    if config.trajectories is not None:
        words += ["--trajectories", str(config.trajectories)]
    found: list[Any] = []
    with writing(config, "layouts", found):
        for layout in config.layouts:
            rows = measured(layout, words)
            found.append({"layout": layout, "rows": rows})
            for row in rows:
                cells = (layout, row["name"], f"{row['value']:>10.3f}", row["unit"], row["note"])
                say(aligned(cells, (6, *COLUMNS)))


@contextmanager
def writing(config: BenchConfig, name: str, found: list[Any]) -> Iterator[None]:
    """Write what was found to the JSON file, under a name, after the block or when a signal ends it."""
    from experiments.store.provenance import provenance
    from mgpo_jax.files import write_json

    def write() -> None:
        if config.json and processes.is_first():
            write_json(config.json, {"env": config.env, name: found, **provenance()})
            print(f"results written to {config.json}", file=sys.stderr)

    def stopped() -> str:
        if found:
            write()
        return STOPPED

    with farewell(stopped):
        yield
    write()


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(BenchConfig, main, argv=argv)


if __name__ == "__main__":
    command()
