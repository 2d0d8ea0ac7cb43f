"""K-means against scikit-learn, and the goals that stand for all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import KMeans

import envs
from mgpo_jax.baselines.clusters import (
    assigned,
    kmeans,
    lloyd,
    one_round,
    representatives,
    spread_start,
)


def blobs(num: int, seed: int = 0) -> np.ndarray:
    """40 points around each of ``num`` well separated places."""
    rng = np.random.default_rng(seed)
    places = 10.0 * np.stack([np.arange(num), np.arange(num) % 2], axis=1)
    return (places[:, None] + rng.standard_normal((num, 40, 2))).reshape(-1, 2)


def cells() -> np.ndarray:
    return np.asarray(envs.make("maze15").goal_set, np.float64)


SCATTERED = np.random.default_rng(2).standard_normal((200, 3))


@pytest.mark.parametrize("points", [blobs(5), SCATTERED], ids=["blobs", "scattered"])
def test_from_the_same_start_it_is_that_of_scikit_learn(points):
    start = points[np.random.default_rng(1).choice(len(points), 5, replace=False)]
    found = lloyd(points, start)
    wanted = KMeans(5, init=start, n_init=1, tol=0, algorithm="lloyd").fit(points)
    np.testing.assert_array_equal(found.labels, wanted.labels_)
    np.testing.assert_allclose(found.centers, wanted.cluster_centers_, atol=1e-4)
    np.testing.assert_allclose(found.inertia, wanted.inertia_, rtol=1e-4)


def test_separate_blobs_are_found():
    found = kmeans(blobs(6), 6)
    of_blob = found.labels.reshape(6, 40)
    assert (of_blob == of_blob[:, :1]).all()
    assert len(set(of_blob[:, 0])) == 6
    np.testing.assert_array_equal(
        found.labels, kmeans(blobs(6), 6).labels
    )  # a function of its input


def test_many_clusters_are_about_as_tight_as_those_of_scikit_learn():
    points = cells()
    wanted = KMeans(50, n_init=10, random_state=0).fit(points)
    assert kmeans(points, 50).inertia < 1.1 * wanted.inertia_


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(1, 3))
def test_no_round_increases_the_inertia(seed, num, dimensions):
    rng = np.random.default_rng(seed)
    points = np.round(rng.standard_normal((30, dimensions)), 1)  # with ties
    found = assigned(points, rng.standard_normal((num, dimensions)))
    for _ in range(6):
        before, found = found, one_round(points, found)
        assert found.inertia <= before.inertia + 1e-9


def test_a_cluster_without_points_keeps_its_center():
    points = np.array([[0.0], [1.0]])
    found = lloyd(points, np.array([[0.4], [100.0]]))
    np.testing.assert_array_equal(found.labels, [0, 0])
    np.testing.assert_array_equal(found.centers, [[0.5], [100.0]])


def test_first_centers_are_distinct_points_that_lie_apart():
    points = np.repeat(blobs(3), 3, axis=0)
    start = spread_start(np.random.default_rng(0), points, 3)
    assert {tuple(row) for row in start} <= {tuple(row) for row in points}
    (places,) = {tuple(sorted(int(x > 5) + int(x > 15) for x in start[:, 0]))}
    assert places == (0, 1, 2)
    few = np.array([[0.0], [0.0], [0.0], [1.0], [2.0]])
    start = spread_start(np.random.default_rng(0), few, 3)
    assert sorted(start[:, 0]) == [0, 1, 2]


def test_representatives_are_goals_of_the_set_one_of_each_cluster():
    points = cells()
    chosen = representatives(points, 20)
    assert len(chosen) == len(set(chosen.tolist())) == 20
    nearest = np.sqrt(((points[:, None] - points[chosen]) ** 2).sum(axis=2).min(axis=1))
    # 169 cells, a fifteenth of the side apart: about 8 for each, none of which is far.
    assert nearest.max() < 3 / 15


def test_all_distinct_goals_stand_for_themselves():
    points = np.array([[2.0, 0.0], [0.0, 1.0], [2.0, 0.0], [1.0, 1.0]])
    np.testing.assert_array_equal(representatives(points, 3), [0, 1, 3])
