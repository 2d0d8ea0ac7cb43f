"""MazeRunner's part of HTML pages."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from envs.base import Task
from envs.maze.env import GOAL_REWARD, STEP_PENALTY, MazeRunner
from envs.page import Page


def maze_page(env: MazeRunner) -> Page:
    """The rules of the world, and the drawing of mazes with visits and paths."""
    return Page(
        script=Path(__file__).with_name("page.js"),
        facts={
            "side": env.side,
            "horizon": env.horizon,
            "start": list(env.start),
            "stepPenalty": STEP_PENALTY,
            "goalReward": GOAL_REWARD,
        },
        task=task_of,
        describe=describe,
    )


def task_of(task: Task) -> dict[str, object]:
    """A maze as rows of ``#`` (wall) and ``.``, and its goal."""
    rows = ["".join("#" if cell else "." for cell in row) for row in np.asarray(task.maze)]
    return {"rows": rows, "goal": [int(number) for number in task.goal]}


def describe(task: Task) -> str:
    row, column = (int(number) for number in task.goal)
    return f"goal at row {row}, column {column}"
