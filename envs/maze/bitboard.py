"""Shortest paths on grids by bitboards, with many cells in a machine word.

A set of cells is a board of ``S`` rows. Each row is the bits of one ``uint32``, so that a side has at most
32 cells. One step of a breadth-first search takes a few shifts of the whole board, which is cheap enough to
replan at every step in thousands of mazes at once.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

MAX_SIDE = 32
# A search checks for termination only after every ROUND steps, a power of two.
ROUND_BITS = 3
ROUND = 1 << ROUND_BITS


def pack(cells: Bool[Array, "S S"]) -> UInt32[Array, "S"]:
    """Pack boolean cells into one word for each row; bit ``c`` is column ``c``."""
    if cells.shape[0] > MAX_SIDE:
        raise ValueError(f"grids are limited to {MAX_SIDE} cells a side, found {cells.shape[0]}")
    columns = jnp.arange(cells.shape[1], dtype=jnp.uint32)
    return jnp.sum(cells.astype(jnp.uint32) << columns, axis=1, dtype=jnp.uint32)


def unpack(board: UInt32[Array, "S"]) -> Bool[Array, "S S"]:
    columns = jnp.arange(board.shape[0], dtype=jnp.uint32)
    return ((board[:, None] >> columns) & 1).astype(bool)


def single(cell: Int[Array, "2"], side: int) -> UInt32[Array, "S"]:
    """The board that holds one cell (row, column)."""
    bit = jnp.uint32(1) << cell[1].astype(jnp.uint32)
    return jnp.where(jnp.arange(side) == cell[0], bit, 0).astype(jnp.uint32)


def spread(board: UInt32[Array, "S"]) -> UInt32[Array, "S"]:
    """The cells of ``board`` and their four neighbors."""
    zero = jnp.zeros(1, jnp.uint32)
    up = jnp.concatenate([board[1:], zero])
    down = jnp.concatenate([zero, board[:-1]])
    return board | (board << 1) | (board >> 1) | up | down


class _Distances(NamedTuple):
    """The state of a search for the distances of all cells.

    A cell that is found in step s (counted from 0) is in the boards of those bits that are set in s.
    """

    reached: UInt32[Array, "S"]
    grows: Bool[Array, ""]
    """Whether the last round found new cells."""
    low: tuple[UInt32[Array, "S"], ...]
    """Boards of the low bits of s, which count the steps within a round."""
    high: UInt32[Array, "H S"]
    """Boards of the high bits of s, which count the rounds."""
    round: Int[Array, ""]


def distances(free: Bool[Array, "S S"], source: Int[Array, "2"]) -> Int[Array, "S S"]:
    """The length of the shortest free path from ``source`` to every cell, -1 if there is none.

    The source counts as free. Under ``vmap`` all lanes search until the last one is done.
    """
    side = free.shape[0]
    origin = single(source, side)
    open_ = pack(free) | origin
    high_bits = jnp.arange((side * side).bit_length() - ROUND_BITS)

    def one_round(search: _Distances) -> _Distances:
        reached, low = search.reached, list(search.low)
        for step in range(ROUND):  # unrolled, so that the low bits of a step are static
            grown = spread(reached) & open_
            new = grown & ~reached
            low = [bits | new if step >> b & 1 else bits for b, bits in enumerate(low)]
            reached = grown
        is_set = (search.round >> high_bits & 1)[:, None] == 1
        in_round = jnp.where(is_set, reached & ~search.reached, 0)
        return _Distances(
            reached=reached,
            grows=jnp.any(new),
            low=tuple(low),
            high=search.high | in_round.astype(jnp.uint32),
            round=search.round + 1,
        )

    start = _Distances(
        reached=origin,
        grows=jnp.ones((), bool),
        low=(jnp.zeros(side, jnp.uint32),) * ROUND_BITS,
        high=jnp.zeros((high_bits.size, side), jnp.uint32),
        round=jnp.zeros((), jnp.int32),
    )
    end = jax.lax.while_loop(lambda search: search.grows, one_round, start)
    bits = jax.vmap(unpack)(jnp.concatenate([jnp.stack(end.low), end.high])).astype(jnp.int32)
    steps = 1 + jnp.sum(bits << jnp.arange(len(bits))[:, None, None], axis=0)
    return jnp.where(unpack(end.reached), steps, -1).at[tuple(source)].set(0)


class _Toward(NamedTuple):
    """The state of a search from the target until it meets a neighbor of the source."""

    reached: UInt32[Array, "S"]
    found: UInt32[Array, "S"]
    """The neighbors of the source that it met first."""
    goes_on: Bool[Array, ""]


def toward(
    free: Bool[Array, "S S"], source: Int[Array, "2"], target: Int[Array, "2"]
) -> Bool[Array, "S S"]:
    """The neighbors of ``source`` on shortest free paths from it to another cell ``target``.

    The result is empty if the target cannot be reached.
    """
    side = free.shape[0]
    origin = single(target, side)
    neighbors = spread(single(source, side)) & ~single(source, side)
    open_ = pack(free) | origin

    def one_round(search: _Toward) -> _Toward:
        reached, found, _ = search
        for _ in range(ROUND):
            searching = ~jnp.any(found)
            grown = spread(reached) & open_
            found = jnp.where(searching, grown & neighbors, found)
            more = jnp.any(grown != reached)
            reached = grown
        return _Toward(reached=reached, found=found, goes_on=more & ~jnp.any(found))

    first = origin & neighbors
    start = _Toward(reached=origin, found=first, goes_on=~jnp.any(first))
    return unpack(jax.lax.while_loop(lambda search: search.goes_on, one_round, start).found)
