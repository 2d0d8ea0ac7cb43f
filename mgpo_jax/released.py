"""Where the released policies and test tasks of the worlds lie. Nothing here imports jax."""

from __future__ import annotations

from pathlib import Path

from envs.registry import World
from mgpo_jax.kinds import MULTI_GOAL

RELEASED = Path(__file__).parent / "pretrained"


def released_folder(world: World, kind: str = MULTI_GOAL) -> Path:
    """Where the released policy and the test tasks of a world lie, or its network of another kind."""
    home = RELEASED / world.home
    return home if kind == MULTI_GOAL else home / kind
