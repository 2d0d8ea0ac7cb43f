"""Sets of cells of Crafter's map as bitboards, and the search for cheapest paths on it.

A set of cells is a board of two 32-bit words for each of the 64 rows, so that a round of a search moves the
whole front with a few shifts. This is cheap enough to replan at every step of many episodes.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt32

from envs.crafter.rules import SIDE
from envs.episodes import anyone

WORD = 32
Board: TypeAlias = UInt32[Array, "2 64"]
"""A set of cells: bit ``b`` of word ``[w, r]`` is the cell in row ``r`` and column ``32 w + b``."""
Cell: TypeAlias = Int[Array, "2"]
"""The row and column of a cell, which may be outside of the map."""

MOVES = np.array([(0, -1), (0, 1), (-1, 0), (1, 0)], np.int32)
"""The directions of a cell's neighbors: west, east, north, south, in the order of the actions 1 to 4."""


def pack(cells: Bool[Array, "64 64"]) -> Board:
    """The board of a map of booleans."""
    words = cells.reshape(SIDE, 2, WORD).astype(jnp.uint32)
    return jnp.sum(words << jnp.arange(WORD, dtype=jnp.uint32), axis=2, dtype=jnp.uint32).T


def unpack(board: Board) -> Bool[Array, "64 64"]:
    bits = board.T[:, :, None] >> jnp.arange(WORD, dtype=jnp.uint32) & 1
    return bits.reshape(SIDE, SIDE).astype(bool)


def nowhere() -> Board:
    return jnp.zeros((2, SIDE), jnp.uint32)


def single(cell: Cell) -> Board:
    """The board of one cell; empty if the cell is outside of the map."""
    return pack_window(jnp.ones((1, 1), bool), cell)


def rectangle(center: Cell, down: int, right: int) -> Board:
    """The cells at most ``down`` rows and ``right`` columns away from ``center``."""
    shape = (2 * down + 1, 2 * right + 1)
    return pack_window(jnp.ones(shape, bool), center - jnp.array([down, right]))


def pack_window(cells: Bool[Array, "*kinds R C"], corner: Cell) -> UInt32[Array, "*kinds 2 64"]:
    """The boards of booleans in a window of the map whose first cell is at ``corner``.

    The window has at most 32 columns. Its part outside of the map is ignored.
    """
    num_rows, num_columns = cells.shape[-2:]
    columns = jnp.arange(num_columns, dtype=jnp.uint32)
    bits = jnp.sum(cells.astype(jnp.uint32) << columns, axis=-1, dtype=jnp.uint32)
    row = jnp.arange(SIDE) - corner[0]
    inside = (row >= 0) & (row < num_rows)
    rows = jnp.where(inside, bits[..., jnp.clip(row, 0, num_rows - 1)], 0)
    return jnp.stack([_shifted(rows, corner[1] - start) for start in (0, WORD)], axis=-2)


def _shifted(words: UInt32[Array, "*rows"], by: Int[Array, ""]) -> UInt32[Array, "*rows"]:
    """Words shifted to the left, or to the right if ``by`` is negative."""
    left = words << jnp.clip(by, 0, WORD - 1).astype(jnp.uint32)
    right = words >> jnp.clip(-by, 0, WORD - 1).astype(jnp.uint32)
    return jnp.where(jnp.abs(by) >= WORD, 0, jnp.where(by >= 0, left, right)).astype(jnp.uint32)


def contains(board: Board, cell: Cell) -> Bool[Array, ""]:
    """Whether a cell is on a board; False for cells outside of the map."""
    inside = jnp.all((cell >= 0) & (cell < SIDE))
    row, column = jnp.clip(cell, 0, SIDE - 1)
    return inside & ((board[column // WORD, row] >> (column % WORD).astype(jnp.uint32) & 1) == 1)


def beside(board: Board, here: Cell) -> Bool[Array, "4"]:
    """Which neighbors of ``here`` are on a board."""
    return jax.vmap(lambda move: contains(board, here + move))(jnp.asarray(MOVES))


def sides(board: Board) -> tuple[Board, Board, Board, Board]:
    """The board moved by one cell to the east, west, north and south."""
    low, high = board
    none = jnp.zeros((2, 1), jnp.uint32)
    east = jnp.stack([low << 1, (high << 1) | (low >> (WORD - 1))])
    west = jnp.stack([(low >> 1) | (high << (WORD - 1)), high >> 1])
    north = jnp.concatenate([board[:, 1:], none], axis=1)
    south = jnp.concatenate([none, board[:, :-1]], axis=1)
    return east, west, north, south


def union(*boards: Board) -> Board:
    return reduce(jnp.bitwise_or, boards)


def spread(board: Board) -> Board:
    """The cells of a board and their neighbors."""
    return union(board, *sides(board))


def around(board: Board) -> Board:
    """The cells of a board and the eight cells around each."""
    east, west, _, _ = sides(board)
    wide = union(board, east, west)
    return union(wide, *sides(wide)[2:])


def dead_ends(barred: Board) -> Board:
    """Cells of which at least three of the four neighbors are barred."""
    east, west, north, south = sides(barred)
    return (east & west & (north | south)) | (north & south & (east | west))


DIG, WADE = 2, 6
LONGEST = 96  # largest cost of a path that is found
ROUNDS = 4  # number of rounds between two checks for termination


class Terrain(NamedTuple):
    """The cells that can be walked on, by cost; all other cells are barred."""

    free: Board
    """Cells that cost one step."""
    dug: Board
    """Cells that cost ``DIG`` steps: something has to be removed first."""
    slow: Board
    """Cells that cost ``WADE`` steps: a mob is in the way, or water to be bridged."""


class Aims(NamedTuple):
    """The possible ends of a path. Ending at a cell of board ``a`` costs ``costs[a]``."""

    boards: UInt32[Array, "A 2 64"]
    costs: Int[Array, "A"]


class _Search(NamedTuple):
    """The state of a search from the aims towards the walker, in rounds of one step each."""

    time: Int[Array, ""]
    goes_on: Bool[Array, ""]
    """Whether any search of the batch is not done yet."""
    reached: tuple[Board, ...]
    """The cells next to the front, as it was one round ago, two rounds ago and so on."""
    found: Board
    """The walker's neighbors that the front reached first."""


def first_steps(
    here: Cell, aims: Aims, terrain: Terrain, needed: Bool[Array, ""]
) -> Bool[Array, "4"]:
    """Which neighbors of ``here`` are on a cheapest path to an aim.

    Entering an aim costs only ``Aims.costs``, whatever the terrain there. The result is all False if no aim
    can be reached within a cost of ``LONGEST``. Under ``vmap`` all searches run until the last one that is
    ``needed`` is done.
    """
    neighbors = spread(single(here)) & ~single(here)

    def one_round(time: Int[Array, ""], search: _Search) -> _Search:
        begun = (time >= aims.costs)[:, None, None]
        front = jnp.bitwise_or.reduce(jnp.where(begun, aims.boards, 0), axis=0)
        front |= search.reached[0] & terrain.free
        front |= search.reached[DIG - 1] & terrain.dug
        front |= search.reached[WADE - 1] & terrain.slow
        found = jnp.where(jnp.any(search.found != 0), search.found, front & neighbors)
        return search._replace(reached=(spread(front), *search.reached[:-1]), found=found)

    def rounds(search: _Search) -> _Search:
        for number in range(ROUNDS):
            search = one_round(search.time + number, search)
        goes_on = anyone(needed & ~jnp.any(search.found != 0))
        return search._replace(time=search.time + ROUNDS, goes_on=goes_on)

    start = _Search(
        time=jnp.zeros((), jnp.int32),
        goes_on=anyone(needed),
        reached=(nowhere(),) * WADE,
        found=nowhere(),
    )
    end = jax.lax.while_loop(lambda s: s.goes_on & (s.time < LONGEST), rounds, start)
    return beside(end.found, here)
