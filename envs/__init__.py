"""The worlds.

``envs.make("maze15")`` builds one, ``envs.names()`` lists them, and ``envs.check_world(world)`` checks one
of your own.

Importing this package does not import jax; the records of an episode are loaded when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from envs.compiler import avoid_fault
from envs.registry import Judgement, World, find, make, names, register

if TYPE_CHECKING:
    from envs.agents import Agent, Demonstrator
    from envs.base import Environment, Episode, TimeStep, Trajectory
    from envs.checks import check_world
    from envs.specs import ArraySpec, Box, Discrete, Engine, EnvSpec

avoid_fault()

__all__ = [
    "Agent",
    "ArraySpec",
    "Box",
    "Demonstrator",
    "Discrete",
    "Engine",
    "EnvSpec",
    "Environment",
    "Episode",
    "Judgement",
    "TimeStep",
    "Trajectory",
    "World",
    "check_world",
    "find",
    "make",
    "names",
    "register",
]


_PLACE_OF = {
    "Agent": "envs.agents",
    "ArraySpec": "envs.specs",
    "Box": "envs.specs",
    "Demonstrator": "envs.agents",
    "Discrete": "envs.specs",
    "Engine": "envs.specs",
    "EnvSpec": "envs.specs",
    "Environment": "envs.base",
    "Episode": "envs.base",
    "TimeStep": "envs.base",
    "Trajectory": "envs.base",
    "check_world": "envs.checks",
}
"""Names that are loaded when they are first used, and their modules."""


def __getattr__(name: str) -> Any:
    if name not in _PLACE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PLACE_OF[name]), name)
