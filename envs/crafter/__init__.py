"""Crafter: 22 achievements in generated worlds. Nothing here imports jax or craftax."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from envs.crafter.extra import MissingExtraError, check_extra
from envs.registry import Judgement, World

if TYPE_CHECKING:
    from envs.base import Demonstrator
    from envs.crafter.env import Crafter
    from envs.drawing import Pictures

__all__ = ["CRAFTER", "CRAFTER_SYMBOLIC", "MissingExtraError", "check_extra"]

HORIZON = 500


def make(name: str = "crafter-symbolic", pixels: bool = False) -> Crafter:
    """Crafter, observed as the codes of what is drawn, or as the ``pixels`` of the picture.

    Raises:
      MissingExtraError: if craftax is missing or too old.
    """
    check_extra()  # complains now and not in the middle of a program
    from envs.crafter.env import Crafter

    return Crafter(name=name, horizon=HORIZON, pixels=pixels)


def make_pixels() -> Crafter:
    return make("crafter", pixels=True)


def load_demonstrators(env: Crafter) -> Mapping[str, Demonstrator]:
    from envs.crafter.demonstrators import crafter_demonstrators

    return crafter_demonstrators(env)


def load_pictures(env: Crafter) -> Pictures:
    from envs.crafter.pictures import crafter_pictures

    return crafter_pictures(env)


PRESETS = {
    # As many goals as there are achievements, and the task goal.
    "fast": {"max_prompt_length": 23, "bucket": 32, "tokens_per_step": 1},
    "paper": {"trajectories": 2_000, "max_prompt_length": 23, "bucket": 32},
}

CRAFTER_SYMBOLIC = World(
    name="crafter-symbolic",
    make=make,
    summary="22 achievements in a generated world, seen as the codes of what is in view",
    demonstrators=load_demonstrators,
    presets={name: {**preset, "encoder": "cells"} for name, preset in PRESETS.items()},
    pictures=load_pictures,
    # Greedy actions get stuck, and one return says little: mobs make it vary.
    judged=Judgement(mode="sample", temperature=1.0, episodes=16),
    # The spread of the returns of one prompt, of which the range of all returns is seven times as much.
    method_defaults={"ucb": {"scale": 3.0}},
)

CRAFTER = replace(
    CRAFTER_SYMBOLIC,
    name="crafter",
    make=make_pixels,
    summary="22 achievements in a generated world, seen as a picture of 64 x 64 pixels",
    presets=PRESETS,
)
