"""Markers on pictures of mazes: start, task goal and the goals of prompts, without hiding each other.

Positions are (row, column). Markers are measured in cells, so that they keep their places and proportions
at every figure size. Goals outside of the maze are in a bar on its right. In large mazes, whose cells are
too small for numbers, the goals of a prompt are dots.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from envs.drawing.marks import draw_box, draw_disc, draw_leader, spread_apart
from envs.drawing.palette import BAR_COLOR, PAPER, YELLOW

Cell = tuple[int, int] | np.ndarray  # row, column

START_COLOR = PAPER
GOAL_COLOR = YELLOW

LARGEST_NUMBERED = 20  # side of the largest maze whose goals are drawn with their numbers
DOT_RADIUS = 0.62  # of a goal in a larger maze, in cells

BAR_GAP = 0.6  # distance in cells between the maze and the bar that shows goals outside of it
BAR_LANE, BAR_ROW = 1.7, 1.35  # width and height of a marker's place in that bar, in marker units


class Placement(NamedTuple):
    """The places of the goals of one prompt."""

    cells: np.ndarray
    """``[k, 2]`` integers, the nearest cells; meaningless for goals outside the maze."""
    outside: np.ndarray
    """``[k]`` booleans: whether the goal is outside of the maze."""


class _Marker(NamedTuple):
    """A labeled shape at a cell or (with ``cell=None``) in the bar."""

    label: str
    color: str
    shape: Literal["disc", "box"]
    cell: tuple[int, int] | None


def place_goals(goals: np.ndarray, side: int) -> Placement:
    """Cells of goals given in goal units (row / side, column / side)."""
    positions = np.asarray(goals, np.float64).reshape(-1, 2) * side
    finite = np.isfinite(positions)
    # Values are clipped first, so that huge ones do not overflow integers.
    cells = np.rint(np.clip(np.where(finite, positions, -1.0), -1.0, side)).astype(int)
    return Placement(cells, ~np.all((cells >= 0) & (cells < side), axis=1))


def bar_lanes(side: int, prompts: Iterable[np.ndarray]) -> int:
    """The number of lanes that the bar needs for goals of ``prompts`` outside of the maze."""
    count = sum(int(place_goals(goals, side).outside.sum()) for goals in prompts)
    return -(-count // _markers_in_lane(side))


def picture_width(side: int, lanes: int) -> float:
    """Width in cells of a maze with its bar."""
    return side + (BAR_GAP + lanes * BAR_LANE * marker_size(side) if lanes else 0.0)


def marker_size(side: int) -> float:
    """The size of markers in cells: a little more than one cell, and larger in big mazes with small
    cells."""
    return max(1.0, side / 19)


def draw_markers(
    ax: Axes,
    side: int,
    start: Cell,
    goal: Cell,
    prompts: Mapping[str, np.ndarray],
    lanes: int,
    joined: bool,
) -> None:
    """Draw the start S, the task goal T, and prompts on a maze.

    Args:
      ax: the axes to draw on.
      side: side of the maze.
      start: the cell of the start.
      goal: the cell of the task goal.
      prompts: ``[k, 2]`` goals of prompts in goal units, by color. A last goal at T is not drawn again.
      lanes: number of lanes of the bar.
      joined: whether the goals of a prompt are joined in order where they are dots.
    """
    markers = _markers(side, start, goal, prompts)
    if side > LARGEST_NUMBERED:
        markers = _draw_dots(ax, markers, start, side, prompts if joined else {})
    _draw_labeled(ax, side, markers, lanes)


def _markers_in_lane(side: int) -> int:
    return int(side / (BAR_ROW * marker_size(side)))


def _markers(
    side: int, start: Cell, goal: Cell, prompts: Mapping[str, np.ndarray]
) -> list[_Marker]:
    def as_cell(cell: Cell) -> tuple[int, int]:
        return (int(cell[0]), int(cell[1]))

    markers = [
        _Marker("S", START_COLOR, "box", as_cell(start)),
        _Marker("T", GOAL_COLOR, "box", as_cell(goal)),
    ]
    for color, goals in prompts.items():
        cells, outside = place_goals(goals, side)
        for index, (cell, is_outside) in enumerate(zip(cells, outside, strict=True)):
            is_last = index == len(cells) - 1
            if not is_outside and is_last and as_cell(cell) == as_cell(goal):
                continue
            at = None if is_outside else as_cell(cell)
            markers.append(_Marker(str(index + 1), color, "disc", at))
    return markers


def _draw_dots(
    ax: Axes, markers: list[_Marker], start: Cell, side: int, joined: Mapping[str, np.ndarray]
) -> list[_Marker]:
    """Draw the goals inside of the maze as dots below paths, and return the other markers.

    A thin line leads from the start over the goals of each prompt of ``joined`` that has dots.
    """
    dots = [marker for marker in markers if marker.shape == "disc" and marker.cell is not None]
    for marker in dots:
        row, column = marker.cell or (0, 0)
        dot = Circle((column, row), DOT_RADIUS, facecolor=marker.color, edgecolor=PAPER)
        dot.set(linewidth=0.6, zorder=0.8)
        ax.add_patch(dot)
    for color in dict.fromkeys(dot.color for dot in dots if dot.color in joined):
        cells, outside = place_goals(joined[color], side)
        rows, columns = np.asarray([start, *cells[~outside]], float).T
        ax.plot(columns, rows, color=color, linewidth=0.9, zorder=0.7)
    return [marker for marker in markers if marker not in dots]


def _draw_labeled(ax: Axes, side: int, markers: list[_Marker], lanes: int) -> None:
    unit = marker_size(side)
    inside = [marker for marker in markers if marker.cell is not None]
    homes = np.array([marker.cell for marker in inside], float)
    heavy = np.array([marker.shape == "box" for marker in inside])
    margin = 0.6 * unit - 0.5  # so that no marker is cut off at the edge
    centers = spread_apart(homes, heavy, gap=unit, limits=(margin, side - 1 - margin))
    for marker, home, center in zip(inside, homes, centers, strict=True):
        if np.linalg.norm(center - home) > 0.5:
            draw_leader(ax, home, center)
        _draw_marker(ax, marker, center[1], center[0], unit)

    outside = [marker for marker in markers if marker.cell is None]
    if outside:
        left, width = side - 0.5 + BAR_GAP, lanes * BAR_LANE * unit
        height = (min(len(outside), _markers_in_lane(side)) + 0.2) * BAR_ROW * unit
        ax.add_patch(Rectangle((left, -0.5), width, height, facecolor=BAR_COLOR, linewidth=0))
        for index, marker in enumerate(outside):
            lane, row = divmod(index, _markers_in_lane(side))
            x = left + (lane + 0.5) * BAR_LANE * unit
            _draw_marker(ax, marker, x, -0.5 + (row + 0.6) * BAR_ROW * unit, unit)


def _draw_marker(ax: Axes, marker: _Marker, x: float, y: float, size: float) -> None:
    draw = draw_disc if marker.shape == "disc" else draw_box
    draw(ax, marker.label, marker.color, x, y, size)
