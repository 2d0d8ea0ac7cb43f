"""Make a table of the paper with one command: ``python -m experiments.reproduce table1``.

Tables 1, 2 and 8 compare methods in several worlds: cells that are missing are adapted, each by itself,
and what cannot be had is a dash with the reason. An ablation is of one world, or of several one by one: it
trains what is missing (a stopped run goes on where it was), adapts with UCB, prints the table and draws the
learning curves. All trainings of an ablation have the same budget, shorter than that of the released
policies and named above the table.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import NoReturn

import envs
from envs.errors import UsageError, nearest
from experiments.runtime import run, say
from experiments.store.settings import (
    COMPARISONS,
    PICTURES,
    ReproduceConfig,
    check_reproduction,
)
from mgpo_jax.claims import check_place

ABLATIONS = ("table4", "table5", "figure8", "heads")
LIST = "list"


def main(config: ReproduceConfig) -> None:
    """Reproduce a table of the paper: train, adapt, print the table, draw the curves."""
    known = (*COMPARISONS, *PICTURES, *ABLATIONS, LIST)
    if not config.what:
        raise UsageError(f"no table given; name one of {', '.join(known)}")
    if config.what not in known:
        raise nearest(config.what, known, "table")
    for world in config.env:
        envs.find(world)
    check_reproduction(config)
    if config.what in (LIST, *COMPARISONS, *PICTURES):
        return make_comparison(config)
    for world in config.env or (config.world,):
        make_ablation(replace(config, env=(world,)))
    return None


def make_comparison(config: ReproduceConfig) -> None:
    """Make a table or figure of several methods and worlds, or tell what there is of all of them."""
    if not os.path.isdir(config.out):
        check_place(config.out)
    from experiments.comparisons import compare, costs, draw, files_of

    if config.what == LIST:
        say(costs(config))
        return
    if config.what in PICTURES:
        draw(config)  # which says what it has written
        return
    say(compare(config))
    print(f"table and curves in {files_of(config)[0]} and .png", file=sys.stderr)


def make_ablation(config: ReproduceConfig) -> None:
    """Make an ablation in one world."""
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
    text = f"{config.world}, UCB, {config.seeds} seeds{budget}\n\n{as_table(lines)}\n"
    say(text)
    save(config, text, lines)
    print(f"table and curves in {files_of(config)[0]} and .png", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(ReproduceConfig, main, argv=argv)


if __name__ == "__main__":
    command()
