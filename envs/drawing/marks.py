"""Labeled discs and boxes in units of cells, and a layout in which they do not hide each other.

Rows are counted downwards: letters are upright on axes whose y axis points down.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyBboxPatch, Patch, PathPatch
from matplotlib.textpath import TextPath
from matplotlib.transforms import Affine2D

from envs.drawing.palette import INK, PAPER, ink_on

RADIUS = 0.6  # of a mark of size 1
FONT = FontProperties(family="DejaVu Sans", weight="bold")


def draw_disc(
    ax: Axes, label: str, color: str, x: float, y: float, size: float, filled: bool = True
) -> None:
    """Draw a filled disc, or (not ``filled``) a ring around a dark letter."""
    disc = Circle((x, y), RADIUS * size, facecolor=color, edgecolor=PAPER, linewidth=0.8)
    if not filled:
        disc.set(radius=0.9 * RADIUS * size, facecolor=PAPER, edgecolor=color, linewidth=1.6)
    _draw_labeled(ax, disc, label, ink_on(color) if filled else INK, x, y, size)


def draw_box(ax: Axes, label: str, color: str, x: float, y: float, size: float) -> None:
    """Draw a box with round corners, wider for a long label (``box_width``)."""
    half, width = 0.9 * RADIUS * size, box_width(label, size)
    style = f"round,pad=0,rounding_size={0.25 * size}"
    box = FancyBboxPatch(
        (x - width / 2, y - half), width, 2 * half,
        boxstyle=style, facecolor=color, edgecolor=INK, linewidth=0.8,
    )  # fmt: skip
    _draw_labeled(ax, box, label, ink_on(color), x, y, size)


def box_width(label: str, size: float) -> float:
    """The width of a box in cells: it is a square, unless its label needs more."""
    bounds = TextPath((0, 0), label, size=1, prop=FONT).get_extents()
    return max(1.8 * RADIUS * size, (bounds.x1 - bounds.x0) * _height(label, size) + 0.3 * size)


def draw_leader(ax: Axes, home: np.ndarray, center: np.ndarray) -> None:
    """Draw a thin line from the cell ``[2]`` that a mark belongs to, to the place ``[2]`` where it is
    drawn."""
    rows, columns = np.stack([home, center], axis=1)
    line = Line2D(columns, rows, color=INK, linewidth=0.8, zorder=2.5)
    line.set(marker="o", markersize=2.5, markevery=[0])
    ax.add_line(line)


def spread_apart(
    homes: np.ndarray, heavy: np.ndarray, gap: float | np.ndarray, limits: tuple[float, float]
) -> np.ndarray:
    """Move points ``[n, 2]`` away from their homes until they are ``gap`` apart, within ``limits``.

    The gap may differ from pair to pair, ``[n, n]``. Points push each other away until none overlap. Those
    with room around them stay at home, and ``heavy`` ones are moved last.
    """
    # Equal points are first moved apart, each in a different direction.
    index = np.arange(len(homes))
    equal = np.all(homes[:, None] == homes[None], axis=-1)
    angle = np.pi + 2.4 * index
    nudge = 0.05 * np.max(gap) * np.stack([np.sin(angle), np.cos(angle)], axis=1)
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


def _height(label: str, size: float) -> float:
    """The size of the letters of a label in cells; several letters are smaller than one."""
    return 0.95 * size * (1.0 if len(label) == 1 else 0.7)


def _draw_labeled(
    ax: Axes, shape: Patch, label: str, ink: str, x: float, y: float, size: float
) -> None:
    shape.set(zorder=3)
    ax.add_patch(shape)
    text = TextPath((0, 0), label, size=1, prop=FONT)
    bounds = text.get_extents()
    center = -(bounds.x0 + bounds.x1) / 2, -(bounds.y0 + bounds.y1) / 2
    height = _height(label, size)
    upright = Affine2D().translate(*center).scale(height, -height).translate(x, y)
    letter = PathPatch(text.transformed(upright), facecolor=ink, linewidth=0)
    letter.set(zorder=4, label=label)
    ax.add_patch(letter)
