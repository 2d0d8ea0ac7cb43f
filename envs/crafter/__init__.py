"""Crafter: 22 achievements in generated worlds. Nothing here imports jax or craftax."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from envs.crafter.extra import check_extra
from envs.registry import Encoder, Judgement, World

if TYPE_CHECKING:
    from flax.linen import Module
    from jaxtyping import Array

    from envs.agents import Demonstrator
    from envs.crafter.env import Crafter
    from envs.drawing import Pictures
    from envs.page import Page
    from envs.specs import ObsLayout

__all__ = [
    "CRAFTER",
    "CRAFTER_MAP",
    "CRAFTER_SYMBOLIC",
    "PICTURE",
    "check_extra",
]

HORIZON = 500


def make(name: str = "crafter-symbolic", places: bool = False) -> Crafter:
    """The environment of Crafter. With ``places``, goals include where their achievements were unlocked.

    Raises:
      MissingExtraError: if craftax is missing or too old.
    """
    check_extra()  # raises errors now rather than while a program is traced
    from envs.crafter.env import Crafter

    return Crafter(name=name, horizon=HORIZON, places=places)


def make_seen() -> Crafter:
    return make("crafter")


def make_map() -> Crafter:
    return make("crafter-map", places=True)


def load_demonstrators(env: Crafter) -> Mapping[str, Demonstrator]:
    from envs.crafter.demonstrators import crafter_demonstrators

    return crafter_demonstrators(env)


def load_pictures(env: Crafter) -> Pictures:
    from envs.crafter.pictures import crafter_pictures

    return crafter_pictures(env)


def load_page(env: Crafter) -> Page:
    from envs.crafter.page import crafter_page

    return crafter_page(env)


def make_encoder(obs_shape: tuple[int, ...], width: int, layout: ObsLayout | None) -> Module:
    """The encoder that is a linear layer on Crafter's picture, computed from the codes.

    Raises:
      MissingExtraError: if Crafter's textures are missing.
    """
    check_extra()
    from envs.crafter.encoding import Picture

    return Picture(width)


def encoder_fault(layout: ObsLayout, shape: tuple[int, ...]) -> str | None:
    """What is wrong with observations that must be exactly Crafter's codes; None if nothing is."""
    check_extra()
    from envs.crafter.view import LAYOUT, OBS_SIZE

    if layout != LAYOUT:
        return f"must be that of Crafter's codes, found {layout}"
    if shape != (OBS_SIZE,):
        return f"must be of {OBS_SIZE} numbers, all that a picture shows, found {list(shape)}"
    return None


def prepare_encoder(params: Mapping[str, Array]) -> dict[str, Array]:
    """The parameters of ``make_encoder``'s module, multiplied with all tiles that it may be shown."""
    from envs.crafter.encoding import prepared

    return prepared(params)


PICTURE = Encoder(
    name="crafter-picture",
    make=make_encoder,
    uses_layout=True,
    fault=encoder_fault,
    prepare=prepare_encoder,
)

PRESETS = {
    # Prompts have room for one goal per achievement, and the task goal.
    "fast": {
        "steps": 8_000,
        "trajectories": 12_000,
        "batch_size": 16,
        "part_steps": 2_048,
        "max_prompt_length": 23,
        "bucket": 32,
        "tokens_per_step": 1,
    },
    "paper": {"steps": 50_000, "trajectories": 2_000, "max_prompt_length": 23, "bucket": 32},
}

CRAFTER_SYMBOLIC = World(
    name="crafter-symbolic",
    make=make,
    summary="22 achievements in a generated world, seen as the codes of what is in view",
    extra="crafter",
    demonstrators=load_demonstrators,
    presets={name: {**preset, "encoder": "cells"} for name, preset in PRESETS.items()},
    pictures=load_pictures,
    page=load_page,
    # Searches act with sampled actions, so policies are judged by them, too; greedy actions return about
    # the same (docs/environments.md). Returns vary with what the mobs do, hence several episodes.
    judged=Judgement(mode="sample", temperature=1.0, episodes=16),
    # Approximately the standard deviation of the returns of one prompt. With the default unit, the range of
    # all returns (22.9), exploration would be seven times as strong.
    method_defaults={"ucb": {"scale": 3.0}},
)

CRAFTER_MAP = replace(
    CRAFTER_SYMBOLIC,
    name="crafter-map",
    make=make_map,
    summary="22 achievements in a generated world, seen as codes; goals also say where they were unlocked",
)

CRAFTER = replace(
    CRAFTER_SYMBOLIC,
    name="crafter",
    make=make_seen,
    summary="22 achievements in a generated world, seen as Crafter's picture of 64 x 64 pixels",
    # Datasets hold the codes from which the picture is drawn; the encoder computes with the picture.
    presets={name: {**preset, "encoder": "crafter-picture"} for name, preset in PRESETS.items()},
)
