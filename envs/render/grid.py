"""Pictures of GridWorld: objects, orders, episodes, and GIFs of them.

Positions are (row, column). Objects go by the letters A to G, each in a color of its own; orders and
prompts are arrays of their indices.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from envs.grid_world import NONE, NUM_OBJECTS, OBJECTS, SIDE
from envs.render.marks import draw_box, draw_disc, draw_leader, spread_apart
from envs.render.palette import (
    BAR_COLOR,
    BLUE,
    FREE_COLOR,
    GREEN,
    INK,
    LINE_COLOR,
    ORANGE,
    PALE_INK,
    PAPER,
    PURPLE,
    SKY,
    VERMILION,
    YELLOW,
)
from envs.render.video import write_gif

LETTERS = "ABCDEFG"
OBJECT_COLORS = (ORANGE, BLUE, GREEN, YELLOW, PURPLE, SKY, VERMILION)
UNKNOWN = "?"  # a goal that names no single object
NO_GOALS = "task goal only"
TIME_COLORS = LinearSegmentedColormap.from_list("time", ["#C3CACE", INK])

OBJECT_SIZE, SPARE_SIZE, PLACE_SIZE, START_SIZE, GOAL_SIZE = 0.95, 0.7, 0.62, 0.7, 0.72
CELLS = np.array(OBJECTS, float)
PLACE_SHIFT = np.array([-0.62, 0.62])  # from an object to its place in the order
ROOM = 0.6  # cells around the grid that marks of its edge reach into
STRIP = 1.5  # cells below the grid that the prompt takes
LANE, NUM_LANES = 0.12, 5  # distance in cells of the lanes that legs of a walk take in turn
STRIP_INDENT = 2.5  # where its goals begin


class Walk(NamedTuple):
    """One episode of T steps; row 0 is its start."""

    positions: np.ndarray
    """``[T + 1, 2]`` cells."""
    is_on: np.ndarray
    """``[T + 1, 7]`` booleans: which objects are on."""


def objects_of(order: np.ndarray) -> np.ndarray:
    """The objects of a task ``[7]`` in their order, ``[n]``."""
    return order[order != NONE]


def draw_objects(
    ax: Axes, objects: np.ndarray, filled: np.ndarray, y: float, x: float = 0.0
) -> None:
    """A row of discs for objects ``[k]``, one apart from ``x`` on; those not ``filled [k]`` are rings."""
    for index, (thing, is_filled) in enumerate(zip(objects, filled, strict=True)):
        known = thing != NONE
        label, color = (LETTERS[thing], OBJECT_COLORS[thing]) if known else (UNKNOWN, BAR_COLOR)
        draw_disc(ax, label, color, x + index, y, GOAL_SIZE, bool(is_filled))


def draw_grid(
    ax: Axes,
    order: np.ndarray,
    filled: np.ndarray,
    walk: Walk | None = None,
    prompt: np.ndarray | None = None,
    lanes: bool = True,
) -> None:
    """Draw the objects with their places in the true order, and what happens among them.

    Args:
      ax: where to draw; its ticks and frame are removed.
      order: ``[7]`` the task; objects that are not in it are gray.
      filled: ``[7]`` objects drawn as full discs, the others are rings.
      walk: an episode, drawn as a line from its start S, from light to dark.
      prompt: ``[k]`` objects that the goals of a prompt name, for a strip below the grid.
      lanes: whether legs of the walk that share cells run side by side.
    """
    edges = np.arange(SIDE + 1) - 0.5
    ax.add_patch(Rectangle((-0.5, -0.5), SIDE, SIDE, facecolor=FREE_COLOR, linewidth=0, zorder=0))
    ends = np.full_like(edges, -0.5), np.full_like(edges, SIDE - 0.5)
    ax.hlines(edges, *ends, color=LINE_COLOR, linewidth=0.6, zorder=0.5)
    ax.vlines(edges, *ends, color=LINE_COLOR, linewidth=0.6, zorder=0.5)
    if walk is not None:
        _draw_walk(ax, walk, lanes)
        _draw_start(ax, walk.positions[0], order)
    _draw_things(ax, order, filled)
    if prompt is not None:
        _draw_strip(ax, prompt)
    below = SIDE - 0.5 + (ROOM if prompt is None else STRIP)
    ax.set(xlim=(-0.5 - ROOM, SIDE - 0.5 + ROOM), ylim=(below, -0.5 - ROOM), xticks=[], yticks=[])
    ax.set_aspect("equal")
    ax.set_frame_on(False)


def grid_gif(path: Path, order: np.ndarray, walk: Walk, prompt: np.ndarray | None = None) -> None:
    """Write a short GIF of one episode of the task ``order [7]``; objects are full while they are on."""
    figure = Figure(figsize=(3.2, 3.2 if prompt is None else 3.5), dpi=100)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))

    def show(time: int) -> None:
        ax.clear()
        so_far = Walk(walk.positions[: time + 1], walk.is_on[: time + 1])
        draw_grid(ax, order, walk.is_on[time], so_far, prompt, lanes=False)
        row, column = walk.positions[time]
        # A ring leaves the letter of an object readable.
        ax.add_patch(
            Circle((column, row), 0.75, fill=False, edgecolor=INK, linewidth=2.2, zorder=9)
        )

    write_gif(path, figure, show, len(walk.positions))


def _draw_walk(ax: Axes, walk: Walk, lanes: bool) -> None:
    switched = np.any(walk.is_on[1:] != walk.is_on[:-1], axis=1)
    leg = np.concatenate([[0], np.cumsum(switched)])
    shift = LANE * (leg % NUM_LANES - NUM_LANES // 2) * lanes
    points = walk.positions[:, ::-1] + shift[:, None]
    lines = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        cmap=TIME_COLORS, linewidth=1.7, capstyle="round", zorder=1,
    )  # fmt: skip
    lines.set_array(np.linspace(0.0, 1.0, len(points) - 1))
    ax.add_collection(lines)
    ax.add_patch(Circle(points[-1], 0.2, facecolor=INK, linewidth=0, zorder=2))


def _draw_start(ax: Axes, start: np.ndarray, order: np.ndarray) -> None:
    """The start S, beside the objects and places that it would hide."""
    taken = np.concatenate([CELLS, CELLS[objects_of(order)] + PLACE_SHIFT])
    homes = np.concatenate([taken, start[None]])
    heavy = np.arange(len(homes)) < len(taken)
    center = spread_apart(homes, heavy, gap=0.95, limits=(-0.7, SIDE - 0.3))[-1]
    if np.linalg.norm(center - start) > 0.5:
        draw_leader(ax, start, center)
    draw_box(ax, "S", PAPER, center[1], center[0], START_SIZE)


def _draw_things(ax: Axes, order: np.ndarray, filled: np.ndarray) -> None:
    places = {thing: place for place, thing in enumerate(objects_of(order).tolist(), start=1)}
    for thing in range(NUM_OBJECTS):
        row, column = CELLS[thing]
        in_task = thing in places
        color, size = (OBJECT_COLORS[thing], OBJECT_SIZE) if in_task else (BAR_COLOR, SPARE_SIZE)
        draw_disc(ax, LETTERS[thing], color, column, row, size, bool(filled[thing]))
        if in_task:
            row, column = CELLS[thing] + PLACE_SHIFT
            draw_disc(ax, str(places[thing]), INK, column, row, PLACE_SIZE)


def _draw_strip(ax: Axes, prompt: np.ndarray) -> None:
    y = SIDE - 0.5 + 0.62 * STRIP
    ax.text(-0.5, y, "prompt", va="center_baseline", color=INK, fontsize=8)
    if not len(prompt):
        ax.text(STRIP_INDENT - 0.4, y, NO_GOALS, va="center_baseline", color=PALE_INK, fontsize=8)
    draw_objects(ax, prompt, np.ones(len(prompt), bool), y, STRIP_INDENT)
