"""Figure 11: the worlds at a glance, a panel for each, drawn as each world draws itself."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from envs.base import Episode, Task
from envs.drawing import Pictures, Shown
from experiments.figures.style import plain, styled

COLUMNS = 3  # at most
SIDE = 2.45  # inches of a panel across
WORDS_ROOM = 0.7  # inches that title and words take, above and below a picture
WORDS_SIZE = 6.5  # points of the words below
LETTERS_IN_INCH = 17  # of these words
LONGEST = 240  # letters of them


class Glance(NamedTuple):
    """A world in one panel."""

    title: str
    words: str
    """What it is, in a sentence; written below its picture."""
    draw: Callable[[Axes], None]


def look_of(
    pictures: Pictures,
    task: Task,
    goal: np.ndarray,
    start: Callable[[], np.ndarray],
    play: Callable[[], Episode],
) -> Callable[[Axes], None] | None:
    """What draws a world on axes, from what it offers; None if it draws nothing that stands still.

    Args:
      pictures: what the world draws.
      task: a task of it, with numpy leaves.
      goal: the task goal, ``[G]``.
      start: gives the first observation of an episode.
      play: plays an episode on the task. This and ``start`` are only called where a picture needs them.
    """
    prompts, episodes = pictures.prompts, pictures.episodes
    if pictures.frame is not None:
        frame = np.asarray(pictures.frame(start()))
        return lambda ax: _draw_frame(ax, frame)
    if prompts is not None:  # of no method: the world alone
        return lambda ax: prompts([ax], [task], [{}])
    if episodes is not None:
        episode = play()
        shown = Shown("", np.concatenate([reached_goals(episode), goal[None]]), episode)
        return lambda ax: episodes([ax], [task], [shown])
    return None


def reached_goals(episode: Episode) -> np.ndarray:
    """The goals ``[k, G]`` that an episode reached, in their order."""
    trajectory = episode.trajectory
    length = int(trajectory.length)
    reached = np.asarray(trajectory.goal_reached)[:length]
    return np.asarray(trajectory.achieved_goals)[:length][reached]


def _draw_frame(ax: Axes, frame: np.ndarray) -> None:
    ax.imshow(frame, interpolation="nearest" if len(frame) < 200 else "antialiased")
    ax.set(xticks=[], yticks=[])
    ax.set_frame_on(False)


@styled
def at_a_glance(worlds: Sequence[Glance]) -> Figure:
    """Figure 11: each world with its name above and what it is below, in rows of at most three.

    A world's legend is left out: it belongs to figures that ask for it.
    """
    rows = -(-len(worlds) // COLUMNS)
    columns = -(-len(worlds) // rows)
    figure = Figure(figsize=(SIDE * columns, (SIDE + WORDS_ROOM) * rows), layout="constrained")
    places = figure.subfigures(rows, columns, squeeze=False).flat
    for place, world in zip(places, worlds, strict=False):
        ax = place.subplots()
        ax.grid(False)
        world.draw(ax)
        for legend in place.legends:
            legend.remove()
        place.suptitle(plain(world.title), fontweight="bold", fontsize=9)
        words = textwrap.fill(plain(world.words, LONGEST), int(SIDE * LETTERS_IN_INCH))
        place.supxlabel(words, fontsize=WORDS_SIZE)
    return figure
