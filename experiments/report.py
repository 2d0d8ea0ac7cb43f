"""Show adaptations in one page: ``python -m experiments.report RUN_DIR [RUN_DIR ...]``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import tyro

import envs
from envs.errors import printable
from experiments.runtime import Common, require_runs, run
from experiments.store.seals import check_page
from mgpo_jax.settings import Name


@dataclass(frozen=True)
class ReportConfig(Common):
    """Settings of ``experiments.report``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of adaptations to the same tasks."""
    out: Path = Path("report.html")
    """HTML file to write; it is self-contained and needs no server or network."""
    pictures: tuple[Path, ...] = ()
    """PNG and GIF files to show at the end, such as the videos that `experiments.plot` makes; videos in the
    result folders are shown, too, as far as the page has room."""
    env: Name | None = None
    """Your own world, as module:attribute, if the results are from one; without it no user code is
    imported."""


def main(config: ReportConfig) -> None:
    """Make one HTML page of adaptations: curves, all tasks, and every episode to step through."""
    require_runs(config.runs, "report")
    check_page(config.out)
    if config.env is not None:
        envs.find(config.env)  # imports the module, so that the results may name it
    from experiments.pages.report import write_report

    write_report(config.runs, config.out, config.pictures)
    print(printable(str(config.out)), file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(ReportConfig, main, argv=argv)


if __name__ == "__main__":
    command()
