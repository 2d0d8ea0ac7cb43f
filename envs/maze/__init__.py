"""MazeRunner in the paper's two sizes. Nothing here imports jax."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from envs.registry import StepCost, World

if TYPE_CHECKING:
    from envs.agents import Demonstrator
    from envs.drawing import Pictures
    from envs.maze.env import MazeRunner
    from envs.page import Page

__all__ = ["MAZE15", "MAZE30"]


def make15() -> MazeRunner:
    from envs.maze.env import MazeRunner

    return MazeRunner(name="maze15", side=15, horizon=64)


def make30() -> MazeRunner:
    """The paper calls its size 30; the side is 31, since walls are on even cells and a side is therefore
    odd."""
    from envs.maze.env import MazeRunner

    return MazeRunner(name="maze30", side=31, horizon=500)


def load_demonstrators(env: MazeRunner) -> Mapping[str, Demonstrator]:
    from envs.maze.demonstrators import maze_demonstrators

    return maze_demonstrators(env)


def load_pictures(env: MazeRunner) -> Pictures:
    from envs.maze.pictures import maze_pictures

    return maze_pictures(env)


def load_page(env: MazeRunner) -> Page:
    from envs.maze.page import maze_page

    return maze_page(env)


MAZE15 = World(
    name="maze15",
    make=make15,
    summary="MazeRunner: find a goal in an unknown maze of 15 x 15 cells within 64 steps",
    demonstrators=load_demonstrators,
    presets={
        # A policy soon overfits 10,000 trajectories, but not 100,000, which take a minute to collect.
        "fast": {"steps": 8_000, "trajectories": 100_000},
        "paper": {"steps": 50_000, "trajectories": 10_000},  # steps as in the authors' code
        "ablation": {"steps": 2_000, "trajectories": 10_000},
    },
    pictures=load_pictures,
    page=load_page,
    step_cost=StepCost(step=0.1, arrival=1.0, horizon=64),
)

MAZE30 = World(
    name="maze30",
    make=make30,
    summary="MazeRunner: find a goal in an unknown maze of 31 x 31 cells within 500 steps",
    demonstrators=load_demonstrators,
    presets={
        "fast": {
            "steps": 5_000,
            "trajectories": 30_000,
            "max_prompt_length": 20,
            "bucket": 32,
            "demonstrator": "astar2",
            "save_every": 250,
        },
        "paper": {"steps": 200_000, "trajectories": 10_000, "bucket": 32},
        "ablation": {"steps": 1_000, "trajectories": 10_000},
    },
    pictures=load_pictures,
    page=load_page,
    step_cost=StepCost(step=0.1, arrival=1.0, horizon=500),
)
