"""The worlds: ``make("maze15")`` and the names it knows."""

from __future__ import annotations

import difflib
from collections.abc import Callable

from envs.base import Environment, EnvSpec, TimeStep
from envs.grid_world import GridWorld
from envs.maze_runner import MazeRunner

__all__ = ["ENVIRONMENTS", "EnvSpec", "Environment", "TimeStep", "make"]

# The paper's sizes 15 and 30; walls lie on even cells, so a side is odd: 15 and 31.
ENVIRONMENTS: dict[str, Callable[[], Environment]] = {
    "maze15": lambda: MazeRunner(name="maze15", side=15, horizon=64),
    "maze30": lambda: MazeRunner(name="maze30", side=31, horizon=500),
    "gridworld": lambda: GridWorld(name="gridworld", horizon=90),
}


def make(name: str) -> Environment:
    """The world of that name; ``ValueError`` with the nearest name for one that does not exist."""
    if name not in ENVIRONMENTS:
        near = difflib.get_close_matches(name, ENVIRONMENTS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"unknown environment {name!r}{hint} (known: {', '.join(ENVIRONMENTS)})")
    return ENVIRONMENTS[name]()
