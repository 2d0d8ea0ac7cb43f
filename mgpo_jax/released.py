"""The location of released policies and test tasks. Nothing here imports jax."""

from __future__ import annotations

from pathlib import Path

from envs.registry import World
from mgpo_jax.kinds import MULTI_GOAL

RELEASED = Path(__file__).parent / "pretrained"


def released_folder(world: World, kind: str = MULTI_GOAL) -> Path:
    """The folder of the released policy and the test tasks of a world, or of its network of another
    kind."""
    home = RELEASED / world.home
    return home if kind == MULTI_GOAL else home / kind
