"""What the worlds of a page bring to it."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from envs.base import Task
from envs.page import Page
from envs.registry import World
from mgpo_jax.tasks import num_tasks, task_at


def page_of(world: World) -> Page:
    """What a world brings to pages; an empty record for a world that brings nothing."""
    return Page() if world.page is None else world.page(world.make())


def tasks_in_page(page: Page, tasks: Task) -> list[dict[str, Any]]:
    """N stacked tasks: what the world's script knows of each, and each in a few words."""
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
