"""Crafter's picture of an observation, drawn from its codes.

Every cell of the view shows a tile that depends only on its code, the light and whether the agent sleeps;
every item shows its icon and its count. A picture therefore takes a few look-ups in tables, which are made
once from Crafter's textures with the arithmetic of its renderer. Crafter also adds random noise to dark
pictures. That noise is omitted here, so that a picture is a function of the codes.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8
from PIL import Image, ImageEnhance

from envs.crafter.extra import texture_folder
from envs.crafter.view import (
    ARROWS,
    ASLEEP,
    BLOCKS,
    COLUMNS,
    COUNTS,
    LIGHT,
    MAX_COUNT,
    MOBS,
    NUM_BLOCKS,
    NUM_CELLS,
    NUM_CODES,
    NUM_COUNTS,
    NUM_FACINGS,
)

PIXELS = 64  # side of the picture that agents observe, of which the last row and column are black
UNIT = PIXELS // COLUMNS  # side of a cell in that picture, in pixels
ITEM_ROWS = 2  # number of rows of icons below the view
OUTSIDE = 127  # gray level of cells off the map
NIGHT, SLEEP = np.array([0, 16, 64]), np.array([0, 0, 16])
GRAY = np.array([19595, 38470, 7471])  # weights of red, green and blue in gray, of 65536

# Crafter's order of the items, and its names of textures if they differ from those of the blocks.
ITEMS = (*COUNTS[12:], "sapling", *COUNTS[:5], *COUNTS[6:12])
TEXTURE = {"invalid": "unknown", "crafting_table": "table", "plant": "grass", "ripe_plant": "grass"}
ON_BLOCK = {"plant": "plant", "ripe_plant": "plant-ripe"}
ARROW = {"west": "arrow-left", "east": "arrow-right", "north": "arrow-up", "south": "arrow-down"}
PLAYER = ("player-left", "player-right", "player-up", "player-down", "player-sleep")


class Tiles(NamedTuple):
    """The tables from which pictures are made, for cells of ``u`` pixels."""

    day: UInt8[np.ndarray, "codes u u 3"]
    """The tile of every cell code by day."""
    player: UInt8[np.ndarray, "5 blocks u u 3"]
    """The agent facing west, east, north, south, or asleep, on every block."""
    items: UInt8[np.ndarray, "16 10 u u 3"]
    """The icon of every item, in the order of the observation's counts, with every count."""


@cache
def tiles(unit: int = UNIT) -> Tiles:
    """The tables for cells of ``unit`` pixels.

    Raises:
      MissingExtraError: if the textures are missing.
    """
    blocks = [_block(name, unit) for name in BLOCKS]
    day = []
    for arrow in ARROWS:
        for mob in MOBS:
            for block in blocks:
                tile = block if mob == "none" else _over(block, _texture(mob, unit))
                shown = tile if arrow == "none" else _over(tile, _texture(ARROW[arrow], unit))
                day.append(shown)
    player = [[_over(block, _texture(name, unit)) for block in blocks] for name in PLAYER]
    items = [[_item(name, count, unit) for count in range(MAX_COUNT + 1)] for name in COUNTS]
    return Tiles(np.stack(day), np.array(player), np.array(items))


def picture(obs: Float[Array, "O"], unit: int = UNIT) -> UInt8[Array, "height width 3"]:
    """Crafter's picture of an observation: the view, and below it the items, ``[9 u, 9 u, 3]`` bytes."""
    table = _strips(unit)
    codes = obs[:NUM_CELLS].astype(jnp.int32)
    facing = jnp.argmax(obs[NUM_CELLS + NUM_COUNTS :][:NUM_FACINGS])
    asleep, light = obs[ASLEEP] > 0.5, obs[LIGHT]
    who, middle = jnp.where(asleep, NUM_FACINGS, facing), NUM_CELLS // 2
    agent = NUM_CODES + who * NUM_BLOCKS + codes[middle] % NUM_BLOCKS
    cells = jnp.where(jnp.arange(NUM_CELLS) == middle, agent, codes)

    lit = light * _tiled(table.day, cells, unit) + (1 - light) * _tiled(table.night, cells, unit)
    lit = jnp.floor(lit).astype(jnp.int32)
    # Written out: with a sum over the channels and a division by 2, drawing takes twice the time on a CPU.
    gray = (lit[..., 0] * GRAY[0] + lit[..., 1] * GRAY[1] + lit[..., 2] * GRAY[2] + 0x8000) >> 16
    local = jnp.where(asleep, (gray[..., None] + SLEEP) >> 1, lit).astype(jnp.uint8)

    counts = obs[NUM_CELLS : NUM_CELLS + NUM_COUNTS].astype(jnp.int32)
    order = _item_order()
    icons = order * (MAX_COUNT + 1) + counts[order]
    empty = jnp.zeros(ITEM_ROWS * COLUMNS - NUM_COUNTS, jnp.int32)  # a count of 0 shows nothing
    return jnp.concatenate([local, _tiled(table.items, jnp.concatenate([icons, empty]), unit)])


class Strips(NamedTuple):
    """All tiles, cut into rows of ``u`` pixels or ``3 u`` numbers; row y of tile i is at ``i u + y``."""

    day: Float[np.ndarray, "rows colors"]
    """The tiles of all codes, then those of the agent (facing by facing, block by block)."""
    night: Float[np.ndarray, "rows colors"]
    """The same tiles in the dark."""
    items: UInt8[np.ndarray, "rows colors"]
    """The icons of all items (count by count)."""


@cache
def _strips(unit: int) -> Strips:
    def strips(*parts: np.ndarray) -> np.ndarray:
        return np.concatenate([part.reshape(-1, 3 * unit) for part in parts])

    table, dark = tiles(unit), night_tiles(unit)
    day = strips(table.day, table.player).astype(np.float32)
    return Strips(day, strips(dark.day, dark.player), strips(table.items))


def _tiled(
    strips: UInt8[np.ndarray, "rows colors"] | Float[np.ndarray, "rows colors"],
    which: Int[Array, "C"],
    unit: int,
) -> UInt8[Array, "height width 3"] | Float[Array, "height width 3"]:
    """Lay out tiles row by row, ``COLUMNS`` in a row.

    The strips are looked up in the order of the picture, so nothing has to be transposed.
    """
    rows = which.reshape(-1, 1, COLUMNS) * unit + jnp.arange(unit)[:, None]
    return jnp.asarray(strips)[rows].reshape(-1, COLUMNS * unit, 3)


def agent_picture(obs: Float[Array, "O"]) -> UInt8[Array, "64 64 3"]:
    """The picture of 64 x 64 pixels that agents observe in Crafter; its last row and column are black."""
    return jnp.pad(picture(obs), ((0, PIXELS % COLUMNS), (0, PIXELS % COLUMNS), (0, 0)))


class NightTiles(NamedTuple):
    """``Tiles`` in the dark, before Crafter's rounding to bytes."""

    day: Float[np.ndarray, "codes u u 3"]
    player: Float[np.ndarray, "5 blocks u u 3"]


@cache
def night_tiles(unit: int) -> NightTiles:
    """The tiles at night, with little of their color and a tint of blue."""

    def darkened(some: UInt8[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        flat = some.reshape(-1, unit, 3)
        pale = np.asarray(ImageEnhance.Color(Image.fromarray(flat)).enhance(0.4))
        return (0.5 * pale + 0.5 * NIGHT).reshape(some.shape).astype(np.float32)

    return NightTiles(*map(darkened, tiles(unit)[:2]))


def _item_order() -> Int[np.ndarray, "16"]:
    """The index of each of Crafter's items among the counts of an observation."""
    return np.array([COUNTS.index(name) for name in ITEMS])


@cache
def _texture(name: str, size: int) -> UInt8[np.ndarray, "size size channels"]:
    """A texture of Crafter, with opacity as an optional fourth channel."""
    with Image.open(texture_folder() / f"{name}.png") as image:
        return np.asarray(image.resize((size, size), resample=Image.Resampling.NEAREST))


def _block(name: str, unit: int) -> UInt8[np.ndarray, "u u 3"]:
    if name == "out_of_bounds":
        return np.full((unit, unit, 3), OUTSIDE, np.uint8)
    tile = _texture(TEXTURE.get(name, name), unit)[..., :3]
    return _over(tile, _texture(ON_BLOCK[name], unit)) if name in ON_BLOCK else tile


def _item(name: str, count: int, unit: int) -> UInt8[np.ndarray, "u u 3"]:
    """The icon of an item and its count, on black; all black if the count is 0."""
    tile = np.zeros((unit, unit, 3), np.uint8)
    if count:
        for what, share, offset in ((name, 0.8, 0.1), (str(count), 0.6, 0.4)):
            texture, start = _texture(what, int(share * unit)), int(offset * unit)
            place = slice(start, start + len(texture))
            tile[place, place] = _over(tile[place, place], texture)
    return tile


def _over(below: UInt8[np.ndarray, "h w 3"], texture: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a texture over a background, in Crafter's arithmetic."""
    if texture.shape[-1] < 4:
        return texture
    share = texture[..., 3:].astype(np.float32) / 255
    above, under = (part[..., :3].astype(np.float32) / 255 for part in (texture, below))
    return (255 * (share * above + (1 - share) * under)).astype(np.uint8)
