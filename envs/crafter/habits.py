"""How a demonstrator of Crafter behaves, and the plan that it draws for an episode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from craftax.craftax_classic.constants import Achievement
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from envs.crafter.view import NUM_ACHIEVEMENTS

# The usual place of each achievement in an order; the order of an episode adds noise to it.
TIERS: Mapping[Achievement, float] = {
    Achievement.COLLECT_WOOD: 0.0,
    Achievement.COLLECT_SAPLING: 1.0,
    Achievement.PLACE_TABLE: 1.2,
    Achievement.PLACE_PLANT: 1.5,
    Achievement.EAT_COW: 2.0,
    Achievement.COLLECT_DRINK: 2.0,
    Achievement.MAKE_WOOD_PICKAXE: 2.0,
    Achievement.WAKE_UP: 2.0,
    Achievement.MAKE_WOOD_SWORD: 2.2,
    Achievement.DEFEAT_ZOMBIE: 2.5,
    Achievement.COLLECT_STONE: 2.5,
    Achievement.PLACE_STONE: 3.2,
    Achievement.MAKE_STONE_PICKAXE: 3.5,
    Achievement.COLLECT_COAL: 3.5,
    Achievement.MAKE_STONE_SWORD: 3.7,
    Achievement.PLACE_FURNACE: 4.0,
    Achievement.COLLECT_IRON: 4.5,
    Achievement.DEFEAT_SKELETON: 5.0,
    Achievement.MAKE_IRON_PICKAXE: 5.5,
    Achievement.MAKE_IRON_SWORD: 6.0,
    Achievement.COLLECT_DIAMOND: 7.0,
    Achievement.EAT_PLANT: 8.0,
}


RANGES = {
    "drop": (0, 0.5), "shuffle": (0, 100), "opportunism": (0, 1), "shelter": (0, 1), "dusk": (0, 1),
    "detour": (0, 80), "noise": (0, 0.5), "longest_run": (1, 100), "whole_map": (0, 1),
}  # fmt: skip
"""The smallest and the largest value of each habit."""


@dataclass(frozen=True)
class Habits:
    """The behavior of a demonstrator.

    Attributes:
      drop: fraction of the achievements that are omitted in an episode, on average. Each episode draws its
        own fraction between 0 and twice this number.
      shuffle: standard deviation of an achievement's place in the order, in tiers.
      opportunism: how strongly an achievement that is possible nearby is preferred to the order; 0 keeps
        strictly to the order.
      shelter: whether to dig a shelter for the night.
      dusk: the light below which it does so.
      detour: number of steps by which a known place may be farther away than unknown cells.
      noise: probability that a run of random actions starts at a step, on average. Each episode draws its
        own probability between 0 and twice this number.
      longest_run: largest number of random actions in a run.
      whole_map: fraction of the episodes in which it knows the map from the start.
    """

    drop: float = 0.45
    shuffle: float = 2.0
    opportunism: float = 0.6
    shelter: bool = True
    dusk: float = 0.5
    detour: int = 12
    noise: float = 0.05
    longest_run: int = 4
    whole_map: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} must be from {low:g} to {high:g}, found {value:g}")


class Plan(NamedTuple):
    """The plan of an episode: which achievements to pursue, and in which order."""

    places: Float[Array, "22"]
    """The place of each achievement in the order; the smallest comes first."""
    wanted: Bool[Array, "22"]


def make_plan(key: PRNGKeyArray, habits: Habits) -> Plan:
    """Draw the order of an episode and the achievements that it omits."""
    key_order, key_drop, key_share = jax.random.split(key, 3)
    tiers = jnp.array([TIERS[achievement] for achievement in Achievement])
    share = 2 * habits.drop * jax.random.uniform(key_share)
    return Plan(
        places=tiers + habits.shuffle * jax.random.normal(key_order, (NUM_ACHIEVEMENTS,)),
        wanted=jax.random.uniform(key_drop, (NUM_ACHIEVEMENTS,)) >= share,
    )
