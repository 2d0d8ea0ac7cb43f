"""The figures that can be drawn of adaptations, by file name; drawing them is ``figures.rollouts``.

Which ones there are depends on the world's ``Pictures``, and on whether the methods have prompts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
from matplotlib.figure import Figure

from envs.drawing import Pictures
from experiments.figures.rollouts import (
    Play,
    episodes,
    evolution,
    known,
    methods,
    prompts,
    search,
    short_and_long,
    video,
)
from experiments.store.settings import file_name

if TYPE_CHECKING:
    from experiments.store.results import Results

Save = Callable[[Path], object]
"""Writes one picture to a path."""


def figures_of_run(
    pictures: Pictures, result: Results, which: Sequence[int]
) -> Iterator[tuple[str, Save]]:
    """The figures of one adaptation that need no policy: their file names and writers."""
    if _has_prompts(result):
        if pictures.prompts:
            yield "prompts.png", later(prompts, pictures, {result.method: result}, which)
        if pictures.search:
            yield "search.png", later(search, pictures, result, which)


def later(draw: Callable[..., Figure], *args: Any) -> Save:
    """A writer that draws its figure only when it is called."""
    return lambda path: draw(*args).savefig(path)


def figures_of_results(
    pictures: Pictures,
    results: Mapping[str, Results],
    play_with: Callable[[Results], Play],
    which: Sequence[int],
    seed: int,
) -> Iterator[tuple[str, Save]]:
    """The figures of some adaptations to the same tasks: their file names and writers.

    Figures are drawn when their writers are called; all policies are loaded once the iterator is exhausted.

    Args:
      pictures: the pictures that the world offers.
      results: adaptations by their labels in legends, "method" or "method (remark)".
      play_with: makes the function that runs episodes for an adaptation.
      which: indices of the tasks to draw; figures of a single task show the first.
      seed: index of the seed to draw.
    """
    results = {label: result for label, result in results.items() if _has_prompts(result)}
    if not results:
        return
    if pictures.prompts:
        yield "prompts.png", later(prompts, pictures, results, which, seed)
    key = jax.random.key(seed)
    if pictures.episodes and len(results) > 1:
        players = {label: play_with(result) for label, result in results.items()}
        yield "methods.png", later(methods, pictures, results, players, which, seed, key)
    for number, (name, result) in enumerate(_file_names(results).items()):
        if pictures.search:
            yield f"{name}_search.png", later(search, pictures, result, which, seed)
        drawn = (pictures.visits, pictures.known, pictures.episodes, pictures.video, pictures.frame)
        if not any(drawn):
            continue
        play = play_with(result)
        if pictures.visits:
            if number == 0:
                yield (
                    "short_and_long.png",
                    later(short_and_long, pictures, result, play, which, key),
                )
            for task in which:
                draw = later(evolution, pictures, result, play, task, seed, key)
                yield f"{name}_evolution_task{task}.png", draw
        if pictures.known and result.reached is not None:
            for task in which:
                draw = later(known, pictures, result, play, task, seed, key)
                yield f"{name}_known_task{task}.png", draw
        if pictures.episodes:
            draw = later(episodes, pictures, result, play, which, seed, key)
            yield f"{name}_episodes.png", draw
        if pictures.video or pictures.frame:
            save = partial(video, pictures, result, play, which[0], seed, key)
            yield f"{name}_episode_task{which[0]}.gif", save


def _has_prompts(result: Results) -> bool:
    return result.best_goals(0, 0) is not None


def _file_names(results: Mapping[str, Results]) -> dict[str, Results]:
    """Results by file name: the method's name, with a number if it occurs more than once."""
    names: dict[str, Results] = {}
    for number, result in enumerate(results.values()):
        method = file_name(result.method)
        names[f"{method}_{number}" if method in names else method] = result
    return names
