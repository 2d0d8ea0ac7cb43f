"""What a demonstrator of Crafter knows: what it has seen of the map, and what is on the screen."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from craftax.craftax_classic.constants import BlockType
from craftax.craftax_classic.envs.craftax_state import EnvState, Inventory, Mobs
from jaxtyping import Array, Bool, Float, Int, UInt32

from envs.crafter.rules import SIDE
from envs.crafter.searching import (
    MOVES,
    Board,
    Cell,
    pack,
    pack_window,
    rectangle,
    single,
    union,
)
from envs.crafter.view import COLUMNS, NUM_BLOCKS, ROWS

HALF_VIEW = (ROWS // 2, COLUMNS // 2)  # rows and columns to either side of the agent
WALKABLE = (BlockType.GRASS, BlockType.SAND, BlockType.PATH)
FAR = 99  # distance of mobs that are not in view


class Sighting(NamedTuple):
    """The mobs of one kind in view."""

    board: Board
    distance: Int[Array, ""]
    """Rows plus columns to the nearest one; ``FAR`` if there is none."""


class Scene(NamedTuple):
    """The demonstrator's knowledge at one step."""

    blocks: UInt32[Array, "17 2 64"]
    """The board of each kind of block, as it was when last in view."""
    here: Cell
    facing: Int[Array, ""]
    """Direction of the agent, a row of ``MOVES``."""
    bag: Inventory
    health: Int[Array, ""]
    food: Int[Array, ""]
    drink: Int[Array, ""]
    energy: Int[Array, ""]
    asleep: Bool[Array, ""]
    light: Float[Array, ""]
    time: Int[Array, ""]
    done: Bool[Array, "22"]
    """The achievements unlocked so far."""
    cows: Sighting
    zombies: Sighting
    skeletons: Sighting

    def of(self, *kinds: BlockType) -> Board:
        """The known cells with blocks of these kinds."""
        return union(*(self.blocks[kind.value] for kind in kinds))

    @property
    def mobs(self) -> Board:
        return self.cows.board | self.zombies.board | self.skeletons.board

    @property
    def front(self) -> Cell:
        return self.here + jnp.asarray(MOVES)[self.facing]


def unknown_map() -> UInt32[Array, "17 2 64"]:
    return jnp.zeros((NUM_BLOCKS, 2, 64), jnp.uint32)


def whole_map(world: EnvState) -> UInt32[Array, "17 2 64"]:
    """The boards of all blocks of a world."""
    kinds = jnp.arange(NUM_BLOCKS)[:, None, None]
    return jax.vmap(pack)(world.map == kinds)


def look(blocks: UInt32[Array, "17 2 64"], world: EnvState) -> UInt32[Array, "17 2 64"]:
    """Update the boards of known blocks with what is in view."""
    corner = world.player_position - jnp.array(HALF_VIEW)
    rows, columns = (corner[0] + jnp.arange(ROWS), corner[1] + jnp.arange(COLUMNS))
    view = world.map[jnp.clip(rows, 0, SIDE - 1)[:, None], jnp.clip(columns, 0, SIDE - 1)]
    seen = pack_window(view == jnp.arange(NUM_BLOCKS)[:, None, None], corner)
    return (blocks & ~rectangle(world.player_position, *HALF_VIEW)) | seen


def scene_of(blocks: UInt32[Array, "17 2 64"], world: EnvState) -> Scene:
    """The demonstrator's knowledge: the known ``blocks``, and everything that is on the screen at this
    step."""
    here = world.player_position

    def sighting(mobs: Mobs) -> Sighting:
        away = jnp.abs(mobs.position - here)
        shown = mobs.mask & jnp.all(away <= jnp.array(HALF_VIEW), axis=1)
        board = jax.vmap(single)(mobs.position)
        return Sighting(
            board=jnp.bitwise_or.reduce(jnp.where(shown[:, None, None], board, 0), axis=0),
            distance=jnp.min(jnp.where(shown, jnp.sum(away, axis=1), FAR)),
        )

    return Scene(
        blocks=blocks,
        here=here,
        facing=world.player_direction - 1,
        bag=world.inventory,
        health=world.player_health,
        food=world.player_food,
        drink=world.player_drink,
        energy=world.player_energy,
        asleep=world.is_sleeping,
        light=world.light_level,
        time=world.timestep,
        done=world.achievements,
        cows=sighting(world.cows),
        zombies=sighting(world.zombies),
        skeletons=sighting(world.skeletons),
    )
