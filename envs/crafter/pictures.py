"""Pictures of Crafter: the map with the agent's path, the achievements over time, and the agent's view.

An episode records what the agent saw, but not where it was. Its path is reconstructed from its observations
and actions, since everything that can block a move is in view.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8, UInt32
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap

from envs.base import Episode
from envs.crafter.env import Crafter, CrafterTask
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
from envs.drawing.marks import draw_box, draw_disc, draw_leader, spread_apart
from envs.drawing.palette import BLUE, GREEN, INK, ORANGE, PALE_INK, PAPER, PURPLE, ink_on
from envs.drawing.pictures import Pictures, Shown, observations
from envs.drawing.video import Film, write_films

UNIT = 16  # pixels of a cell of a map, the size of Crafter's textures
VIDEO_UNIT = 24  # pixels of a cell of a video
TIME_COLORS = LinearSegmentedColormap.from_list("time", ["#FFFFFF", ORANGE])
COLORS = {"collect": GREEN, "place": BLUE, "make": ORANGE}  # of achievements, by their first word
MARK = 1.5  # size of a mark on a map of 30 x 30 cells, in cells
WALKABLE = ("grass", "sand", "path", "lava")
MARGIN = 5  # smallest margin around the path on a map, in cells
BAR = 0.5  # height of the bar of achievements, as a fraction of the map's
MOVES = ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0))  # moves of the first five actions


def crafter_pictures(env: Crafter) -> Pictures:
    """The pictures of Crafter. If observations are pictures already, its only picture is a video of
    them."""
    if env.pixels:
        return Pictures(frame=np.asarray)
    return Pictures(episodes=draw_episodes, video=write_video, panel=(3.1, 5.2))


def draw_episodes(
    axes: Sequence[Axes], tasks: Sequence[CrafterTask], shown: Sequence[Shown]
) -> None:
    """The map of each world with the agent's path and achievements, above the bar of achievements."""
    for ax, task, each in zip(axes, tasks, shown, strict=True):
        way, unlocked = way_of(each.episode), unlocks_of(each.episode)
        draw_map(ax, task, way, unlocked)
        draw_bar(ax.inset_axes((0.0, -BAR, 1.0, BAR - 0.08)), unlocked, len(way) - 1)


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


def draw_map(
    ax: Axes, task: CrafterTask, way: Int[np.ndarray, "P 2"], unlocked: Sequence[tuple[int, int]]
) -> None:
    """Draw the part of the initial world around the agent's path, and the path from light to dark.

    Args:
      ax: the axes to draw on; their ticks and frame are removed.
      task: the world.
      way: the positions of the agent.
      unlocked: pairs of an achievement and the step at which it was unlocked, which are numbered in order.
    """
    low = np.maximum(way.min(axis=0) - MARGIN, 0)
    high = np.minimum(way.max(axis=0) + MARGIN + 1, SIDE)
    # A square part, so that all maps of a figure have the same size.
    side = int(min(max(*(high - low)), SIDE))
    low = np.clip((low + high - side) // 2, 0, SIDE - side)
    top, left = low
    edges = left - 0.5, left + side - 0.5, top + side - 0.5, top - 0.5
    ax.imshow(
        map_picture(task)[UNIT * top :, UNIT * left :][: UNIT * side, : UNIT * side], extent=edges
    )
    points = way[:, ::-1].astype(float)
    for color, width in ((INK, 2.6), (None, 1.4)):
        lines = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), linewidth=width)
        lines.set(capstyle="round", zorder=1)
        if color:
            lines.set_color(color)
        else:
            lines.set(cmap=TIME_COLORS, array=np.linspace(0.0, 1.0, len(points) - 1))
        ax.add_collection(lines)
    size = MARK * side / 30
    homes = np.concatenate([way[:1], *(way[step][None] for _, step in unlocked)]).astype(float)
    heavy = np.arange(len(homes)) == 0
    limits = float(low.min()), float((low + side - 1).max())
    centers = spread_apart(homes, heavy, gap=1.25 * size, limits=limits)
    for home, center in zip(homes, centers, strict=True):
        if np.linalg.norm(center - home) > 0.6:
            draw_leader(ax, home, center)
    draw_box(ax, "S", PAPER, centers[0, 1], centers[0, 0], size)
    for number, ((goal, _), (row, column)) in enumerate(
        zip(unlocked, centers[1:], strict=True), start=1
    ):
        draw_disc(ax, str(number), color_of(goal), column, row, size)
    ax.set(xlim=edges[:2], ylim=edges[2:], xticks=[], yticks=[])
    ax.set_aspect("equal")
    ax.set_frame_on(False)


def draw_bar(ax: Axes, unlocked: Sequence[tuple[int, int]], length: int) -> None:
    """Draw when each achievement was unlocked, in one line for each, numbered as on the map."""
    for number, (goal, step) in enumerate(unlocked, start=1):
        color, late = color_of(goal), step > length / 2
        ax.barh(number, length - step, left=step, height=0.9, color=color)
        # A label is within its line, or to the left of it if the line is short.
        label = ax.text(step, number, f" {number} {name_of(goal)} ", fontsize=5.5)
        label.set(ha="right" if late else "left", va="center_baseline")
        label.set_color(INK if late else ink_on(color))
    ax.set(xlim=(0, length), ylim=(max(len(unlocked), 8) + 0.6, 0.4), yticks=[], xlabel="step")
    ax.tick_params(labelsize=6)
    ax.xaxis.label.set_fontsize(6)
    for side in ("top", "right", "left"):
        ax.spines[side].set_visible(False)
    if not unlocked:
        ax.text(0.5, 0.5, "no achievement", transform=ax.transAxes, color=PALE_INK, ha="center")


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
