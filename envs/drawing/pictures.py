"""What a world can draw, as functions of plain data.

Generic code runs the episodes, lays out the axes, writes the titles and saves the files. A world only
draws, and only what it offers here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from envs.base import Episode

Goals = np.ndarray  # [k, G] the goals of a prompt; the last is usually the task goal


class Shown(NamedTuple):
    """Something to show: a prompt, and what the agent does under it."""

    title: str
    """What stands above its picture. On axes generic code writes it, in a video the world."""
    goals: Goals
    episode: Episode
    """With numpy leaves: one episode, or for ``visits`` a batch of them."""


class Stage(NamedTuple):
    """The best prompt that a search knows after some episodes."""

    label: str
    """Such as "20 episodes"."""
    goals: Goals
    return_: float


class Pictures(NamedTuple):
    """What a world draws; it leaves out what it does not draw.

    A task is the world's record of one task, with numpy leaves. Functions that take axes get one for each
    of the tasks, all in one figure, and may add a legend to that figure (``loc="outside lower center"``
    keeps it off the pictures).
    """

    prompts: Callable | None = None
    """``(axes, tasks, prompts) -> None``: the prompts of several methods on each task. ``prompts[i]`` maps
    the color of a method to its goals ``[k, G]``."""
    search: Callable | None = None
    """``(axes, tasks, searches) -> None``: how the prompt changes in the course of one search on each
    task. ``searches[i]`` is a sequence of ``Stage``, drawn as rows."""
    visits: Callable | None = None
    """``(axes, tasks, shown) -> ScalarMappable | None``: where many episodes went under each prompt, in
    colors that all axes share. What is returned becomes the color bar."""
    known: Callable | None = None
    """``(axes, tasks, shown, reached) -> ScalarMappable | None``: one episode under each prompt, on top of
    what was seen until then. ``reached[i]`` are the goals ``[n, G]`` that all episodes before have reached.
    What is returned becomes the color bar."""
    episodes: Callable | None = None
    """``(axes, tasks, shown) -> None``: one episode on each task as a still picture."""
    video: Callable | None = None
    """``(path, task, shown) -> None``: episodes on one task side by side as a GIF."""
    frame: Callable | None = None
    """``(obs) -> [H, W, 3]`` bytes: what the world looks like at an observation. Generic code makes the
    video of a world that offers only this."""
    another_order: bool = False
    """Whether a video also shows the goals of the optimized prompt in another order, as in worlds whose
    tasks are orders."""
    panel: tuple[float, float] = (2.0, 2.2)
    """Inches that the picture of one task takes, with its title and its share of a legend."""
    row: Callable[[int], tuple[float, float]] = lambda num_goals: (0.2 * num_goals + 0.6, 0.24)
    """Inches that a row of ``search`` takes whose prompt has that many goals."""


def observations(episode: Episode) -> np.ndarray:
    """What was observed from the start to the end of one episode, ``[length + 1, ..]``."""
    trajectory = episode.trajectory
    before = np.asarray(trajectory.obs)[: int(trajectory.length)]
    return np.concatenate([before, np.asarray(episode.last_obs)[None]])
