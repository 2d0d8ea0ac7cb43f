"""Make an ablation of the paper with one command: ``python -m experiments.reproduce table5``.

Trains what is missing (a stopped run goes on where it was), adapts with UCB, prints the table and draws
the learning curves. All trainings of a table have the same budget, shorter than that of the released
policies and named above the table.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import NoReturn

import envs
from envs.errors import UsageError, nearest
from experiments.runtime import run, say
from experiments.store.settings import ReproduceConfig, check_reproduction
from mgpo_jax.claims import check_place

ABLATIONS = ("table4", "table5", "figure8", "heads")


def main(config: ReproduceConfig) -> None:
    """Reproduce an ablation of the paper: train, adapt, print the table, draw the curves."""
    if not config.what:
        raise UsageError(f"no ablation given; name one of {', '.join(ABLATIONS)}")
    if config.what not in ABLATIONS:
        raise nearest(config.what, ABLATIONS, "ablation")
    envs.find(config.env)
    check_reproduction(config)
    if not os.path.isdir(config.folder):
        check_place(config.folder)
    from experiments.ablations import MAKE, as_table, files_of, save
    from experiments.store.seals import check_replaceable

    check_replaceable(files_of(config))
    lines = MAKE[config.what](config)
    budget = ""
    if config.what != "table4":  # which trains nothing
        steps, trajectories = config.num_steps, config.num_trajectories
        budget = f", {steps:,} gradient steps on {trajectories:,} trajectories each"
    text = f"{config.env}, UCB, {config.seeds} seeds{budget}\n\n{as_table(lines)}\n"
    say(text)
    save(config, text, lines)
    print(f"table and curves in {files_of(config)[0]} and .png", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(ReproduceConfig, main, argv=argv)


if __name__ == "__main__":
    command()
