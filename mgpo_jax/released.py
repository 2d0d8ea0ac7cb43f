"""Where the released policies and test tasks of the worlds lie. Nothing here imports jax."""

from __future__ import annotations

from pathlib import Path

from envs.registry import World

RELEASED = Path(__file__).parent / "pretrained"


def released_folder(world: World) -> Path:
    """Where the released policy and the test tasks of a world lie."""
    return RELEASED / world.home
