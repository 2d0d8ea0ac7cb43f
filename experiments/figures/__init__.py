"""The figures, as functions of results and policies: curves of every world, pictures of some."""

from __future__ import annotations

from envs.base import Environment
from envs.grid_world import GridWorld
from envs.kitchen import Kitchen
from envs.maze_runner import MazeRunner
from experiments.figures.base import NO_PICTURES, Pictures
from experiments.figures.curves import learning_curve, training_curve
from experiments.figures.grid import grid_pictures
from experiments.figures.kitchen import kitchen_pictures
from experiments.figures.maze import maze_pictures
from experiments.figures.style import METHODS, STYLE, method_styles

__all__ = [
    "METHODS",
    "STYLE",
    "Pictures",
    "learning_curve",
    "method_styles",
    "pictures",
    "training_curve",
]


def pictures(env: Environment) -> Pictures:
    """What a world draws beside curves; some worlds draw nothing."""
    if isinstance(env, MazeRunner):
        return maze_pictures(env)
    if isinstance(env, GridWorld):
        return grid_pictures(env)
    if isinstance(env, Kitchen):
        return kitchen_pictures(env)
    return NO_PICTURES
