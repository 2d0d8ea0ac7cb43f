"""Collect a dataset: ``python -m experiments.collect --env maze15 --demonstrator astar4``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

from experiments.joining import join
from experiments.runtime import run
from experiments.store.settings import CollectConfig


def main(config: CollectConfig) -> None:
    """Collect demonstrations on random tasks, excluding the test tasks."""
    join(config)
    from experiments.datasets import collect_and_save

    collect_and_save(config)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(CollectConfig, main, argv=argv)


if __name__ == "__main__":
    command()
