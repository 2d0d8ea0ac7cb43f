"""Figure 11: the worlds at a glance, with a panel for each that the world itself draws."""

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

COLUMNS = 3  # maximum number of panels in a row
SIDE = 2.45  # width and height of a picture, in inches
WORDS_ROOM = 0.7  # height of the title and the description of a panel together, in inches
WORDS_SIZE = 6.5  # font size of the description, in points
LETTERS_IN_INCH = 17  # characters of the description per inch
LONGEST = 240  # maximum number of characters in the description


class Glance(NamedTuple):
    """The panel of a world."""

    title: str
    words: str
    """A one-sentence description, written below the picture."""
    draw: Callable[[Axes], None]
    """Draws the picture."""


def look_of(
    pictures: Pictures,
    task: Task,
    goal: np.ndarray,
    start: Callable[[], np.ndarray],
    play: Callable[[], Episode],
) -> Callable[[Axes], None] | None:
    """Choose how to draw a world on axes: a frame, a task, or an episode, whichever it offers first.

    Args:
      pictures: the pictures that the world offers.
      task: a task of the world, with numpy leaves.
      goal: the task goal, ``[G]``.
      start: returns the first observation of an episode; only called if a frame is drawn.
      play: runs an episode on the task; only called if an episode is drawn.

    Returns:
      A function that draws on axes, or None if the world offers no still picture.
    """
    prompts, episodes = pictures.prompts, pictures.episodes
    if pictures.frame is not None:
        frame = np.asarray(pictures.frame(start()))
        return lambda ax: _draw_frame(ax, frame)
    if prompts is not None:  # with no prompts at all, it draws the task alone
        return lambda ax: prompts([ax], [task], [{}])
    if episodes is not None:
        episode = play()
        shown = Shown("", np.concatenate([reached_goals(episode), goal[None]]), episode)
        return lambda ax: episodes([ax], [task], [shown])
    return None


def reached_goals(episode: Episode) -> np.ndarray:
    """The goals ``[k, G]`` that an episode reached, in order."""
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
    """Figure 11: a panel for each world, with its name above and its description below.

    Legends that worlds draw are removed: they explain details that do not matter here.
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
