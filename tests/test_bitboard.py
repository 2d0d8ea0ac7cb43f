"""Bitboards: operations and shortest paths against plain arrays and networkx."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from envs.maze.bitboard import distances, pack, single, spread, toward, unpack

SIDES = (5, 8, 15, 32)  # few, because each shape compiles anew

jit_distances = jax.jit(distances)
jit_toward = jax.jit(toward)
jit_roundtrip = jax.jit(lambda cells: unpack(pack(cells)))
jit_spread = jax.jit(lambda cells: unpack(spread(pack(cells))))

quick = settings(max_examples=25, deadline=None, derandomize=True)


@st.composite
def maps(draw, num_cells):
    """A random map, with or without a border of walls, and some of its cells."""
    side = draw(st.sampled_from(SIDES))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    free = rng.random((side, side)) < draw(st.sampled_from([0.3, 0.6, 0.75, 0.9, 1.0]))
    if draw(st.booleans()):
        free[[0, -1]] = free[:, [0, -1]] = False
    coordinate = st.integers(0, side - 1)
    cells = [(draw(coordinate), draw(coordinate)) for _ in range(num_cells)]
    return free, *cells


def steps_from(free: np.ndarray, source: tuple[int, int]) -> np.ndarray:
    """networkx: steps from ``source``, itself taken as free, to every cell; -1 if cut off."""
    graph = nx.grid_2d_graph(*free.shape)
    graph.remove_nodes_from({tuple(cell) for cell in np.argwhere(~free)} - {source})
    steps = np.full(free.shape, -1)
    for cell, length in nx.single_source_shortest_path_length(graph, source).items():
        steps[cell] = length
    return steps


def snake(side: int) -> np.ndarray:
    """One long way: full rows, joined at alternate ends."""
    free = np.zeros((side, side), bool)
    free[::2] = True
    free[1::4, -1] = free[3::4, 0] = True
    return free


@quick
@given(st.sampled_from(SIDES).flatmap(lambda side: arrays(bool, (side, side))))
def test_unpack_inverts_pack(cells):
    np.testing.assert_array_equal(jit_roundtrip(cells), cells)


@quick
@given(st.sampled_from(SIDES).flatmap(lambda side: arrays(bool, (side, side))))
def test_spread_is_the_cross_of_every_cell(cells):
    padded = np.pad(cells, 1)
    cross = cells | padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
    np.testing.assert_array_equal(jit_spread(cells), cross)


def test_bit_c_is_column_c():
    cells = jnp.zeros((32, 32), bool).at[0, 0].set(True).at[3, 5].set(True).at[31, 31].set(True)
    board = np.asarray(pack(cells))
    assert board.dtype == np.uint32
    assert {row: int(word) for row, word in enumerate(board) if word} == {
        0: 1,
        3: 1 << 5,
        31: 1 << 31,
    }
    np.testing.assert_array_equal(
        single(jnp.array([3, 5]), 32), np.where(np.arange(32) == 3, 32, 0)
    )


@quick
@given(maps(num_cells=1))
def test_distances_match_networkx(drawn):
    free, source = drawn
    found = jit_distances(free, jnp.array(source))
    np.testing.assert_array_equal(found, steps_from(free, source))


@pytest.mark.parametrize("side", SIDES)
def test_distances_along_a_snake(side):
    """The longest ways there are; the distance is the rank of the cell along the snake."""
    free = snake(side)
    found = np.asarray(jit_distances(free, jnp.array([0, 0])))
    assert np.array_equal(np.sort(found[free]), np.arange(free.sum()))
    np.testing.assert_array_equal(found, steps_from(free, (0, 0)))


def test_distances_under_vmap():
    """Lanes that end early wait for the others unharmed."""
    rng = np.random.default_rng(0)
    free = rng.random((6, 15, 15)) < np.array([0.2, 0.5, 0.7, 0.9, 1, 1])[:, None, None]
    free[4] = snake(15)
    sources = rng.integers(0, 15, (6, 2))
    found = jax.jit(jax.vmap(distances))(free, sources)
    for index in range(6):
        expected = steps_from(free[index], tuple(sources[index]))
        np.testing.assert_array_equal(found[index], expected)


@quick
@given(maps(num_cells=2).filter(lambda drawn: drawn[1] != drawn[2]))
def test_toward_is_the_neighbors_one_step_nearer(drawn):
    free, source, target = drawn
    with_source = free.copy()
    with_source[source] = True
    steps = steps_from(with_source, target)
    near = np.zeros_like(free)
    for row, column in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        cell = (source[0] + row, source[1] + column)
        if min(cell) >= 0 and max(cell) < len(free) and steps[source] > 0:
            near[cell] = steps[cell] == steps[source] - 1
    found = jit_toward(free, jnp.array(source), jnp.array(target))
    np.testing.assert_array_equal(found, near)


def test_toward_by_hand():
    """Two shortest ways around a block, one longer; nothing leads to what is cut off."""
    drawing = """
    .....
    .S...
    ..#..
    ...T#
    ...#.
    """
    cells = np.array([list(line) for line in drawing.split()])
    free = cells != "#"
    source, target = (jnp.asarray(np.argwhere(cells == name)[0]) for name in "ST")
    found = jit_toward(free, source, target)
    assert np.argwhere(found).tolist() == [[1, 2], [2, 1]]
    assert not jit_toward(free, source, jnp.array([4, 4])).any()


@pytest.mark.parametrize("function", [pack, distances, toward])
def test_sides_beyond_a_word_are_refused(function):
    cells = jnp.zeros((33, 33), bool)
    points = (jnp.array([1, 1]), jnp.array([2, 2]))
    arguments = {pack: (), distances: points[:1], toward: points}[function]
    with pytest.raises(ValueError, match="limited to 32 cells a side, found 33"):
        function(cells, *arguments)
