"""Compare adaptations in one table: ``python -m experiments.table runs/adapt/maze15/*``."""

from __future__ import annotations

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


def main(config: TableConfig) -> None:
    """Print a Markdown table of adaptations, where it is fair beside the paper's Table 2."""
    require_runs(config.runs, "table")
    from experiments.store.rows import comparison, read_row

    say(comparison([read_row(folder) for folder in config.runs]))


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(TableConfig, main, argv=argv)


if __name__ == "__main__":
    command()
