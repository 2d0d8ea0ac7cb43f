"""Draw figures from adaptation results: ``python -m experiments.plot RUN_DIR [RUN_DIR ...]``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import tyro

import envs
from experiments.runtime import Common, require_runs, run
from mgpo_jax.claims import check_place
from mgpo_jax.settings import Index, Name


@dataclass(frozen=True)
class PlotConfig(Common):
    """Settings of ``experiments.plot``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of adaptations; those in the same world are drawn together."""
    out: Path = Path("figures")
    """Output folder."""
    tasks: tuple[Index, ...] = ()
    """Indices of the tasks to draw, counted from 0 (default: the four that the first run improved most)."""
    seed: Index = 0
    """Index of the seed to draw, counted from 0."""
    policy: Path | None = None
    """Folder of the policy that the results were made with, if it has been moved."""
    env: Name | None = None
    """Your own world, as module:attribute, if the results are from one; without it no user code is
    imported."""


def main(config: PlotConfig) -> None:
    """Draw every figure that the results of some adaptations allow."""
    require_runs(config.runs, "plot")
    check_place(config.out)
    if config.env is not None:
        envs.find(config.env)  # imports the module, so that the results may name it
    from experiments.drawing import by_world, check_together, labeled, pictures_together, write
    from experiments.store.result_files import load_results
    from experiments.store.seals import check_replaceable

    groups = list(by_world(config.runs, load_results))
    for folders in groups:
        check_together(folders, config.tasks, config.seed)
    pictures = {
        config.out / name: save
        for folders in groups
        for name, save in pictures_together(
            labeled(folders), config.tasks, config.seed, config.policy
        )
    }
    check_replaceable(pictures, "choose another folder with --out")
    config.out.mkdir(parents=True, exist_ok=True)
    for path, save in pictures.items():
        write(path, save)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(PlotConfig, main, argv=argv)


if __name__ == "__main__":
    command()
