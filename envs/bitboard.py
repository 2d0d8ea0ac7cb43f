"""Shortest paths on grids, many cells to a machine word.

A set of cells is a board of ``S`` rows, each row the bits of one ``uint32`` (so sides up to 32). One
step of a breadth-first search is a handful of shifts on the whole board, which makes it cheap enough to
plan anew at every step of thousands of mazes at once.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

MAX_SIDE = 32
# Steps of a search between two looks at whether it has ended; a power of two.
ROUND_BITS = 3
ROUND = 1 << ROUND_BITS


def pack(cells: Bool[Array, "S S"]) -> UInt32[Array, "S"]:
    """Boolean cells as one word for each row; bit ``c`` is column ``c``."""
    if cells.shape[0] > MAX_SIDE:
        raise ValueError(f"grids are limited to {MAX_SIDE} cells a side, found {cells.shape[0]}")
    columns = jnp.arange(cells.shape[1], dtype=jnp.uint32)
    return jnp.sum(cells.astype(jnp.uint32) << columns, axis=1, dtype=jnp.uint32)


def unpack(board: UInt32[Array, "S"]) -> Bool[Array, "S S"]:
    columns = jnp.arange(board.shape[0], dtype=jnp.uint32)
    return ((board[:, None] >> columns) & 1).astype(bool)


def single(cell: Int[Array, "2"], side: int) -> UInt32[Array, "S"]:
    """The board of one cell (row, column)."""
    bit = jnp.uint32(1) << cell[1].astype(jnp.uint32)
    return jnp.where(jnp.arange(side) == cell[0], bit, 0).astype(jnp.uint32)


def spread(board: UInt32[Array, "S"]) -> UInt32[Array, "S"]:
    """The cells of ``board`` and their four neighbors."""
    zero = jnp.zeros(1, jnp.uint32)
    up = jnp.concatenate([board[1:], zero])
    down = jnp.concatenate([zero, board[:-1]])
    return board | (board << 1) | (board >> 1) | up | down


def distances(free: Bool[Array, "S S"], source: Int[Array, "2"]) -> Int[Array, "S S"]:
    """Steps of the shortest free path from ``source`` to every cell, -1 where there is none.

    The source counts as free. Under ``vmap`` all lanes search until the last one has ended.
    """
    side = free.shape[0]
    origin = single(source, side)
    open_ = pack(free) | origin
    high_bits = jnp.arange((side * side).bit_length() - ROUND_BITS)

    # A cell found by step s (counted from 0) gets s in binary: one board for each bit. The low bits
    # are known at compile time within an unrolled round, the high ones are the same for all of it.
    def search(carry: Any) -> Any:
        reached, _, low, high, round_ = carry
        before = reached
        low = list(low)
        for step in range(ROUND):
            grown = spread(reached) & open_
            new = grown & ~reached
            low = [bits | new if step >> b & 1 else bits for b, bits in enumerate(low)]
            reached = grown
        in_round = jnp.where((round_ >> high_bits & 1)[:, None] == 1, reached & ~before, 0)
        return reached, jnp.any(new), tuple(low), high | in_round.astype(jnp.uint32), round_ + 1

    none = jnp.zeros(side, jnp.uint32)
    start = (
        origin,
        jnp.ones((), bool),
        (none,) * ROUND_BITS,
        jnp.zeros((high_bits.size, side), jnp.uint32),
        jnp.zeros((), jnp.int32),
    )
    reached, _, low, high, _ = jax.lax.while_loop(lambda carry: carry[1], search, start)
    bits = jax.vmap(unpack)(jnp.concatenate([jnp.stack(low), high])).astype(jnp.int32)
    steps = 1 + jnp.sum(bits << jnp.arange(len(bits))[:, None, None], axis=0)
    return jnp.where(unpack(reached), steps, -1).at[tuple(source)].set(0)


def toward(
    free: Bool[Array, "S S"], source: Int[Array, "2"], target: Int[Array, "2"]
) -> Bool[Array, "S S"]:
    """The neighbors of ``source`` on shortest free paths from it to another cell ``target``.

    None if the target is cut off.
    """
    side = free.shape[0]
    origin = single(target, side)
    neighbors = spread(single(source, side)) & ~single(source, side)
    open_ = pack(free) | origin

    def search(carry: Any) -> Any:
        reached, found, _ = carry
        grown = reached
        for _ in range(ROUND):
            searching = ~jnp.any(found)
            grown = spread(reached) & open_
            found = jnp.where(searching, grown & neighbors, found)
            more = jnp.any(grown != reached)
            reached = grown
        return reached, found, more & ~jnp.any(found)

    first = origin & neighbors
    start = (origin, first, ~jnp.any(first))
    return unpack(jax.lax.while_loop(lambda carry: carry[2], search, start)[1])
