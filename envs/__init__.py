"""The worlds: ``make("maze15")`` and the names it knows."""

from __future__ import annotations

import difflib
from collections.abc import Callable

from envs.base import Environment, EnvSpec, TimeStep
from envs.grid_world import GridWorld
from envs.maze_runner import MazeRunner

__all__ = ["ENVIRONMENTS", "EnvSpec", "Environment", "TimeStep", "make"]


def _kitchen(backend: str = "auto", model: str = "reduced") -> Environment:
    from envs.kitchen import Kitchen, import_mujoco

    import_mujoco()  # complains here, not in the middle of a program
    name = "kitchen-stock" if model == "stock" else "kitchen"
    return Kitchen(name=name, horizon=500, backend=backend, model=model)


# The paper's sizes 15 and 30; walls lie on even cells, so a side is odd: 15 and 31.
ENVIRONMENTS: dict[str, Callable[[], Environment]] = {
    "maze15": lambda: MazeRunner(name="maze15", side=15, horizon=64),
    "maze30": lambda: MazeRunner(name="maze30", side=31, horizon=500),
    "gridworld": lambda: GridWorld(name="gridworld", horizon=90),
    "kitchen": _kitchen,
    # The engine chosen by hand; policies, tasks and datasets are those of kitchen.
    "kitchen-mjx": lambda: _kitchen("mjx"),
    "kitchen-native": lambda: _kitchen("native"),
    # The same tasks in the full scene: a world of its own.
    "kitchen-stock": lambda: _kitchen("native", "stock"),
}


def make(name: str) -> Environment:
    """The world of that name.

    Raises:
      ValueError: with the nearest name, for one that does not exist.
      ImportError: for a world whose optional packages or libraries are missing, with the way to get them.
    """
    if name not in ENVIRONMENTS:
        near = difflib.get_close_matches(name, ENVIRONMENTS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"unknown environment {name!r}{hint} (known: {', '.join(ENVIRONMENTS)})")
    return ENVIRONMENTS[name]()
