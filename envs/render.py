"""Host-side pictures of mazes: walls, visits, paths, prompts, and GIFs of episodes.

Positions are (row, column). Markers and labels are drawn in units of cells, so they keep their place
and proportion at every figure size. Colors are the color-blind-safe palette of Okabe and Ito.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import imageio.v3 as iio
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, PowerNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyBboxPatch, Patch, PathPatch, Rectangle
from matplotlib.textpath import TextPath
from matplotlib.transforms import Affine2D

Cell = tuple[int, int] | np.ndarray  # row, column

PROMPT_COLOR = "#D55E00"
AGENT_COLOR = "#0072B2"
START_COLOR = "#FFFFFF"
GOAL_COLOR = "#F0E442"
INK = "#1F292E"
WALL_COLOR = "#3D4A52"
FREE_COLOR = "#FAFAFC"
BAR_COLOR = "#C9CED2"
VISIT_COLORS = LinearSegmentedColormap.from_list(
    "visits", ["#EAE6F3", "#C3B7DC", "#9A86C2", "#704FA3", "#48237F", "#260B4D"]
)

BAR_GAP = 0.6  # cells between the maze and the bar of goals outside of it
BAR_LANE, BAR_ROW = 1.7, 1.35  # size of a marker's place in that bar, in marker units
FONT = FontProperties(family="DejaVu Sans", weight="bold")
MAX_FRAMES = 120


class Placement(NamedTuple):
    """Where the goals of one prompt lie."""

    cells: np.ndarray
    """``[k, 2]`` integers, the nearest cells; meaningless for goals outside the maze."""
    outside: np.ndarray
    """``[k]`` booleans: the goal lies in no cell of the maze."""


class _Marker(NamedTuple):
    """A labeled shape at a cell, or (``cell=None``) in the bar."""

    label: str
    color: str
    shape: Literal["disc", "box"]
    cell: tuple[int, int] | None


def place_goals(goals: np.ndarray, side: int) -> Placement:
    """Cells of goals given in goal units (row / side, column / side)."""
    positions = np.asarray(goals, np.float64).reshape(-1, 2) * side
    finite = np.isfinite(positions)
    # Clipping first keeps huge values from overflowing the integers.
    cells = np.rint(np.clip(np.where(finite, positions, -1.0), -1.0, side)).astype(int)
    return Placement(cells, ~np.all((cells >= 0) & (cells < side), axis=1))


def visit_norm(*visits: np.ndarray) -> PowerNorm:
    """A color scale that several pictures can share; it spreads the few-visits end."""
    top = max((float(np.max(counts)) for counts in visits), default=0.0)
    return PowerNorm(gamma=0.5, vmin=0.0, vmax=top if top > 0 else 1.0)


def visit_scale(norm: PowerNorm) -> ScalarMappable:
    """What ``Figure.colorbar`` needs to explain the colors of visits."""
    return ScalarMappable(norm, VISIT_COLORS)


def bar_lanes(side: int, prompts: Iterable[np.ndarray]) -> int:
    """How many lanes the bar needs for the goals of ``prompts`` that lie outside the maze."""
    count = sum(int(place_goals(goals, side).outside.sum()) for goals in prompts)
    return -(-count // _markers_in_lane(side))


def picture_width(side: int, lanes: int) -> float:
    """Width in cells of a maze with its bar."""
    return side + (BAR_GAP + lanes * BAR_LANE * _unit(side) if lanes else 0.0)


def draw_maze(
    ax: Axes,
    maze: np.ndarray,
    start: Cell,
    goal: Cell,
    prompt_goals: np.ndarray | Mapping[str, np.ndarray] | None = None,
    visits: np.ndarray | None = None,
    paths: Iterable[np.ndarray] | None = None,
    norm: PowerNorm | None = None,
    lanes: int | None = None,
) -> None:
    """Draw a maze with its start S, its task goal T and what happens in it.

    Args:
      ax: where to draw; its ticks and frame are removed.
      maze: ``[side, side]``, 1 is a wall.
      start: cell of the start.
      goal: cell of the task goal.
      prompt_goals: ``[k, 2]`` goals of a prompt in goal units, numbered in their order, or several
        prompts by color. A last goal at T is not repeated; goals outside the maze go to a bar at
        the right.
      visits: ``[side, side]`` how often each cell was visited; darker is more.
      paths: ``[T, 2]`` cells of walks to draw as lines.
      norm: color scale of ``visits`` [their own range].
      lanes: lanes of the bar [as many as needed], to align pictures that share a row.
    """
    maze = np.asarray(maze)
    side = len(maze)
    prompts = _by_color(prompt_goals)
    lanes = bar_lanes(side, prompts.values()) if lanes is None else lanes

    ax.imshow(_cell_colors(maze, visits, norm), interpolation="nearest", zorder=0)
    for path in paths or ():
        rows, columns = np.asarray(path, float).reshape(-1, 2).T
        ax.plot(columns, rows, color=AGENT_COLOR, alpha=0.5, linewidth=1.4, zorder=1)
    _draw_markers(ax, side, _markers(side, start, goal, prompts), lanes)

    right = picture_width(side, lanes) - 0.5
    ax.set(xlim=(-0.5, right), ylim=(side - 0.5, -0.5), xticks=[], yticks=[], aspect="equal")
    ax.set_frame_on(False)


def maze_gif(
    path: Path,
    maze: np.ndarray,
    start: Cell,
    goal: Cell,
    positions: np.ndarray,
    prompt_goals: np.ndarray | Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write a short GIF of one episode, with the cells ``positions [T, 2]`` after each step."""
    walk = np.concatenate([np.reshape(start, (1, 2)), np.reshape(positions, (-1, 2))])
    side = len(maze)
    prompts = _by_color(prompt_goals)
    width = picture_width(side, bar_lanes(side, prompts.values())) / side
    figure = Figure(figsize=(3.0 * width, 3.0), dpi=100)
    canvas = FigureCanvasAgg(figure)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw_maze(ax, maze, start, goal, prompts)
    (trail,) = ax.plot([], [], color=AGENT_COLOR, alpha=0.6, linewidth=2.5, zorder=1.5)
    agent = Circle((0, 0), 0.36 * _unit(side), facecolor=AGENT_COLOR, edgecolor="white", zorder=9)
    ax.add_patch(agent)

    frames = []
    times = np.unique(np.linspace(0, len(walk) - 1, min(len(walk), MAX_FRAMES)).round().astype(int))
    for time in times:
        rows, columns = walk[: time + 1].T
        trail.set_data(columns, rows)
        agent.center = (columns[-1], rows[-1])
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    durations = [100] * (len(frames) - 1) + [1500]  # ms; the end stays on view
    iio.imwrite(path, np.stack(frames), extension=".gif", duration=durations, loop=0)


def _by_color(prompts: np.ndarray | Mapping[str, np.ndarray] | None) -> Mapping[str, np.ndarray]:
    if prompts is None:
        return {}
    return prompts if isinstance(prompts, Mapping) else {PROMPT_COLOR: np.asarray(prompts)}


def _unit(side: int) -> float:
    """Size of markers in cells: one cell and a bit, and more where cells are tiny."""
    return max(1.0, side / 19)


def _markers_in_lane(side: int) -> int:
    return int(side / (BAR_ROW * _unit(side)))


def _cell_colors(maze: np.ndarray, visits: np.ndarray | None, norm: PowerNorm | None) -> np.ndarray:
    colors = np.empty((*maze.shape, 3))
    colors[:] = to_rgb(FREE_COLOR)
    if visits is not None:
        norm = visit_norm(visits) if norm is None else norm
        visited = visits > 0
        colors[visited] = VISIT_COLORS(norm(visits[visited]))[:, :3]
    colors[maze != 0] = to_rgb(WALL_COLOR)
    return colors


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


def _draw_markers(ax: Axes, side: int, markers: list[_Marker], lanes: int) -> None:
    unit = _unit(side)
    inside = [marker for marker in markers if marker.cell is not None]
    homes = np.array([marker.cell for marker in inside], float)
    heavy = np.array([marker.shape == "box" for marker in inside])
    margin = 0.6 * unit - 0.5  # no marker is cut at the edge
    centers = spread_apart(homes, heavy, gap=unit, limits=(margin, side - 1 - margin))
    for marker, home, center in zip(inside, homes, centers, strict=True):
        if np.linalg.norm(center - home) > 0.5:
            ends = np.stack([home, center])
            line = Line2D(ends[:, 1], ends[:, 0], color=INK, linewidth=0.8, zorder=2.5)
            line.set(marker="o", markersize=2.5, markevery=[0])
            ax.add_line(line)
        _draw_marker(ax, marker, center[1], center[0], unit)

    if lanes:
        left, width = side - 0.5 + BAR_GAP, lanes * BAR_LANE * unit
        ax.add_patch(Rectangle((left, -0.5), width, side, facecolor=BAR_COLOR, linewidth=0))
        outside = [marker for marker in markers if marker.cell is None]
        for index, marker in enumerate(outside):
            lane, row = divmod(index, _markers_in_lane(side))
            x = left + (lane + 0.5) * BAR_LANE * unit
            _draw_marker(ax, marker, x, -0.5 + (row + 0.6) * BAR_ROW * unit, unit)


def spread_apart(
    homes: np.ndarray, heavy: np.ndarray, gap: float, limits: tuple[float, float]
) -> np.ndarray:
    """Points ``[n, 2]`` near their homes, some ``gap`` from each other and within ``limits``.

    Points push each other away until none overlap; those with room around them stay at home, and
    ``heavy`` ones give way last.
    """
    # Equal points start apart, each in a direction of its own.
    index = np.arange(len(homes))
    equal = np.all(homes[:, None] == homes[None], axis=-1)
    angle = np.pi + 2.4 * index
    nudge = 0.05 * gap * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    shared = equal.sum(axis=1) > 1
    points = homes + np.where((shared & ~heavy)[:, None], nudge, 0.0)
    pace = np.where(heavy, 0.02, 0.4)[:, None]
    for _ in range(300):
        apart = points[:, None] - points[None]
        distance = np.linalg.norm(apart, axis=-1) + np.where(np.eye(len(homes)), np.inf, 1e-9)
        overlap = np.maximum(gap - distance, 0.0)
        points = points + pace * np.sum(apart * (overlap / distance)[..., None], axis=1)
        points = np.clip(points, *limits)
    return points


def _draw_marker(ax: Axes, marker: _Marker, x: float, y: float, size: float) -> None:
    radius = 0.6 * size
    shape: Patch
    if marker.shape == "disc":
        shape, edge = Circle((x, y), radius), "white"
    else:
        box = f"round,pad=0,rounding_size={0.25 * size}"
        corner = (x - 0.9 * radius, y - 0.9 * radius)
        shape, edge = FancyBboxPatch(corner, 1.8 * radius, 1.8 * radius, boxstyle=box), INK
    shape.set(facecolor=marker.color, edgecolor=edge, linewidth=0.8, zorder=3)
    ax.add_patch(shape)

    # Black or white, whichever stands out more from the marker's color.
    luminance = np.dot(to_rgb(marker.color), (0.299, 0.587, 0.114))
    text = TextPath((0, 0), marker.label, size=1, prop=FONT)
    bounds = text.get_extents()
    center = -(bounds.x0 + bounds.x1) / 2, -(bounds.y0 + bounds.y1) / 2
    height = 0.95 * size * (1.0 if len(marker.label) == 1 else 0.7)
    upright = Affine2D().translate(*center).scale(height, -height).translate(x, y)
    letter = PathPatch(
        text.transformed(upright), facecolor=INK if luminance > 0.6 else "white", linewidth=0
    )
    letter.set(zorder=4, label=marker.label)
    ax.add_patch(letter)
