"""Franka Kitchen: a robot arm opens doors and turns switches in an order that it is not told."""

from __future__ import annotations

from envs.kitchen.extra import MissingExtraError, check_extra
from envs.kitchen.world import NONE, SUBTASKS, Kitchen, KitchenState, KitchenTask

__all__ = [
    "NONE",
    "SUBTASKS",
    "Kitchen",
    "KitchenState",
    "KitchenTask",
    "MissingExtraError",
    "check_extra",
]
