"""The pictures that a world can draw, as functions of plain data.

Generic code runs the episodes, lays out the axes, writes the titles and saves the files. A world only
draws.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from envs.base import Episode

Goals = np.ndarray  # [k, G] the goals of a prompt; the last is usually the task goal


class Shown(NamedTuple):
    """The subject of a picture: a prompt, and an episode under it."""

    title: str
    """The title above the picture. On axes it is written by generic code, in a video by the world."""
    goals: Goals
    episode: Episode
    """One episode with numpy leaves; for ``visits`` a batch of them."""


class Stage(NamedTuple):
    """The best prompt of a search after a number of episodes."""

    label: str
    """The label of the stage, such as "20 episodes"."""
    goals: Goals
    return_: float


class Pictures(NamedTuple):
    """The pictures of a world; those that it does not draw are None.

    A task is the world's record of one task, with numpy leaves. Functions that take axes are given one for
    each task, all in the same figure, and may add a legend to that figure (``loc="outside lower center"``
    keeps it off the pictures).
    """

    prompts: Callable | None = None
    """``(axes, tasks, prompts) -> None``: the prompts of several methods on each task. ``prompts[i]`` maps
    the color of a method to its goals ``[k, G]``."""
    search: Callable | None = None
    """``(axes, tasks, searches) -> None``: how the prompt changes during one search on each task.
    ``searches[i]`` is a sequence of ``Stage``, drawn as rows."""
    visits: Callable | None = None
    """``(axes, tasks, shown) -> ScalarMappable | None``: where many episodes went under each prompt, in
    colors that all axes share. The result is drawn as a color bar."""
    known: Callable | None = None
    """``(axes, tasks, shown, reached) -> ScalarMappable | None``: one episode under each prompt, on top of
    what was known before. ``reached[i]`` are the goals ``[n, G]`` that all earlier episodes have reached.
    The result is drawn as a color bar."""
    episodes: Callable | None = None
    """``(axes, tasks, shown) -> None``: one episode on each task as a still picture."""
    video: Callable | None = None
    """``(path, task, shown) -> None``: episodes on one task side by side as a GIF."""
    frame: Callable | None = None
    """``(obs) -> [H, W, 3]`` bytes: an image of the world at an observation. If a world has only this,
    generic code makes its video."""
    another_order: bool = False
    """Whether a video also shows the optimized prompt with its goals in another order, for worlds whose
    tasks are orders."""
    panel: tuple[float, float] = (2.0, 2.2)
    """Width and height in inches of the picture of one task, including its title and its share of a
    legend."""
    row: Callable[[int], tuple[float, float]] = lambda num_goals: (0.2 * num_goals + 0.6, 0.24)
    """``(num_goals) -> (width, height)`` in inches of a row of ``search`` whose prompt has that many
    goals."""


def observations(episode: Episode) -> np.ndarray:
    """The observations of one episode from its start to its end, ``[length + 1, ..]``."""
    trajectory = episode.trajectory
    before = np.asarray(trajectory.obs)[: int(trajectory.length)]
    return np.concatenate([before, np.asarray(episode.last_obs)[None]])
