"""Reproduce a table or figure of the paper: ``python -m experiments.reproduce table1``.

Tables 1, 2 and 8 compare methods in several worlds: missing cells are adapted one by one, and a cell that
is not available is a dash, with the reason below the table. Table 3 evaluates the same adaptations under
noise. An ablation is made for one world at a time: it runs or continues the trainings that are missing,
adapts with UCB, prints the table and draws the learning curves. All its trainings have the same budget,
which is smaller than that of the released policies and is stated above the table. Two ablations train
nothing and use the released policy: ``table4`` adapts with UCB, and ``plan`` with our own optimizer, each
time without one of its parts. ``all`` makes everything that is missing; ``list`` shows what that is.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import NoReturn

import envs
from envs.errors import DataError, NotAvailableError, UsageError, nearest, printable
from experiments.joining import join
from experiments.runtime import run, say
from experiments.store.reproduce_settings import (
    ABLATIONS,
    ALL,
    COMPARISONS,
    GLANCE,
    LIST,
    PICTURES,
    ReproduceConfig,
    check_reproduction,
)
from mgpo_jax import processes
from mgpo_jax.claims import check_place


def main(config: ReproduceConfig) -> None:
    """Reproduce a table or figure of the paper: train, adapt, print the table, draw the curves."""
    known = (*COMPARISONS, *PICTURES, *ABLATIONS, GLANCE, LIST, ALL)
    if not config.what:
        raise UsageError(f"no table given; name one of {', '.join(known)}")
    if config.what not in known:
        raise nearest(config.what, known, "table")
    for world in config.env:
        envs.find(world)
    check_reproduction(config)
    make(config)


def make(config: ReproduceConfig) -> None:
    """Make the table or figure of a config that was checked."""
    if config.what in ABLATIONS:
        for world in config.env or (config.world,):
            make_ablation(replace(config, env=(world,)))
        return
    if not os.path.isdir(config.out):
        check_place(config.out)
    if config.what == ALL:
        make_all(config)
    elif config.what == LIST:
        from experiments.inventory import inventory

        say(inventory(config))
    elif config.what == GLANCE:
        from experiments import glance

        glance.draw(config)  # prints the file that it writes
    elif config.what in PICTURES:
        from experiments.paper_figures import draw

        draw(config)
    else:
        make_comparison(config)


def make_comparison(config: ReproduceConfig) -> None:
    """Make a table of several methods in several worlds.

    Raises:
      DataError: at the end, if the adaptation of a cell failed.
    """
    join(config)
    from experiments import comparison_tables, comparisons, robustness

    behind_noise = config.what == "table3"
    comparisons.share_out(config, robustness.rows_of if behind_noise else comparisons.made)
    if not processes.is_first():
        return
    with processes.apart():  # all cells are made now, and process 0 alone makes the table
        made = robustness.compare(config) if behind_noise else comparison_tables.compare(config)
    say(made.text)
    place = comparison_tables.files_of(config)[0]
    text = f"table in {place}" if behind_noise else f"table and curves in {place} and .png"
    print(text, file=sys.stderr)
    if made.failed:
        raise DataError(f"{', '.join(made.failed)} failed; the notes below the table say why")


def make_all(config: ReproduceConfig) -> None:
    """Make everything that is missing, one job after the other.

    A job that fails is reported in one line, and the others go on. A job that is not available in a world,
    such as a table of demonstrators where there is only one, does not count as a failure.

    Raises:
      DataError: at the end, if any job failed.
    """
    from experiments.inventory import jobs

    todo, failed = jobs(config), []
    for number, job in enumerate(todo, start=1):
        name = " ".join([job.what, *job.env])
        print(f"[{number} of {len(todo)}] {printable(name)}", file=sys.stderr)
        try:
            make(job)
        except NotAvailableError as error:
            print(f"skipping {printable(name)}: {printable(str(error))}", file=sys.stderr)
        except (UsageError, DataError) as error:
            print(f"{printable(name)} failed: {printable(str(error))}", file=sys.stderr)
            failed.append(name)
    if failed:
        raise DataError(
            f"{len(failed)} of {len(todo)} could not be made: {', '.join(failed)}; the lines above say why"
        )


def make_ablation(config: ReproduceConfig) -> None:
    """Make an ablation in one world."""
    if not os.path.isdir(config.folder):
        check_place(config.folder)
    from experiments.ablations import as_text, files_of, save
    from experiments.ablations import make as make_lines
    from experiments.store.seals import check_replaceable

    check_replaceable(files_of(config))
    lines = make_lines(config)
    text = as_text(config, lines)
    say(text)
    save(config, text, lines)
    print(f"table and curves in {files_of(config)[0]} and .png", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(ReproduceConfig, main, argv=argv)


if __name__ == "__main__":
    command()
