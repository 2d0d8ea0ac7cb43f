"""Draw figures from adaptation results: ``python -m experiments.plot RUN_DIR [RUN_DIR ...]``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import tyro

from envs.errors import UsageError
from experiments.runtime import Common, run


@dataclass(frozen=True)
class PlotConfig(Common):
    """Settings of ``experiments.plot``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of adaptations; those of one world share its figures."""
    out: Path = Path("figures")
    """Folder to write."""
    tasks: tuple[int, ...] = ()
    """Tasks to draw, counted from 0 (default: the four that the first run improved most)."""
    seed: int = 0
    """Which seed of the adaptations to draw, counted from 0."""


def main(config: PlotConfig) -> None:
    """Draw every figure that the results of some adaptations allow."""
    if not config.runs:
        raise UsageError("no result folder given; usage: python -m experiments.plot RUN_DIR ...")
    from experiments.drawing import by_world, check_together, draw_together, labeled
    from experiments.store.results import load_results

    groups = list(by_world(config.runs, load_results))
    for folders in groups:
        check_together(folders, config.tasks, config.seed)
    config.out.mkdir(parents=True, exist_ok=True)
    for folders in groups:
        draw_together(labeled(folders), config.out, config.tasks, config.seed)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(PlotConfig, main, argv=argv)


if __name__ == "__main__":
    command()
