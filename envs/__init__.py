"""The worlds.

``envs.make("maze15")`` builds one, ``envs.names()`` lists them, and ``envs.check_world(world)`` checks one
of your own.

Importing this package does not import jax; the records of an episode are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from envs.compiler import avoid_fault
from envs.registry import Judgement, World, find, make, names, register

if TYPE_CHECKING:
    from envs.base import (
        Agent,
        ArraySpec,
        Box,
        Demonstrator,
        Discrete,
        Engine,
        Environment,
        EnvSpec,
        Episode,
        TimeStep,
        Trajectory,
    )
    from envs.checks import check_world

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


def __getattr__(name: str) -> Any:
    if name == "check_world":
        from envs.checks import check_world

        return check_world
    if name in __all__:
        from envs import base

        return getattr(base, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
