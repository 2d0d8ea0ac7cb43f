"""The kitchen's part of HTML pages: only names, since its physics cannot be simulated in a page."""

from __future__ import annotations

import numpy as np

from envs.base import Task
from envs.kitchen.env import NONE, SUBTASKS, Kitchen
from envs.page import Page


def kitchen_page(env: Kitchen) -> Page:
    """The names of the subtasks, which are the same for all engines."""
    del env
    return Page(describe=describe, parts=SUBTASKS)


def describe(task: Task) -> str:
    order = [SUBTASKS[subtask] for subtask in np.asarray(task.order) if subtask != NONE]
    return f"order {', '.join(order)}"
