"""PointMaze of gymnasium-robotics: push a ball through a maze by forces, to a given position."""

from __future__ import annotations

import gymnasium
import gymnasium_robotics
import numpy as np

from envs.gymnasium_world import GymnasiumWorld

gymnasium.register_envs(gymnasium_robotics)


def make():
    return gymnasium.make("PointMaze_Medium-v3", continuing_task=False, max_episode_steps=480)


def wanderer(env, rng):
    """Rolls from cell to cell at random, and turns back only at dead ends."""
    maze = env.unwrapped.maze
    free = {tuple(cell) for cell in np.argwhere(np.array(maze.maze_map) != 1)}
    start = tuple(maze.cell_xy_to_rowcol(env.unwrapped.point_env.data.qpos[:2]))
    way = [start, start]  # the cell that the ball comes from, and the one that it rolls to

    def act(moment):
        place, speed = moment.obs["observation"][:2], moment.obs["observation"][2:]
        if np.linalg.norm(maze.cell_rowcol_to_xy(way[1]) - place) < 0.3:
            row, column = way[1]
            near = [(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)]
            on = [cell for cell in near if cell in free]
            on = [cell for cell in on if cell != way[0]] or on
            way[:] = way[1], on[rng.integers(len(on))]
        return np.clip(4 * (maze.cell_rowcol_to_xy(way[1]) - place) - 1.5 * speed, -1, 1)

    return act


WORLD = GymnasiumWorld(
    name="point-maze",
    make=make,
    return_range=(0.0, 1.0),
    repeat=8,
    scripts={"wanderer": wanderer},
    truncate_in_hindsight=True,
).world(
    summary="a ball in the medium maze of gymnasium-robotics",
    presets={
        "fast": {
            "trajectories": 2_000, "steps": 1_000, "embed_dim": 64, "num_layers": 2, "num_heads": 2,
            "tokens_per_step": 1, "max_prompt_length": 5, "bucket": 20, "eval_tasks": 16,
            "eval_every": 500, "warmup_steps": 100,
        }
    },
    num_test_tasks=20,
)  # fmt: skip
