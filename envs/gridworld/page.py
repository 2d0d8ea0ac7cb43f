"""GridWorld's part of HTML pages."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from envs.base import Task
from envs.gridworld.env import LETTERS, MIN_SUBTASKS, NONE, NUM_OBJECTS, OBJECTS, SIDE, GridWorld
from envs.page import Page


def grid_page(env: GridWorld) -> Page:
    """The rules of the world, and the drawing of the grid with its objects."""
    return Page(
        script=Path(__file__).with_name("page.js"),
        facts={
            "side": SIDE,
            "horizon": env.horizon,
            "objects": [list(place) for place in OBJECTS],
            "letters": LETTERS,
            "fewest": MIN_SUBTASKS,
        },
        task=order_of,
        start=lambda obs: [int(number) for number in obs[NUM_OBJECTS:]],
        describe=lambda task: "order " + "".join(LETTERS[thing] for thing in order_of(task)),
        parts=tuple(LETTERS),
    )


def order_of(task: Task) -> list[int]:
    """The objects of a task, in order."""
    return [int(thing) for thing in np.asarray(task.order) if thing != NONE]
