"""Pictures of Crafter: the map with the agent's path, the achievements over time, and the agent's view.

An episode records what the agent saw, but not where it was. Its path is reconstructed from its observations
and actions, since everything that can block a move is in view.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8, UInt32
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.lines import Line2D

from envs.base import Episode
from envs.crafter.env import PLACE_UNIT, Crafter, CrafterTask
from envs.crafter.rules import SIDE, new_world
from envs.crafter.tiles import picture, tiles
from envs.crafter.view import (
    ACHIEVEMENTS,
    ASLEEP,
    BLOCKS,
    COLUMNS,
    NUM_ACHIEVEMENTS,
    NUM_BLOCKS,
    NUM_MOBS,
    ROWS,
)
from envs.drawing.marks import RADIUS, box_width, draw_box, draw_disc, draw_leader, spread_apart
from envs.drawing.palette import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PALE_INK,
    PAPER,
    PURPLE,
    VERMILION,
    ink_on,
)
from envs.drawing.pictures import Pictures, Shown, observations
from envs.drawing.video import Film, write_films

UNIT = 16  # pixels of a cell of a map, the size of Crafter's textures
VIDEO_UNIT = 24  # pixels of a cell of a video
TIME_COLORS = LinearSegmentedColormap.from_list("time", ["#FFFFFF", ORANGE])
COLORS = {"collect": GREEN, "place": BLUE, "make": ORANGE}  # of achievements, by their first word
PROMPT = VERMILION  # of goals of a prompt
WAY = "way of the agent, from white to orange"
ASKED = "boxes 1, 2, ..: goals of the prompt, at their places"
MARK = 1.5  # size of a mark on a map of 30 x 30 cells, in cells
WALKABLE = ("grass", "sand", "path", "lava")
MARGIN = 5  # smallest margin around the path on a map, in cells
BAR = 0.6  # height of the bar of achievements, as a fraction of the map's
MOVES = ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0))  # moves of the first five actions


def crafter_pictures(env: Crafter) -> Pictures:
    """The pictures of Crafter. If observations are pictures already, its only picture is a video of
    them."""
    if env.pixels:
        return Pictures(frame=np.asarray)
    return Pictures(episodes=draw_episodes, video=write_video, panel=(3.1, 6.0))


def draw_episodes(
    axes: Sequence[Axes], tasks: Sequence[CrafterTask], shown: Sequence[Shown]
) -> None:
    """The map of each world with the agent's path, its achievements and the places that the prompt names.

    The bar of achievements is below the map.
    """
    for ax, task, each in zip(axes, tasks, shown, strict=True):
        way, unlocked = way_of(each.episode), unlocks_of(each.episode)
        draw_map(ax, task, way, unlocked, places_of(each.goals))
        draw_bar(ax.inset_axes((0.0, -BAR, 1.0, BAR - 0.08)), unlocked, len(way) - 1, each.goals)
    draw_legend(axes[0].figure, any(places_of(each.goals) for each in shown))


def way_of(episode: Episode) -> Int[np.ndarray, "P 2"]:
    """The agent's position at the start and after each step, as (row, column).

    The agent moves if it is awake and the cell in front of it is free, both of which it observes.
    """
    seen = observations(episode)
    actions = np.asarray(episode.trajectory.actions)[: len(seen) - 1]
    place = np.array([SIDE // 2, SIDE // 2])
    way = [place]
    for obs, action in zip(seen, actions, strict=False):
        move = np.array(MOVES[action] if action < len(MOVES) else MOVES[0])
        row, column = np.array([ROWS // 2, COLUMNS // 2]) + move
        block, others = (
            int(part) for part in reversed(divmod(obs[row * COLUMNS + column], NUM_BLOCKS))
        )
        if not obs[ASLEEP] and BLOCKS[block] in WALKABLE and others % NUM_MOBS == 0:
            place = place + move
        way.append(place)
    return np.stack(way)


def unlocks_of(episode: Episode) -> list[tuple[int, int]]:
    """The achievements of one episode in order, each with the step after which it was unlocked."""
    goals = np.asarray(episode.trajectory.achieved_goals)[: int(episode.trajectory.length)]
    goals = goals[:, :NUM_ACHIEVEMENTS]
    return [(int(goal), int(step) + 1) for step, goal in zip(*np.nonzero(goals > 0.5), strict=True)]


def places_of(goals: Float[np.ndarray, "k G"]) -> dict[tuple[int, int], list[int]]:
    """The cells that goals of a prompt name, each with the numbers of its goals, counted from 1.

    Goals without a known place are left out. A place beyond the map counts as a cell at its edge.
    """
    found: dict[tuple[int, int], list[int]] = {}
    for number, goal in enumerate(np.asarray(goals, np.float64), start=1):
        known, *offset = goal[NUM_ACHIEVEMENTS:] if goal.shape[0] > NUM_ACHIEVEMENTS else (0.0,)
        if known > 0.5:
            cell = np.nan_to_num(SIDE / 2 + PLACE_UNIT * np.array(offset))
            row, column = np.clip(np.rint(cell), 0, SIDE - 1).astype(int)
            found.setdefault((int(row), int(column)), []).append(number)
    return found


def joined(numbers: Sequence[int]) -> str:
    """The numbers of goals at one cell as a short label, such as "2-4,7"; "2,.." stands for many."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    texts = [str(run[0]) if len(run) == 1 else f"{run[0]}\N{EN DASH}{run[-1]}" for run in runs]
    return ",".join(texts if len(texts) < 3 else [texts[0], ".."])


class Mark(NamedTuple):
    """A mark on a map."""

    draw: Callable[..., None]
    """``draw_disc`` or ``draw_box``."""
    label: str
    color: str
    home: tuple[int, int]
    """The cell that it belongs to, as (row, column)."""


def marks_of(
    way: Int[np.ndarray, "P 2"],
    unlocked: Sequence[tuple[int, int]],
    places: Mapping[tuple[int, int], Sequence[int]],
) -> list[Mark]:
    """The marks on a map: the start, numbered discs of achievements, numbered boxes of goals."""

    def cell(step: int) -> tuple[int, int]:
        return int(way[step, 0]), int(way[step, 1])

    start = Mark(draw_box, "S", PAPER, cell(0))
    discs = [
        Mark(draw_disc, str(number), color_of(goal), cell(step))
        for number, (goal, step) in enumerate(unlocked, start=1)
    ]
    boxes = [Mark(draw_box, joined(numbers), PROMPT, home) for home, numbers in places.items()]
    return [start, *discs, *boxes]


def draw_map(
    ax: Axes,
    task: CrafterTask,
    way: Int[np.ndarray, "P 2"],
    unlocked: Sequence[tuple[int, int]],
    places: Mapping[tuple[int, int], Sequence[int]] = MappingProxyType({}),
) -> None:
    """Draw the part of the initial world around the agent's path, and the path from light to dark.

    Args:
      ax: the axes to draw on; their ticks and frame are removed.
      task: the world.
      way: the positions of the agent.
      unlocked: pairs of an achievement and the step at which it was unlocked, which are numbered in order.
      places: the cells that goals of the prompt name, with the numbers of the goals (``places_of``).
    """
    marks = marks_of(way, unlocked, places)
    covered = np.concatenate([way, [mark.home for mark in marks]])
    low = np.maximum(covered.min(axis=0) - MARGIN, 0)
    high = np.minimum(covered.max(axis=0) + MARGIN + 1, SIDE)
    # A square part, so that all maps of a figure have the same size.
    side = int(min(max(*(high - low)), SIDE))
    low = np.clip((low + high - side) // 2, 0, SIDE - side)
    top, left = low
    edges = left - 0.5, left + side - 0.5, top + side - 0.5, top - 0.5
    ax.imshow(
        map_picture(task)[UNIT * top :, UNIT * left :][: UNIT * side, : UNIT * side], extent=edges
    )
    _draw_way(ax, way)
    _draw_marks(ax, marks, MARK * side / 30, (float(low.min()), float((low + side - 1).max())))
    ax.set(xlim=edges[:2], ylim=edges[2:], xticks=[], yticks=[])
    ax.set_aspect("equal")
    ax.set_frame_on(False)


def _draw_way(ax: Axes, way: Int[np.ndarray, "P 2"]) -> None:
    points = way[:, ::-1].astype(float)
    for color, width in ((INK, 2.6), (None, 1.4)):
        lines = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), linewidth=width)
        lines.set(capstyle="round", zorder=1)
        if color:
            lines.set_color(color)
        else:
            lines.set(cmap=TIME_COLORS, array=np.linspace(0.0, 1.0, len(points) - 1))
        ax.add_collection(lines)


def _draw_marks(ax: Axes, marks: Sequence[Mark], size: float, limits: tuple[float, float]) -> None:
    """Draw marks beside each other, with lines to those cells from which they had to be moved."""
    homes = np.array([mark.home for mark in marks], float)
    heavy = np.arange(len(homes)) == 0
    wide = [box_width(m.label, size) if m.draw is draw_box else 2 * RADIUS * size for m in marks]
    gap = 0.52 * np.add.outer(wide, wide)
    centers = spread_apart(homes, heavy, gap, limits)
    for home, center in zip(homes, centers, strict=True):
        if np.linalg.norm(center - home) > 0.6:
            draw_leader(ax, home, center)
    for mark, (row, column) in zip(marks, centers, strict=True):
        mark.draw(ax, mark.label, mark.color, column, row, size)


def draw_bar(
    ax: Axes,
    unlocked: Sequence[tuple[int, int]],
    length: int,
    goals: Float[np.ndarray, "k G"] | None = None,
) -> None:
    """Draw when each achievement was unlocked, in one line for each, numbered as on the map.

    Where goals of a prompt name one achievement each, a line also says which goals named its own.
    """
    for number, (goal, step) in enumerate(unlocked, start=1):
        color, late = color_of(goal), step > length / 2
        ax.barh(number, length - step, left=step, height=0.9, color=color)
        # A label is within its line, or to the left of it if the line is short.
        text = f" {number} {name_of(goal)}{_named_by(goal, goals)} "
        label = ax.text(step, number, text, fontsize=5.5)
        label.set(ha="right" if late else "left", va="center_baseline")
        label.set_color(INK if late else ink_on(color))
    ax.set(xlim=(0, length), ylim=(max(len(unlocked), 8) + 0.6, 0.4), yticks=[], xlabel="step")
    ax.tick_params(labelsize=6)
    ax.xaxis.label.set_fontsize(6)
    ax.xaxis.labelpad = 1
    ax.set_axisbelow(True)
    for side in ("top", "right", "left"):
        ax.spines[side].set_visible(False)
    if not unlocked:
        ax.text(0.5, 0.5, "no achievement", transform=ax.transAxes, color=PALE_INK, ha="center")


def _named_by(achievement: int, goals: Float[np.ndarray, "k G"] | None) -> str:
    """Which goals of a prompt name just this achievement, in brackets; empty if none does."""
    if goals is None:
        return ""
    named = np.asarray(goals)[:, :NUM_ACHIEVEMENTS] > 0.5
    numbers = 1 + np.flatnonzero(named[:, achievement] & (named.sum(axis=1) == 1))
    return f" (goal {joined(numbers.tolist())})" if len(numbers) else ""


def draw_legend(figure: Any, with_places: bool) -> None:
    """What the marks on maps mean, below all maps of a figure.

    Args:
      figure: the figure that the maps are in.
      with_places: whether any map has places of goals.
    """

    def entry(marker: str, color: str, label: str) -> Line2D:
        edge = INK if marker == "s" else PAPER
        return Line2D([], [], ls="", marker=marker, ms=6, mfc=color, mec=edge, mew=0.8, label=label)

    handles = [entry("s", PAPER, "S: start"), Line2D([], [], color=ORANGE, label=WAY)]
    if with_places:
        handles.append(entry("s", PROMPT, ASKED))
    handles += [entry("o", color, kind) for kind, color in kinds()]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=6.5)


def kinds() -> list[tuple[str, str]]:
    """What the colors of achievements mean: pairs of a kind and its color."""
    words = {"collect": "collected", "place": "placed", "make": "made"}
    return [
        *((words[word], color) for word, color in COLORS.items()),
        ("other achievements", PURPLE),
    ]


def name_of(goal: int) -> str:
    """The name of an achievement as text."""
    return ACHIEVEMENTS[goal].replace("_", " ")


def color_of(goal: int) -> str:
    """The color of an achievement's kind: collecting, placing, making, or other."""
    return COLORS.get(ACHIEVEMENTS[goal].split("_")[0], PURPLE)


def map_picture(task: CrafterTask) -> UInt8[np.ndarray, "height width 3"]:
    """A picture of the whole initial world of a task, with 16 pixels per cell."""
    blocks = np.asarray(blocks_of(jnp.asarray(task.seed, jnp.uint32)))
    cells = tiles(UNIT).day[blocks]
    return cells.swapaxes(1, 2).reshape(SIDE * UNIT, SIDE * UNIT, 3)


@jax.jit
def blocks_of(seed: UInt32[Array, ""]) -> Int[Array, "64 64"]:
    """The initial blocks of the world of a seed."""
    return new_world(seed).map


def write_video(path: Path, task: CrafterTask, shown: Sequence[Shown]) -> None:
    """Write a video of the agent's view in episodes on one task, side by side, with its achievements so
    far."""
    films = [_film(each) for each in shown]
    write_films(path, films, f"Crafter, the world of seed {int(task.seed)}")


def _film(shown: Shown) -> Film:
    seen, unlocked = observations(shown.episode), unlocks_of(shown.episode)

    def caption(time: int) -> str:
        so_far = [goal for goal, step in unlocked if step <= time]
        last = f", last: {name_of(so_far[-1])}" if so_far else ""
        return f"step {time}, {len(so_far)} of {NUM_ACHIEVEMENTS}{last}"

    def frames(times: np.ndarray) -> np.ndarray:
        return np.asarray(_pictures(jnp.asarray(seen[times])))

    return Film(shown.title, len(seen), frames, caption)


@jax.jit
def _pictures(seen: Float[Array, "T O"]) -> UInt8[Array, "T height width 3"]:
    return jax.vmap(lambda obs: picture(obs, VIDEO_UNIT))(seen)
