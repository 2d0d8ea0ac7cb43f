"""The errands of Crafter's achievements: where to go and what to do there, according to the recipes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from craftax.craftax_classic.constants import Achievement, Action, BlockType
from jaxtyping import Array, Bool, Float, Int

from envs.crafter.habits import Habits, Plan
from envs.crafter.rules import FURNACE_STONES
from envs.crafter.scenes import FAR, HALF_VIEW, WALKABLE, Scene
from envs.crafter.searching import (
    Board,
    around,
    rectangle,
)
from envs.crafter.view import NUM_BLOCKS

TABLE_WOOD = 2  # wood for a table, in Craftax and in Crafter 1.8.3
NEVER = 1000.0  # place in the order of an achievement that is impossible at present

# The place of an errand is a number. The first 17 are kinds of blocks, by code, and the next three are
# kinds of mobs: the agent walks next to one of them and faces it. The others are cells that it walks onto.
COW, ZOMBIE, SKELETON = range(NUM_BLOCKS, NUM_BLOCKS + 3)
AT_TABLE, AT_WORKSHOP, DEN = range(NUM_BLOCKS + 3, NUM_BLOCKS + 6)
ANYWHERE = NUM_BLOCKS + 6  # explore
HERE = NUM_BLOCKS + 7  # act at once
FREE, SOIL = NUM_BLOCKS + 8, NUM_BLOCKS + 9  # face a free cell, or grass, and place something


class Errand(NamedTuple):
    """Go to a kind of place and act there."""

    place: Int[Array, ""]
    act: Int[Array, ""]


def errand(place: int | BlockType, act: Action = Action.DO) -> Errand:
    kind = place.value if isinstance(place, BlockType) else place
    return Errand(jnp.asarray(kind, jnp.int32), jnp.asarray(act.value, jnp.int32))


def either(condition: Array, one: Errand, other: Errand) -> Errand:
    """``one`` if the condition holds, otherwise ``other``."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


class Surroundings(NamedTuple):
    """Facts about the agent's surroundings that several rules need."""

    table: Bool[Array, ""]
    """Whether a table is within reach, so that tools can be made."""
    furnace: Bool[Array, ""]
    table_near: Bool[Array, ""]
    """Whether a table is near enough to walk to it; otherwise placing a new one is better."""
    workshop: Board
    """The cells from which both a table and a furnace are within reach."""
    workshop_near: Bool[Array, ""]


def surroundings(scene: Scene) -> Surroundings:
    tables, furnaces = scene.of(BlockType.CRAFTING_TABLE), scene.of(BlockType.FURNACE)
    hand, near = rectangle(scene.here, 1, 1), rectangle(scene.here, 9, 9)
    workshop = around(tables) & around(furnaces) & scene.of(*WALKABLE)
    return Surroundings(
        table=jnp.any(tables & hand),
        furnace=jnp.any(furnaces & hand),
        table_near=jnp.any(tables & near),
        workshop=workshop,
        workshop_near=jnp.any(workshop & near),
    )


def plain_errands() -> dict[Achievement, Errand]:
    """The errands that need nothing in the inventory."""
    return {
        Achievement.COLLECT_WOOD: errand(BlockType.TREE),
        Achievement.EAT_COW: errand(COW),
        Achievement.COLLECT_SAPLING: errand(BlockType.GRASS),
        Achievement.COLLECT_DRINK: errand(BlockType.WATER),
        Achievement.DEFEAT_ZOMBIE: errand(ZOMBIE),
        Achievement.EAT_PLANT: errand(BlockType.RIPE_PLANT),
        Achievement.DEFEAT_SKELETON: errand(SKELETON),
        Achievement.WAKE_UP: errand(HERE, Action.SLEEP),
    }


def errands_of(scene: Scene, nearby: Surroundings) -> Errand:
    """The next errand for each achievement, ``[22]``, according to the recipes."""
    bag = scene.bag
    tree = errand(BlockType.TREE)

    def with_wood(number: int, then: Errand) -> Errand:
        return either(bag.wood >= number, then, tree)

    new_table = with_wood(TABLE_WOOD + 1, errand(FREE, Action.PLACE_TABLE))

    def at_table(then: Errand) -> Errand:
        return either(nearby.table, then, either(nearby.table_near, errand(AT_TABLE), new_table))

    wood_pickaxe = with_wood(1, at_table(errand(HERE, Action.MAKE_WOOD_PICKAXE)))
    wood_sword = with_wood(1, at_table(errand(HERE, Action.MAKE_WOOD_SWORD)))
    stone = either(bag.wood_pickaxe > 0, errand(BlockType.STONE), wood_pickaxe)
    coal = either(bag.wood_pickaxe > 0, errand(BlockType.COAL), wood_pickaxe)

    def with_stone(number: int, then: Errand) -> Errand:
        return either(bag.stone >= number, then, stone)

    def stone_tool(act: Action) -> Errand:
        return with_wood(1, with_stone(1, at_table(errand(HERE, act))))

    stone_pickaxe = stone_tool(Action.MAKE_STONE_PICKAXE)
    iron = either(bag.stone_pickaxe > 0, errand(BlockType.IRON), stone_pickaxe)
    furnace = with_stone(FURNACE_STONES, at_table(errand(FREE, Action.PLACE_FURNACE)))

    def iron_tool(act: Action) -> Errand:
        made = either(nearby.workshop_near, errand(AT_WORKSHOP), furnace)
        made = either(nearby.table & nearby.furnace, errand(HERE, act), made)
        made = either(bag.coal >= 1, either(bag.iron >= 1, made, iron), coal)
        return with_wood(1, made)

    iron_pickaxe = iron_tool(Action.MAKE_IRON_PICKAXE)
    plain = plain_errands()
    sapling = plain[Achievement.COLLECT_SAPLING]
    table: Mapping[Achievement, Errand] = {
        **plain,
        Achievement.PLACE_TABLE: with_wood(TABLE_WOOD + 2, errand(FREE, Action.PLACE_TABLE)),
        Achievement.MAKE_WOOD_PICKAXE: wood_pickaxe,
        Achievement.MAKE_WOOD_SWORD: wood_sword,
        Achievement.PLACE_PLANT: either(
            bag.sapling >= 1, errand(SOIL, Action.PLACE_PLANT), sapling
        ),
        Achievement.COLLECT_STONE: stone,
        Achievement.PLACE_STONE: with_stone(1, errand(FREE, Action.PLACE_STONE)),
        Achievement.MAKE_STONE_PICKAXE: stone_pickaxe,
        Achievement.MAKE_STONE_SWORD: stone_tool(Action.MAKE_STONE_SWORD),
        Achievement.PLACE_FURNACE: furnace,
        Achievement.COLLECT_COAL: coal,
        Achievement.COLLECT_IRON: iron,
        Achievement.COLLECT_DIAMOND: either(
            bag.iron_pickaxe > 0, errand(BlockType.DIAMOND), iron_pickaxe
        ),
        Achievement.MAKE_IRON_PICKAXE: iron_pickaxe,
        Achievement.MAKE_IRON_SWORD: iron_tool(Action.MAKE_IRON_SWORD),
    }
    return jax.tree.map(lambda *column: jnp.stack(column), *(table[a] for a in Achievement))


def in_danger(scene: Scene) -> Bool[Array, ""]:
    """Whether it would be dangerous to fall asleep here."""
    return (scene.zombies.distance < 7) | (scene.skeletons.distance < FAR)


def advances(scene: Scene) -> Float[Array, "22"]:
    """The number of tiers by which each achievement currently comes earlier than in its order.

    An achievement that depends on luck, such as meeting a cow, comes later while its object is not in view.
    """
    view = rectangle(scene.here, *HALF_VIEW)

    def in_view(kind: BlockType) -> Array:
        return jnp.any(scene.of(kind) & view)

    diamond = in_view(BlockType.DIAMOND) & (scene.bag.iron_pickaxe > 0)
    can_sleep = (scene.energy < 9) & ~in_danger(scene)
    table: Mapping[Achievement, Array] = {
        Achievement.COLLECT_WOOD: jnp.where(in_view(BlockType.TREE), 1.0, 0.0),
        Achievement.EAT_COW: jnp.where(scene.cows.distance < FAR, 1.5, -3.0),
        Achievement.COLLECT_DRINK: jnp.where(in_view(BlockType.WATER), 1.5, -3.0),
        Achievement.DEFEAT_ZOMBIE: jnp.where(scene.zombies.distance < FAR, 3.0, -20.0),
        Achievement.DEFEAT_SKELETON: jnp.where(scene.skeletons.distance < FAR, 4.0, -10.0),
        Achievement.COLLECT_COAL: jnp.where(in_view(BlockType.COAL), 2.0, -1.0),
        Achievement.COLLECT_IRON: jnp.where(in_view(BlockType.IRON), 2.0, -1.0),
        Achievement.COLLECT_DIAMOND: jnp.where(diamond, 4.0, 0.0),
        Achievement.EAT_PLANT: jnp.where(jnp.any(scene.of(BlockType.RIPE_PLANT)), 8.0, -NEVER),
        Achievement.WAKE_UP: jnp.where(can_sleep, 1.0, -NEVER),
    }
    return jnp.stack([jnp.asarray(table.get(achievement, 0.0)) for achievement in Achievement])


def next_errand(scene: Scene, plan: Plan, nearby: Surroundings, habits: Habits) -> Errand:
    """The errand of the achievement whose turn it is, or exploration if nothing is left to do."""
    undone = plan.wanted & ~scene.done
    advance = advances(scene)
    # Impossible achievements stay impossible, whatever the habits are.
    advance = jnp.where(advance > -NEVER, habits.opportunism * advance, advance)
    turn = jnp.where(undone, plan.places - advance, NEVER)
    first = jnp.argmin(turn)
    errands = errands_of(scene, nearby)
    chosen = Errand(place=errands.place[first], act=errands.act[first])
    return either(turn[first] < NEVER / 2, stocked_up(scene, plan, chosen), errand(ANYWHERE))


def stocked_up(scene: Scene, plan: Plan, chosen: Errand) -> Errand:
    """Replace the errand by collecting more wood before leaving trees, or more stone before leaving
    rock."""
    bag, missing = scene.bag, (plan.wanted & ~scene.done).astype(jnp.int32)

    def goes_to(*kinds: int) -> Array:
        return jnp.any(chosen.place == jnp.array(kinds))

    tools = [bag.wood_pickaxe, bag.wood_sword, bag.stone_pickaxe, bag.stone_sword]
    tools += [bag.iron_pickaxe, bag.iron_sword]
    wood = jnp.minimum(sum((have == 0).astype(jnp.int32) for have in tools), 5)
    trees = jnp.any(scene.of(BlockType.TREE) & rectangle(scene.here, *HALF_VIEW))
    from_trees = goes_to(BlockType.STONE.value, BlockType.COAL.value, BlockType.IRON.value)
    chosen = either(from_trees & trees & (bag.wood < wood), errand(BlockType.TREE), chosen)

    stone = (
        missing[Achievement.MAKE_STONE_PICKAXE.value] + missing[Achievement.MAKE_STONE_SWORD.value]
    )
    stone += FURNACE_STONES * missing[Achievement.PLACE_FURNACE.value]
    rock = jnp.any(scene.of(BlockType.STONE) & rectangle(scene.here, 2, 2)) & (bag.wood_pickaxe > 0)
    from_rock = goes_to(AT_TABLE, BlockType.TREE.value, FREE)
    return either(from_rock & rock & (bag.stone < stone), errand(BlockType.STONE), chosen)


def with_needs(scene: Scene, chosen: Errand) -> Errand:
    """The errand, or a more urgent one because of hunger, thirst or tiredness."""
    knows_water = jnp.any(scene.of(BlockType.WATER))
    hungry = (scene.food <= 3) & (scene.cows.distance < FAR) | (scene.food <= 1)
    thirsty = (scene.drink <= 3) & knows_water | (scene.drink <= 1)
    tired = (scene.energy <= 1) & ~in_danger(scene)
    chosen = either(hungry, errand(COW), chosen)
    chosen = either(thirsty, errand(BlockType.WATER), chosen)
    return either(tired, errand(HERE, Action.SLEEP), chosen)
