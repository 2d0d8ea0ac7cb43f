"""Pictures of GridWorld: how a search finds the hidden order, episodes, and GIFs of them.

Positions are (row, column). Objects are labeled A to G, each in its own color; orders and prompts are
arrays of their indices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

from envs.base import Episode, Task
from envs.drawing.marks import draw_box, draw_disc, draw_leader, spread_apart
from envs.drawing.palette import (
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
from envs.drawing.pictures import Pictures, Shown, Stage, observations
from envs.drawing.video import axes_in_a_row, write_gif
from envs.gridworld.env import LETTERS, NONE, NUM_OBJECTS, OBJECTS, SIDE, GridWorld

OBJECT_COLORS = (ORANGE, BLUE, GREEN, YELLOW, PURPLE, SKY, VERMILION)
UNKNOWN = "?"  # label of a goal that is not a single object
NO_GOALS = "task goal only"
TIME_COLORS = LinearSegmentedColormap.from_list("time", ["#C3CACE", INK])

OBJECT_SIZE, SPARE_SIZE, PLACE_SIZE, START_SIZE, GOAL_SIZE = 0.95, 0.7, 0.62, 0.7, 0.72
CELLS = np.array(OBJECTS, float)
PLACE_SHIFT = np.array([-0.62, 0.62])  # from an object to the label of its place in the order
ROOM = 0.6  # margin around the grid in cells, for marks at its edge
STRIP = 1.5  # height of the prompt's strip below the grid, in cells
LANE, NUM_LANES = 0.12, 5  # distance in cells between the lanes that legs of a walk use in turn
STRIP_INDENT = 2.5  # column at which the goals in the strip begin

UNIT = 0.19  # distance in inches between the goals of a prompt in the picture of a search
ROW = 1.2  # distance between rows of that picture, in units
RETURN_ROOM = 1.9  # width of the column of returns, in units


def grid_pictures(env: GridWorld) -> Pictures:
    """The orders that a search tried, episodes under its prompts, and a GIF of one task."""
    del env  # the pictures do not depend on it

    def row(num_goals: int) -> tuple[float, float]:
        return UNIT * (max(NUM_OBJECTS, num_goals - 1) + RETURN_ROOM), UNIT * ROW

    return Pictures(
        search=draw_searches,
        episodes=draw_episodes,
        video=write_video,
        another_order=True,
        panel=(2.0, 2.75),
        row=row,
    )


def draw_searches(
    axes: Sequence[Axes], tasks: Sequence[Task], searches: Sequence[Sequence[Stage]]
) -> None:
    """For each task its true order, and below it the best prompt of each stage with its return."""
    named = [
        [named_objects(stage.goals, task.order) for stage in stages]
        for task, stages in zip(tasks, searches, strict=True)
    ]
    width = max(NUM_OBJECTS, *(len(objects) for rows in named for objects in rows))
    for ax, task, stages, rows in zip(axes, tasks, searches, named, strict=True):
        returns = [stage.return_ for stage in stages]
        _draw_search(ax, objects_of(task.order), rows, returns, width)
        ax.set_title("return", pad=2, loc="right", color=PALE_INK)
    labels = ["true order", *(stage.label for stage in searches[0])]
    axes[0].set_yticks(ROW * np.arange(len(labels)), labels)
    _legend(axes[0], {"next in the true order": _disc(PALE_INK), "out of turn": _disc(PAPER)}, 2)


def draw_episodes(axes: Sequence[Axes], tasks: Sequence[Task], shown: Sequence[Shown]) -> None:
    """An episode on each task; the objects that were switched on in order are drawn as filled discs."""
    for ax, task, (_, goals, episode) in zip(axes, tasks, shown, strict=True):
        objects = objects_of(task.order)
        num_solved = round(float(episode.return_) * len(objects))
        solved = np.isin(np.arange(NUM_OBJECTS), objects[:num_solved])
        prompt = named_objects(goals, task.order)
        draw_grid(ax, task.order, solved, walk_of(episode), prompt)
    entries = {
        "switched on in turn": _disc(PALE_INK),
        "not switched on in turn": _disc(PAPER),
        "gray: not in the task": _disc(BAR_COLOR, BAR_COLOR),
        "place in the true order": (_disc(INK, INK), _letter("1", PAPER)),
        "start": (_disc(PAPER, INK, "s"), _letter("S", INK)),
        "path, from light to dark": Line2D([], [], color=INK),
    }
    _legend(axes[0], entries, 3)


def write_video(path: Path, task: Task, shown: Sequence[Shown]) -> None:
    """Episodes on one task side by side."""
    panels = [
        Panel(title, walk_of(episode), named_objects(goals, task.order))
        for title, goals, episode in shown
    ]
    grid_gif(path, task.order, panels)


class Walk(NamedTuple):
    """One episode of T steps; row 0 is its start."""

    positions: np.ndarray
    """``[T + 1, 2]`` cells."""
    is_on: np.ndarray
    """``[T + 1, 7]`` booleans: which objects are on."""


class Panel(NamedTuple):
    """One episode of a GIF."""

    title: str
    walk: Walk
    prompt: np.ndarray | None = None
    """``[k]``: the objects that the goals of a prompt name, for a strip below the grid."""


def walk_of(episode: Episode) -> Walk:
    """The walk of one episode: its start and the world after each step."""
    seen = observations(episode)
    return Walk(seen[:, NUM_OBJECTS:].astype(int), seen[:, :NUM_OBJECTS] > 0.5)


def named_objects(goals: np.ndarray, order: np.ndarray) -> np.ndarray:
    """The objects that the goals ``[k, 7]`` of a prompt name, except for a last goal that is the task goal.

    Since some methods move goals, a goal counts as the object that it is nearest to. A goal that is not
    nearest to a single object is ``NONE``.
    """
    near = goals > 0.5
    task_goal = np.isin(np.arange(NUM_OBJECTS), order)
    if np.array_equal(near[-1], task_goal):
        near = near[:-1]
    return np.where(near.sum(axis=1) == 1, near.argmax(axis=1), NONE)


def in_turn(objects: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Which of the ``objects [k]`` that a prompt names are in order, ``[k]`` booleans.

    Together these objects are a prefix of the true order ``[n]``.
    """
    place, turns = 0, []
    for thing in objects.tolist():
        turns.append(place < len(order) and thing == order[place])
        place += turns[-1]
    return np.array(turns, bool)


def objects_of(order: np.ndarray) -> np.ndarray:
    """The n objects of a task ``[7]``, in order, without padding."""
    return order[order != NONE]


def draw_objects(
    ax: Axes, objects: np.ndarray, filled: np.ndarray, y: float, x: float = 0.0
) -> None:
    """Draw a row of discs for objects ``[k]``, from ``x`` on; those that are not ``filled [k]`` are
    rings."""
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
    """Draw the objects with their places in the true order, and an episode.

    Args:
      ax: the axes to draw on; their ticks and frame are removed.
      order: ``[7]`` the task; objects that are not in it are gray.
      filled: ``[7]`` objects to draw as filled discs; the others are rings.
      walk: an episode, drawn as a line from its start S, from light to dark.
      prompt: ``[k]`` objects that the goals of a prompt name, for a strip below the grid.
      lanes: whether to draw legs of the walk that share cells side by side.
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


def grid_gif(path: Path, order: np.ndarray, panels: Sequence[Panel]) -> None:
    """Write a short GIF of episodes on the task ``order [7]``; objects are filled while they are on."""
    has_strip = any(panel.prompt is not None for panel in panels)
    titles = [panel.title for panel in panels]
    figure, axes = axes_in_a_row(titles, 3.2, 3.5 if has_strip else 3.2)

    def show(time: int) -> None:
        for ax, (_, walk, prompt) in zip(axes, panels, strict=True):
            now = min(time, len(walk.positions) - 1)
            so_far = Walk(walk.positions[: now + 1], walk.is_on[: now + 1])
            ax.clear()
            draw_grid(ax, order, walk.is_on[now], so_far, prompt, lanes=False)
            row, column = walk.positions[now]
            # The agent is a ring, so that the letter of an object stays readable.
            ring = Circle((column, row), 0.75, fill=False, edgecolor=INK, linewidth=2.2, zorder=9)
            ax.add_patch(ring)

    write_gif(path, figure, show, max(len(panel.walk.positions) for panel in panels))


def _draw_search(
    ax: Axes, order: np.ndarray, rows: Sequence[np.ndarray], returns: Sequence[float], width: int
) -> None:
    """Draw the true order, and below it the prompt of each stage with its return."""
    right = width + RETURN_ROOM - 0.6
    draw_objects(ax, order, np.ones(len(order), bool), 0.0)
    ax.axhline(0.5 * ROW, color=BAR_COLOR, linewidth=0.8)
    for row, (objects, return_) in enumerate(zip(rows, returns, strict=True), start=1):
        draw_objects(ax, objects, in_turn(objects, order), ROW * row)
        if not len(objects):
            ax.text(-0.4, ROW * row, NO_GOALS, va="center_baseline", color=PALE_INK)
        ax.text(right, ROW * row, f"{return_:.2f}", va="center_baseline", ha="right")
    ax.set(xlim=(-0.6, right), ylim=(ROW * (len(rows) + 0.5), -0.5 * ROW), xticks=[], yticks=[])
    ax.set_aspect("equal")
    ax.tick_params(length=0)
    ax.set_frame_on(False)
    ax.grid(False)


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
    """Draw the start S, next to objects and labels that it would hide."""
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


def _legend(ax: Axes, entries: Mapping[str, Any], columns: int) -> None:
    """Add a legend of marks, or stacks of marks, below the figure that has these axes."""
    ax.figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=columns,
        handler_map={tuple: HandlerTuple(ndivide=1)},
    )  # fmt: skip


def _disc(face: str, edge: str = PALE_INK, marker: str = "o") -> Line2D:
    return Line2D(
        [], [], linestyle="", marker=marker, markersize=7, markeredgewidth=1.2,
        markerfacecolor=face, markeredgecolor=edge,
    )  # fmt: skip


def _letter(letter: str, color: str) -> Line2D:
    text = f"$\\mathbf{{{letter}}}$"
    return Line2D([], [], linestyle="", marker=text, markersize=4, markeredgewidth=0.3, color=color)
