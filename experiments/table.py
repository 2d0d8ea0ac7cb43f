"""Compare adaptations in one table: ``python -m experiments.table runs/adapt/maze15/*``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import tyro

from experiments.runtime import Common, require_runs, run, say


@dataclass(frozen=True)
class TableConfig(Common):
    """Settings of ``experiments.table``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of adaptations."""
    json: bool = False
    """Print JSON instead: a list of summaries, each with its folder, tasks and settings."""


def main(config: TableConfig) -> None:
    """Print a Markdown table of adaptations, with the paper's numbers where the comparison is fair."""
    require_runs(config.runs, "table")
    from experiments.store.rows import as_json, comparison, read_row

    rows = [read_row(folder) for folder in config.runs]
    say(json.dumps([as_json(row) for row in rows], indent=2) if config.json else comparison(rows))


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(TableConfig, main, argv=argv)


if __name__ == "__main__":
    command()
