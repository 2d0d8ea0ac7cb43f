"""The agent's view: Crafter's names, and an observation as the codes of everything that Crafter draws.

An observation is 85 numbers: the codes of the 7 x 9 cells in view, row by row, then sixteen counts
(inventory and needs), the direction that the agent faces (one-hot), the light and whether the agent sleeps,
in Craftax's order. The code of a cell is ``block + 17 * (mob + 4 * arrow)``.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from craftax.craftax_classic.constants import Achievement, Action, BlockType
from craftax.craftax_classic.envs.craftax_state import EnvState, Mobs
from jaxtyping import Array, Float, Int

from envs.crafter.rules import SIDE
from envs.specs import ObsLayout

ACTIONS = tuple(action.name.lower() for action in Action)
ACHIEVEMENTS = tuple(achievement.name.lower() for achievement in Achievement)
BLOCKS = tuple(block.name.lower() for block in BlockType)
MOBS = ("none", "zombie", "cow", "skeleton")
ARROWS = ("none", "west", "east", "north", "south")
COUNTS = (
    "wood", "stone", "coal", "iron", "diamond", "sapling", "wood_pickaxe", "stone_pickaxe",
    "iron_pickaxe", "wood_sword", "stone_sword", "iron_sword", "health", "food", "drink", "energy",
)  # fmt: skip

NUM_ACTIONS, NUM_ACHIEVEMENTS = len(ACTIONS), len(ACHIEVEMENTS)
NUM_BLOCKS, NUM_MOBS, NUM_ARROWS = len(BLOCKS), len(MOBS), len(ARROWS)
ROWS, COLUMNS = 7, 9  # size of the view in cells
NUM_CELLS = ROWS * COLUMNS
NUM_CODES = NUM_BLOCKS * NUM_MOBS * NUM_ARROWS
NUM_COUNTS, MAX_COUNT = len(COUNTS), 9
NUM_FACINGS = 4  # west, east, north, south
OBS_SIZE = NUM_CELLS + NUM_COUNTS + NUM_FACINGS + 2
LIGHT, ASLEEP = OBS_SIZE - 2, OBS_SIZE - 1  # indices in an observation
LAYOUT = ObsLayout(
    num_cells=NUM_CELLS,
    code_sizes=(NUM_BLOCKS, NUM_MOBS, NUM_ARROWS),
    num_counts=NUM_COUNTS,
    max_count=MAX_COUNT,
)

WALKED = ("grass", "sand", "path")  # blocks on which mobs can be
FLOWN_OVER = (*WALKED, "water", "lava")  # blocks on which arrows can be
PLACED = ("stone", "crafting_table", "furnace", "plant")  # blocks that can be placed under an arrow


def _possible_codes() -> list[int]:
    """The codes that the rules can produce, and those of all blocks alone."""
    walked, flown_over = (
        [BLOCKS.index(name) for name in names] for names in (WALKED, (*FLOWN_OVER, *PLACED))
    )
    with_mobs = [b + NUM_BLOCKS * mob for mob in range(1, NUM_MOBS) for b in walked]
    step = NUM_BLOCKS * NUM_MOBS
    below_arrows = [*flown_over, *with_mobs]
    with_arrows = [code + step * arrow for arrow in range(1, NUM_ARROWS) for code in below_arrows]
    return [*range(NUM_BLOCKS), *with_mobs, *with_arrows]


POSSIBLE = np.array(_possible_codes())
"""The codes that the rules can produce, and those of all blocks alone, less than a third of all codes."""

PLACE_AMONG_POSSIBLE = np.arange(NUM_CODES) % NUM_BLOCKS
"""For each code its index in ``POSSIBLE``; a code that the rules cannot produce has that of its block."""
PLACE_AMONG_POSSIBLE[POSSIBLE] = np.arange(len(POSSIBLE))


def observe(world: EnvState) -> Float[Array, "O"]:
    """The agent's observation of a world: 63 cell codes and 22 numbers."""
    bag = world.inventory
    counts = [getattr(bag, name) for name in COUNTS[:12]]
    counts += [world.player_health, world.player_food, world.player_drink, world.player_energy]
    numbers = jnp.stack(counts).astype(jnp.float32)
    facing = jax.nn.one_hot(world.player_direction - 1, NUM_FACINGS)
    rest = jnp.stack([world.light_level, world.is_sleeping.astype(jnp.float32)])
    return jnp.concatenate([cell_codes(world).astype(jnp.float32), numbers, facing, rest])


def cell_codes(world: EnvState) -> Int[Array, "63"]:
    """The codes of the cells in view, row by row; the agent stands on the middle one."""
    corner = world.player_position - jnp.array([ROWS // 2, COLUMNS // 2])
    rows, columns = corner[0] + jnp.arange(ROWS), corner[1] + jnp.arange(COLUMNS)
    on_map = ((rows >= 0) & (rows < SIDE))[:, None] & ((columns >= 0) & (columns < SIDE))
    blocks = world.map[jnp.clip(rows, 0, SIDE - 1)[:, None], jnp.clip(columns, 0, SIDE - 1)]
    blocks = jnp.where(on_map, blocks, BlockType.OUT_OF_BOUNDS.value).ravel()

    def marked(things: Mobs, marks: Int[Array, "M"]) -> Int[Array, "63"]:
        """The largest mark of the things on each cell, 0 if there are none."""
        place = things.position - corner
        shown = jnp.all((place >= 0) & (place < jnp.array([ROWS, COLUMNS])), axis=1) & things.mask
        cell = jnp.where(shown, place[:, 0] * COLUMNS + place[:, 1], NUM_CELLS)
        here = cell[:, None] == jnp.arange(NUM_CELLS)
        return jnp.max(jnp.where(here, marks[:, None], 0), axis=0)

    mobs = jnp.zeros(NUM_CELLS, jnp.int32)
    for kind, things in enumerate((world.zombies, world.cows, world.skeletons), start=1):
        mobs = jnp.maximum(mobs, marked(things, jnp.full(things.mask.shape, kind)))
    row, column = world.arrow_directions.T
    directions = jnp.where(column != 0, 1 + (column > 0), 3 + (row > 0))
    arrows = marked(world.arrows, directions)
    return blocks + NUM_BLOCKS * (mobs + NUM_MOBS * arrows)
