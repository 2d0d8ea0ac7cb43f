"""Demonstrators: the policies that datasets are collected with."""

from __future__ import annotations

from envs.base import Demonstrator, Environment
from envs.experts.grid import grid_demonstrators
from envs.experts.maze import maze_demonstrators
from envs.grid_world import GridWorld
from envs.kitchen.world import Kitchen
from envs.maze_runner import MazeRunner

__all__ = ["demonstrators"]


def demonstrators(env: Environment) -> dict[str, Demonstrator]:
    """The demonstrators of a world by name, the one of the paper's main results first."""
    if isinstance(env, MazeRunner):
        known = maze_demonstrators(env)
        return {"astar4": known["astar4"], **known}
    if isinstance(env, GridWorld):
        return grid_demonstrators(env)
    if isinstance(env, Kitchen):
        from envs.experts.kitchen import kitchen_demonstrators

        return kitchen_demonstrators(env)
    raise TypeError(f"no demonstrators for {type(env).__name__}")
