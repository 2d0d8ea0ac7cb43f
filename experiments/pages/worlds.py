"""What worlds contribute to pages."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from envs.base import Task
from envs.page import Page
from envs.registry import World
from mgpo_jax.tasks import num_tasks, task_at


def page_of(world: World) -> Page:
    """The ``Page`` record of a world; an empty record for a world without one."""
    return Page() if world.page is None else world.page(world.make())


def tasks_in_page(page: Page, tasks: Task) -> list[dict[str, Any]]:
    """Tasks as JSON values: for each the data for the world's script, and a short description."""
    rows = []
    for index in range(num_tasks(tasks)):
        one = jax.tree.map(np.asarray, task_at(tasks, index))
        rows.append(
            {
                "task": page.task(one) if page.task else None,
                "text": page.describe(one) if page.describe else "",
            }
        )
    return rows
