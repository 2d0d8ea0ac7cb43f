"""GridWorld: switch on objects in a hidden order. Nothing here imports jax."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from envs.registry import Judgement, World

if TYPE_CHECKING:
    from envs.agents import Demonstrator
    from envs.drawing import Pictures
    from envs.gridworld.env import GridWorld
    from envs.page import Page

__all__ = ["GRIDWORLD"]


def make() -> GridWorld:
    from envs.gridworld.env import GridWorld

    return GridWorld(name="gridworld", horizon=90)


def load_demonstrators(env: GridWorld) -> Mapping[str, Demonstrator]:
    from envs.gridworld.demonstrators import grid_demonstrators

    return grid_demonstrators(env)


def load_pictures(env: GridWorld) -> Pictures:
    from envs.gridworld.pictures import grid_pictures

    return grid_pictures(env)


def load_page(env: GridWorld) -> Page:
    from envs.gridworld.page import grid_page

    return grid_page(env)


GRIDWORLD = World(
    name="gridworld",
    make=make,
    summary="switch on 3 to 7 objects on a 10 x 10 grid in a hidden order",
    demonstrators=load_demonstrators,
    presets={
        # Each of the 13,600 training tasks five times.
        "fast": {"steps": 3_000, "trajectories": 68_000, "max_prompt_length": 8, "bucket": 8},
        "paper": {"steps": 50_000, "trajectories": 13_600, "max_prompt_length": 8, "bucket": 8},
    },
    pictures=load_pictures,
    page=load_page,
    # Episodes start on a random cell, so a single return says little about a prompt.
    judged=Judgement(mode="greedy", episodes=10),
)
