"""Pictures of mazes: walls, visits, paths, prompts, and GIFs of episodes.

Positions are (row, column). What is drawn of a prompt are the markers of ``envs.maze.markers``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, PowerNorm, to_rgb
from matplotlib.patches import Circle
from matplotlib.patheffects import Normal, Stroke

from envs.base import Episode, Task
from envs.drawing.palette import BLUE, FREE_COLOR, ORANGE, VERMILION, WALL_COLOR
from envs.drawing.pictures import Pictures, Shown
from envs.drawing.video import axes_in_a_row, write_gif
from envs.maze.bitboard import distances
from envs.maze.env import MOVES, MazeRunner
from envs.maze.markers import Cell, bar_lanes, draw_markers, marker_size, picture_width

PROMPT_COLOR = VERMILION
AGENT_COLOR = BLUE
SHORTEST_COLOR = ORANGE
SEEN_ON_DARK = (Stroke(linewidth=2.6, foreground="white"), Normal())
VISIT_COLORS = LinearSegmentedColormap.from_list(
    "visits", ["#EAE6F3", "#C3B7DC", "#9A86C2", "#704FA3", "#48237F", "#260B4D"]
)


def maze_pictures(env: MazeRunner) -> Pictures:
    """Prompts on mazes, visits under prompts, and a GIF of one task."""
    start = env.start
    return Pictures(
        prompts=partial(draw_prompts, start),
        visits=partial(draw_visits, start),
        known=partial(draw_known, start),
        episodes=partial(draw_episodes, start),
        video=partial(write_video, start),
        panel=(1.9, 2.1),
    )


def draw_prompts(
    start: Cell,
    axes: Sequence[Axes],
    tasks: Sequence[Task],
    prompts: Sequence[Mapping[str, np.ndarray]],
) -> None:
    """The prompts of several methods on each maze, in the color of their method."""
    lanes = max(bar_lanes(len(tasks[0].maze), by_color.values()) for by_color in prompts)
    for ax, task, by_color in zip(axes, tasks, prompts, strict=True):
        draw_maze(ax, task.maze, start, task.goal, by_color, lanes=lanes)


def draw_visits(
    start: Cell, axes: Sequence[Axes], tasks: Sequence[Task], shown: Sequence[Shown]
) -> ScalarMappable:
    """Each prompt on its maze, with the mean number of visits to each cell in its episodes."""
    visits = [
        visit_counts(each.episode, task.maze, start)
        for task, each in zip(tasks, shown, strict=True)
    ]
    norm = visit_norm(*visits)
    lanes = max(bar_lanes(len(tasks[0].maze), [each.goals]) for each in shown)
    for ax, task, each, counts in zip(axes, tasks, shown, visits, strict=True):
        draw_maze(
            ax, task.maze, start, task.goal, each.goals, visits=counts, norm=norm, lanes=lanes
        )
    return visit_scale(norm)


def draw_known(
    start: Cell,
    axes: Sequence[Axes],
    tasks: Sequence[Task],
    shown: Sequence[Shown],
    reached: Sequence[np.ndarray],
) -> ScalarMappable:
    """Each prompt on its maze, with the path of its episode, the number of earlier visits to each cell, and
    a shortest path."""
    counts = [reached_counts(goals, task.maze) for goals, task in zip(reached, tasks, strict=True)]
    norm = visit_norm(*counts)
    lanes = max(bar_lanes(len(tasks[0].maze), [each.goals]) for each in shown)
    for ax, task, each, visits in zip(axes, tasks, shown, counts, strict=True):
        _draw_episode(start, ax, task, each, lanes, visits=visits, norm=norm)
    return visit_scale(norm)


def draw_episodes(
    start: Cell, axes: Sequence[Axes], tasks: Sequence[Task], shown: Sequence[Shown]
) -> None:
    """Each prompt on its maze, with the path of its episode and a shortest path."""
    lanes = max(bar_lanes(len(tasks[0].maze), [each.goals]) for each in shown)
    for ax, task, each in zip(axes, tasks, shown, strict=True):
        _draw_episode(start, ax, task, each, lanes)


def _draw_episode(
    start: Cell, ax: Axes, task: Task, shown: Shown, lanes: int, **visited: Any
) -> None:
    """A prompt on its maze, with the path of its episode and a shortest path; ``visited`` are the visits of
    ``draw_maze`` and their color scale."""
    walk = walk_of(shown.episode, len(task.maze), start)
    draw_maze(
        ax,
        task.maze,
        start,
        task.goal,
        shown.goals,
        paths=[walk],
        shortest=shortest_path(task.maze, start, task.goal, walk),
        lanes=lanes,
        **visited,
    )


def write_video(start: Cell, path: Path, task: Task, shown: Sequence[Shown]) -> None:
    """Episodes on one maze side by side."""
    panels = [
        Panel(title, walk_of(episode, len(task.maze), start), goals)
        for title, goals, episode in shown
    ]
    maze_gif(path, task.maze, start, task.goal, panels)


class Panel(NamedTuple):
    """One episode of a GIF."""

    title: str
    walk: np.ndarray
    """``[T + 1, 2]`` cells, beginning with the start."""
    prompt_goals: np.ndarray | None = None
    """``[k, 2]``: the goals of the prompt, in goal units."""


def walk_of(episode: Episode, side: int, start: Cell) -> np.ndarray:
    """The cells of one episode, ``[length + 1, 2]``: the start, then the cell after each step."""
    goals = np.asarray(episode.trajectory.achieved_goals)[: int(episode.trajectory.length)]
    return np.concatenate([np.reshape(start, (1, 2)), np.rint(goals * side).astype(int)])


def visit_counts(episodes: Episode, maze: np.ndarray, start: Cell) -> np.ndarray:
    """The mean number of visits to each cell per episode of a batch, including the start."""
    goals = np.asarray(episodes.trajectory.achieved_goals)
    happened = np.arange(goals.shape[1]) < np.asarray(episodes.trajectory.length)[:, None]
    counts = reached_counts(goals[happened], maze)
    counts[tuple(start)] += len(goals)
    return counts / len(goals)


def shortest_path(maze: np.ndarray, start: Cell, goal: Cell, walk: np.ndarray) -> np.ndarray:
    """The cells ``[n, 2]`` of a shortest path that follows a walk where it can; the start alone if there is
    no path."""
    left = np.asarray(distances(jnp.asarray(maze) == 0, jnp.asarray(goal)))
    walked = {tuple(cell) for cell in np.asarray(walk).tolist()}
    path = [(int(start[0]), int(start[1]))]
    while left[path[-1]] > 0:
        row, column = path[-1]
        near = [(row + down, column + right) for down, right in MOVES]
        inside = [cell for cell in near if min(cell) >= 0 and max(cell) < len(left)]
        closer = [cell for cell in inside if left[cell] == left[row, column] - 1]
        path.append(max(closer, key=lambda cell: cell in walked))
    return np.array(path)


def reached_counts(goals: np.ndarray, maze: np.ndarray) -> np.ndarray:
    """The number of times that each cell is among goals ``[n, 2]`` that were reached."""
    counts = np.zeros(maze.shape)
    np.add.at(counts, tuple(np.rint(np.asarray(goals) * len(maze)).astype(int).T), 1.0)
    return counts


def visit_norm(*visits: np.ndarray) -> PowerNorm:
    """A color scale that several pictures can share, with more contrast among low counts."""
    top = max((float(np.max(counts)) for counts in visits), default=0.0)
    return PowerNorm(gamma=0.5, vmin=0.0, vmax=top if top > 0 else 1.0)


def visit_scale(norm: PowerNorm) -> ScalarMappable:
    """The argument of ``Figure.colorbar`` for the colors of visits."""
    return ScalarMappable(norm, VISIT_COLORS)


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
    shortest: np.ndarray | None = None,
) -> None:
    """Draw a maze with its start S and its task goal T, and prompts, visits and paths in it.

    Args:
      ax: the axes to draw on; their ticks and frame are removed.
      maze: ``[side, side]``, 1 is a wall.
      start: the cell of the start.
      goal: the cell of the task goal.
      prompt_goals: ``[k, 2]`` goals of a prompt in goal units, which are numbered in order, or several
        prompts by color. In a large maze they are dots, joined in order unless a path is drawn. A last goal
        at T is not drawn again; goals outside of the maze are drawn in a bar on the right.
      visits: ``[side, side]`` number of visits to each cell; darker is more.
      paths: ``[T, 2]`` cells of walks, drawn as lines.
      norm: color scale of ``visits`` [their own range].
      lanes: number of lanes of the bar, to align pictures in a row [as many as needed].
      shortest: ``[n, 2]`` cells of a shortest path, drawn as a dashed line above the others.
    """
    maze = np.asarray(maze)
    side = len(maze)
    prompts = _by_color(prompt_goals)
    lanes = bar_lanes(side, prompts.values()) if lanes is None else lanes

    ax.imshow(_cell_colors(maze, visits, norm), interpolation="nearest", zorder=0)
    paths = list(paths or ())
    for path in paths:
        rows, columns = np.asarray(path, float).reshape(-1, 2).T
        ax.plot(
            columns, rows, color=AGENT_COLOR, linewidth=1.4, zorder=1, path_effects=SEEN_ON_DARK
        )
    if shortest is not None:
        rows, columns = shortest.T
        ax.plot(
            columns, rows, color=SHORTEST_COLOR, linewidth=1.1, linestyle=(0, (2, 2)), zorder=1.2
        )
    draw_markers(ax, side, start, goal, prompts, lanes, joined=not paths)

    right = picture_width(side, lanes) - 0.5
    ax.set(xlim=(-0.5, right), ylim=(side - 0.5, -0.5), xticks=[], yticks=[], aspect="equal")
    ax.set_frame_on(False)


def maze_gif(
    path: Path, maze: np.ndarray, start: Cell, goal: Cell, panels: Sequence[Panel]
) -> None:
    """Write a short GIF of episodes in one maze; those that end earlier stop at their end."""
    side = len(maze)
    prompts = [panel.prompt_goals for panel in panels if panel.prompt_goals is not None]
    lanes = max((bar_lanes(side, [goals]) for goals in prompts), default=0)
    width = picture_width(side, lanes) / side
    figure, axes = axes_in_a_row([panel.title for panel in panels], 3.0 * width, 3.0)
    moving = []
    for ax, panel in zip(axes, panels, strict=True):
        draw_maze(ax, maze, start, goal, panel.prompt_goals, lanes=lanes)
        (trail,) = ax.plot([], [], color=AGENT_COLOR, alpha=0.6, linewidth=2.5, zorder=1.5)
        agent = Circle((0, 0), 0.36 * marker_size(side), facecolor=AGENT_COLOR, edgecolor="white")
        agent.set(zorder=9)
        ax.add_patch(agent)
        moving.append((panel.walk, trail, agent))

    def show(time: int) -> None:
        for walk, trail, agent in moving:
            rows, columns = walk[: time + 1].T
            trail.set_data(columns, rows)
            agent.center = (columns[-1], rows[-1])

    write_gif(path, figure, show, max(len(panel.walk) for panel in panels))


def _by_color(prompts: np.ndarray | Mapping[str, np.ndarray] | None) -> Mapping[str, np.ndarray]:
    if prompts is None:
        return {}
    return prompts if isinstance(prompts, Mapping) else {PROMPT_COLOR: np.asarray(prompts)}


def _cell_colors(maze: np.ndarray, visits: np.ndarray | None, norm: PowerNorm | None) -> np.ndarray:
    colors = np.empty((*maze.shape, 3))
    colors[:] = to_rgb(FREE_COLOR)
    if visits is not None:
        norm = visit_norm(visits) if norm is None else norm
        visited = visits > 0
        colors[visited] = VISIT_COLORS(norm(visits[visited]))[:, :3]
    colors[maze != 0] = to_rgb(WALL_COLOR)
    return colors
