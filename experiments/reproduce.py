"""Make an ablation of the paper with one command: ``python -m experiments.reproduce table5``.

Trains what is missing (a stopped run goes on where it was), adapts with UCB, prints the table and draws
the learning curves. All trainings of a table have the same budget, shorter than that of the released
policies and named above the table.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import NoReturn

import envs
from envs.errors import nearest
from experiments.runtime import run
from experiments.store.settings import ReproduceConfig

ABLATIONS = ("table4", "table5", "figure8", "heads")


def main(config: ReproduceConfig) -> None:
    """Reproduce an ablation of the paper: train, adapt, print the table, draw the curves."""
    if config.what not in ABLATIONS:
        raise nearest(config.what, ABLATIONS, "ablation")
    envs.find(config.env)
    from experiments.ablations import MAKE, as_table, draw

    lines = MAKE[config.what](config)
    budget = ""
    if config.what != "table4":  # which trains nothing
        steps, trajectories = config.num_steps, config.num_trajectories
        budget = f", {steps:,} gradient steps on {trajectories:,} trajectories each"
    text = f"{config.env}, UCB, {config.seeds} seeds{budget}\n\n{as_table(lines)}\n"
    print(text)
    place = config.folder / f"{config.what}.md"
    place.write_text(text)
    draw(lines, config.env, place.with_suffix(".png"))
    print(f"table and curves in {place} and .png", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(ReproduceConfig, main, argv=argv)


if __name__ == "__main__":
    command()
