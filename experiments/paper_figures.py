"""The paper's figures of prompts, and of episodes under them (Figures 2, 3, 5, 9 and 10).

They are among the figures that ``experiments.plot`` draws, and show cells of the comparisons
(``experiments.comparisons``), which are made if they are missing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import NamedTuple

from envs.errors import DataError, NotAvailableError, UsageError
from experiments.comparisons import TABLES, made, worlds_of
from experiments.drawing import pictures_together, write
from experiments.prompt_lengths import entropy_table
from experiments.runtime import say
from experiments.store.reproduce_settings import ReproduceConfig
from experiments.store.result_files import load_results
from experiments.store.results import Results
from experiments.store.seals import check_replaceable, write_sealed
from experiments.store.settings import file_name


class Picture(NamedTuple):
    """A figure of prompts, or of episodes under them."""

    methods: tuple[str, ...]
    pattern: str
    """Glob pattern of its file names among those that ``experiments.plot`` draws."""
    numbers: Callable[[Results], str] | None = None
    """Makes a Markdown table of the numbers that the figure shows, from the results of an adaptation."""


PICTURES: Mapping[str, Picture] = {
    "figure2": Picture(TABLES["table2"].methods, "*_prompts.png"),
    "figure3": Picture(("ucb",), "*_evolution_*.png"),
    "figure5": Picture(("ucb",), "*.gif"),
    "figure9": Picture(("ucb",), "*_short_and_long.png", entropy_table),
    "figure10": Picture(("ucb",), "*_evolution_*.png"),
}


def draw(config: ReproduceConfig) -> list[Path]:
    """Draw a figure in each of its worlds, after making the adaptations that are missing.

    If the figure also has a table of numbers, the table is printed, and written beside the figure.

    Returns:
      The files.

    Raises:
      UsageError: if a world or a network is missing, or a world draws no such figure.
    """
    return [path for world in worlds_of(config) for path in _draw_in(config, world)]


def _draw_in(config: ReproduceConfig, world: str) -> list[Path]:
    """Draw a figure in one world; returns its files."""
    figure, results = PICTURES[config.what], {}
    for method in figure.methods:
        cell = made(config, world, method)
        if cell.results is None:
            kind = DataError if cell.failed else UsageError
            raise kind(f"{config.what} is not available for {world}: {cell.reason}")
        results[method] = load_results(cell.results)
    place = config.out / f"{config.what}-{config.scale}_{file_name(world)}.md"
    saves = {
        config.out / f"{config.what}-{config.scale}_{name}": save
        for name, save in pictures_together(results, (), seed=0)
        if fnmatch(name, figure.pattern)
    }
    if not saves and figure.numbers is None:
        raise NotAvailableError(
            f"{config.what} is not available for {world}, which does not draw such a figure"
        )
    check_replaceable((place, *saves) if figure.numbers else saves)
    config.out.mkdir(parents=True, exist_ok=True)
    for path, save in saves.items():
        write(path, save)
    if figure.numbers is None:
        return list(saves)
    text = figure.numbers(results[figure.methods[0]])
    say(text)
    write_sealed(place, lambda path: path.write_text(text, encoding="utf-8"))
    return [*saves, place]
