"""The encoder ``crafter-picture``: a linear layer on Crafter's picture, computed without drawing it.

A picture consists of a tile for each cell and an icon for each item, all at fixed places. The output of a
linear layer is therefore a sum over tiles at their places, whose terms are looked up in tables. Night mixes
the tiles of day and night according to the light, and sleep makes them gray, both of which are linear in
the tiles. Only Crafter's rounding to bytes at night and asleep is omitted, an error of less than one and a
half of 255 levels.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from envs.crafter.tiles import (
    GRAY,
    ITEM_ROWS,
    ITEMS,
    PIXELS,
    SLEEP,
    UNIT,
    night_tiles,
    tiles,
)
from envs.crafter.view import (
    ASLEEP,
    COLUMNS,
    COUNTS,
    LIGHT,
    MAX_COUNT,
    NUM_BLOCKS,
    NUM_CELLS,
    NUM_CODES,
    NUM_COUNTS,
    NUM_FACINGS,
    PLACE_AMONG_POSSIBLE,
    POSSIBLE,
    ROWS,
)

LEVELS = 255.0  # bytes are divided by this, so that brightness is between 0 and 1
MIDDLE = NUM_CELLS // 2  # index of the cell on which the agent stands
OTHERS = np.delete(np.arange(NUM_CELLS), MIDDLE)
TILE = UNIT * UNIT * 3  # number of components of a tile


class Shown(NamedTuple):
    """The tiles that observations show at some cells, and in which light."""

    row: Int[Array, "*batch cells"]
    """The index of the tile at each cell."""
    light: Float[Array, "*batch 1"]
    """The light, from 0 at night to 1 by day."""
    asleep: Int[Array, "*batch"]
    """1 if the agent sleeps, which makes tiles gray, otherwise 0."""


class Picture(nn.Module):
    """A linear layer on the picture of 64 x 64 pixels, as a function of an observation of codes.

    Attributes:
      width: size of a token.
    """

    width: int

    @nn.compact
    def __call__(self, obs: Float[Array, "... 85"]) -> Float[Array, "..."]:
        """Tokens ``[*batch, E]`` of observations.

        Codes and counts are rounded and clipped to their range. Mobs and arrows are left out where the
        rules do not let them be (``view.POSSIBLE``).
        """
        if self.has_variable("params", "cells"):
            made = Tables(*(self.get_variable("params", name) for name in Tables._fields))
            return _token(made, obs)
        shape = (PIXELS, PIXELS, 3, self.width)
        init = nn.initializers.lecun_normal(in_axis=(0, 1, 2), out_axis=3)
        kernel = self.param("kernel", init, shape)
        bias = self.param("bias", nn.initializers.zeros_init(), (self.width,))
        return _token(tables_of(kernel, bias), obs)


class Tables(NamedTuple):
    """What the encoder computes from its weights alone."""

    cells: Float[Array, "62 2 2 R E"]
    """The products of the weights of all cells but the agent's with the tiles of ``POSSIBLE``."""
    player: Float[Array, "1 2 2 R E"]
    """The products for the cell of the agent with the tiles on which it stands."""
    items: Float[Array, "16 10 E"]
    """The products for the icons of the items with every count, in the order of ``ITEMS``."""
    bias: Float[Array, "E"]
    sleep: Float[Array, "E"]
    """The constant that the tint of sleep adds."""


def tables_of(kernel: Float[Array, "64 64 3 E"], bias: Float[Array, "E"]) -> Tables:
    """The tables that belong to the weights of the linear layer on the picture."""
    places = by_place(kernel)
    view, below = places[:NUM_CELLS], places[NUM_CELLS : NUM_CELLS + NUM_COUNTS]
    kernels = jnp.stack([view, gray_kernel(view)])
    icons = tiles(UNIT).items.reshape(NUM_COUNTS, -1, TILE) / LEVELS
    in_order = jnp.asarray(icons[[COUNTS.index(name) for name in ITEMS]], jnp.float32)
    return Tables(
        cells=tables("day", kernels[:, OTHERS], POSSIBLE),
        player=tables("player", kernels[:, MIDDLE : MIDDLE + 1]),
        items=jnp.einsum("pct,pte->pce", in_order, below),
        bias=bias,
        sleep=_sleep_offset(view),
    )


def prepared(params: Mapping[str, Array]) -> dict[str, Array]:
    """The tables in the place of the encoder's parameters, so that an acting agent looks up only.

    A compiler does not move such large tables out of the loop over the steps of an episode by itself.
    Parameters that were prepared before stay as they are.
    """
    if "kernel" not in params:
        return dict(params)
    return tables_of(params["kernel"], params["bias"])._asdict()


def _token(made: Tables, obs: Float[Array, "*batch 85"]) -> Float[Array, "*batch E"]:
    """Tokens of observations by looking up in the tables."""
    asleep = obs[..., ASLEEP, None] > 0.5
    token = made.bias + jnp.where(asleep, made.sleep, 0.0)
    return _with_items(_with_cells(token, made, obs), made.items, obs)


def by_place(kernel: Float[Array, "64 64 3 E"]) -> Float[Array, "places TILE E"]:
    """The weights for each cell of the view and each item below it, row by row."""
    width = kernel.shape[-1]
    used = kernel[: (ROWS + ITEM_ROWS) * UNIT, : COLUMNS * UNIT]
    apart = used.reshape(ROWS + ITEM_ROWS, UNIT, COLUMNS, UNIT, 3, width)
    return apart.swapaxes(1, 2).reshape((ROWS + ITEM_ROWS) * COLUMNS, TILE, width)


def gray_kernel(places: Float[Array, "places TILE E"]) -> Float[Array, "places TILE E"]:
    """Weights whose output for colors is that of ``places`` for half of their gray."""
    pixels = places.reshape(len(places), -1, 3, places.shape[-1])
    share = jnp.asarray(GRAY / GRAY.sum(), jnp.float32)[:, None]
    return (0.5 * share * pixels.sum(axis=2, keepdims=True)).reshape(places.shape)


def _sleep_offset(places: Float[Array, "places TILE E"]) -> Float[Array, "E"]:
    """The constant that the tint of sleep adds to a token."""
    pixels = places.reshape(-1, 3, places.shape[-1]).sum(axis=0)
    return jnp.asarray(0.5 * SLEEP / LEVELS, jnp.float32) @ pixels


def _with_cells(
    token: Float[Array, "*batch E"], made: Tables, obs: Float[Array, "*batch 85"]
) -> Float[Array, "*batch E"]:
    """The token plus the contributions of the cells in view.

    On a CPU these are added cell by cell, since those of all cells at once would fill the memory.
    Accelerators are slow at scattering the gradient over the tables and fast at products, so they use a
    product.
    """
    codes = jnp.clip(jnp.round(obs[..., :NUM_CELLS]), 0, NUM_CODES - 1).astype(jnp.int32)
    asleep = (obs[..., ASLEEP] > 0.5).astype(jnp.int32)
    light = obs[..., LIGHT, None]
    facing = jnp.argmax(obs[..., NUM_CELLS + NUM_COUNTS :][..., :NUM_FACINGS], axis=-1)
    who = jnp.where(asleep > 0, NUM_FACINGS, facing)
    player = who * NUM_BLOCKS + codes[..., MIDDLE] % NUM_BLOCKS
    add = _with_looked_up if jax.default_backend() == "cpu" else _with_multiplied
    rows = jnp.asarray(PLACE_AMONG_POSSIBLE)[codes[..., OTHERS]]
    token = add(token, made.cells, Shown(rows, light, asleep))
    return add(token, made.player, Shown(player[..., None], light, asleep))


def tables(
    kind: str,
    kernels: Float[Array, "2 cells TILE E"],
    which: Int[np.ndarray, "R"] | None = None,
) -> Float[Array, "cells 2 2 rows E"]:
    """The products of the weights of some cells with tiles of a kind.

    Args:
      kind: a field of ``Tiles``.
      kernels: the weights for an agent that is awake, and for one that sleeps.
      which: the indices of the tiles; None for all.

    Returns:
      ``[cells, 2, 2, rows, E]``: for each cell, awake or asleep, by day or at night, and each tile.
    """
    shown = np.stack([getattr(tiles(UNIT), kind), getattr(night_tiles(UNIT), kind)]) / LEVELS
    flat = shown.reshape(2, -1, TILE)
    chosen = flat if which is None else flat[:, which]
    return jnp.einsum("lrt,scte->cslre", jnp.asarray(chosen, jnp.float32), kernels)


def _with_looked_up(
    token: Float[Array, "*batch E"], tables: Float[Array, "cells 2 2 rows E"], shown: Shown
) -> Float[Array, "*batch E"]:
    """The token plus the products for the tiles that are shown, mixed by the light, cell by cell."""

    def add(token: Array, cell: tuple[Array, Array]) -> tuple[Array, None]:
        table, row = cell
        day, night = (table[shown.asleep, index, row] for index in (0, 1))
        return token + (shown.light * day + (1 - shown.light) * night), None

    return jax.lax.scan(add, token, (tables, jnp.moveaxis(shown.row, -1, 0)))[0]


def _with_multiplied(
    token: Float[Array, "*batch E"], tables: Float[Array, "cells 2 2 rows E"], shown: Shown
) -> Float[Array, "*batch E"]:
    """``_with_looked_up`` computed as one product with one-hots, whose gradient is a product, too."""
    hot = jax.nn.one_hot(shown.row, tables.shape[-2], dtype=tables.dtype)
    by_light = jnp.einsum("...cr,cslre->...sle", hot, tables)
    lights = jnp.concatenate([shown.light, 1 - shown.light], axis=-1)
    states = jax.nn.one_hot(shown.asleep, 2, dtype=tables.dtype)
    return token + jnp.einsum("...s,...l,...sle->...e", states, lights, by_light)


def _with_items(
    token: Float[Array, "*batch E"],
    items: Float[Array, "16 10 E"],
    obs: Float[Array, "*batch 85"],
) -> Float[Array, "*batch E"]:
    """The token plus the contributions of the items' icons, which do not depend on night or sleep."""
    counts = jnp.round(obs[..., NUM_CELLS : NUM_CELLS + NUM_COUNTS]).astype(jnp.int32)
    for place, name in enumerate(ITEMS):
        table = items[place]
        shown_count = jnp.clip(counts[..., COUNTS.index(name)], 0, MAX_COUNT)
        if jax.default_backend() == "cpu":
            token = token + table[shown_count]
        else:  # as in ``_with_cells``
            token = token + jax.nn.one_hot(shown_count, MAX_COUNT + 1, dtype=table.dtype) @ table
    return token
