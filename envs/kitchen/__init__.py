"""Franka Kitchen: a robot arm opens doors and turns switches in an order that it is not told."""

from __future__ import annotations

from envs.kitchen.extra import MissingExtraError, NoOpenGLError, check_extra, import_mujoco
from envs.kitchen.world import NONE, SUBTASKS, Kitchen, KitchenState, KitchenTask

__all__ = [
    "NONE",
    "SUBTASKS",
    "Kitchen",
    "KitchenState",
    "KitchenTask",
    "MissingExtraError",
    "NoOpenGLError",
    "check_extra",
    "import_mujoco",
]
