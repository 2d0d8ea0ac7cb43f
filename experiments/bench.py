"""Speed of the hot paths, in CPU time: ``python -m experiments.bench``.

CPU time of the process, not wall time, so that a shared machine and the number of cores matter little;
the machine's own matrix-product rate, measured in the same run between the rows, stands beside them.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NoReturn

import tyro

import envs
from experiments.runtime import Common, refuse_existing_file, run, say
from experiments.signals import farewell
from experiments.store.settings import DEFAULT_WORLD
from mgpo_jax.settings import Name, NumTrajectories

COLUMNS = (18, 10, 18, 0)  # widths of name, value, unit and note, which are printed one by one


@dataclass(frozen=True)
class BenchConfig(Common):
    """Settings of ``experiments.bench``."""

    env: Name = DEFAULT_WORLD
    """The world, by name or as module:attribute."""
    demonstrator: Annotated[Name | None, tyro.conf.arg(aliases=("--policy",))] = None
    """Whose demonstrations to collect and train on (default: those of the recipe)."""
    quick: bool = False
    """A tenth of the work: shows that it runs, gives rough numbers."""
    trajectories: Annotated[NumTrajectories | None, tyro.conf.arg(aliases=("--episodes",))] = None
    """Trajectories to collect (default: 5,000; quick: 500)."""
    json: Path | None = None
    """Also write the rows to this file."""


def main(config: BenchConfig) -> None:
    """Measure the speed of collection, training and adaptation in CPU time."""
    envs.find(config.env)
    if config.json is not None:
        refuse_existing_file(config.json, "--json")
    from experiments.datasets import find_demonstrator
    from experiments.measurements import measurements
    from experiments.store.provenance import provenance
    from experiments.store.tables import aligned
    from mgpo_jax.files import write_json

    if config.demonstrator is not None:
        find_demonstrator(envs.find(config.env), envs.make(config.env), config.demonstrator)
    rows = []
    num = config.trajectories or (500 if config.quick else 5_000)
    with farewell(lambda: "stopped; the figures so far stand, run it again for the others"):
        for row in measurements(config.env, config.demonstrator, num, config.quick):
            rows.append(row)
            cells = (row.name, f"{row.value:>10.3f}", row.unit, row.note)
            say(aligned(cells, COLUMNS))
    if config.json:
        write_json(config.json, {"env": config.env, "rows": rows, **provenance()})
        print(f"rows in {config.json}", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(BenchConfig, main, argv=argv)


if __name__ == "__main__":
    command()
