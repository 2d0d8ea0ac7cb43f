"""K-means of goals, with which PTGM's own code makes a large set of goals a small one.

That code (PKU-RL/PTGM) maps goals of many dimensions to the plane by t-SNE, clusters the points by k-means
and keeps the real goal nearest to each center. Goals of the worlds here have few dimensions, so they are
clustered as they are. Everything is numpy, since the number of goals decides the sizes of a compiled
program, and a pure function of the points and a seed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

MAX_ROUNDS = 300
"""Largest number of rounds of Lloyd's algorithm, which ends by itself after far fewer in general."""


class Clusters(NamedTuple):
    """Points in K clusters."""

    centers: Float[np.ndarray, "K D"]
    labels: Int[np.ndarray, "N"]
    """The cluster of each point, whose center is the nearest."""
    inertia: float
    """Sum of the squared distances of all points from their centers."""


def squared_distances(
    points: Float[np.ndarray, "N D"], centers: Float[np.ndarray, "K D"]
) -> Float[np.ndarray, "N K"]:
    """The squared distance of each point from each center."""
    return np.stack([np.sum((points - center) ** 2, axis=1) for center in centers], axis=1)


def assigned(points: Float[np.ndarray, "N D"], centers: Float[np.ndarray, "K D"]) -> Clusters:
    """The clusters of points around given centers."""
    distances = squared_distances(points, centers)
    labels = np.argmin(distances, axis=1)
    return Clusters(centers, labels, float(distances[np.arange(len(points)), labels].sum()))


def one_round(points: Float[np.ndarray, "N D"], before: Clusters) -> Clusters:
    """Move each center to the mean of its points; one that has lost all its points stays where it is."""
    centers = before.centers.copy()
    for cluster in np.unique(before.labels):
        centers[cluster] = points[before.labels == cluster].mean(axis=0)
    return assigned(points, centers)


def lloyd(points: Float[np.ndarray, "N D"], centers: Float[np.ndarray, "K D"]) -> Clusters:
    """Lloyd's algorithm from given centers: rounds until no point changes its cluster."""
    found = assigned(points, centers)
    for _ in range(MAX_ROUNDS):
        before, found = found, one_round(points, found)
        if np.array_equal(found.labels, before.labels):
            break
    return found


def spread_start(
    rng: np.random.Generator, points: Float[np.ndarray, "N D"], num: int
) -> Float[np.ndarray, "K D"]:
    """The first centers of k-means++ (Arthur and Vassilvitskii, 2007).

    Each is a point, drawn with a probability proportional to its squared distance from the nearest of
    those before. There must be ``num`` distinct points.
    """
    centers = points[rng.integers(len(points))][None]
    for _ in range(num - 1):
        far = squared_distances(points, centers).min(axis=1)
        another = points[rng.choice(len(points), p=far / far.sum())]
        centers = np.concatenate([centers, another[None]])
    return centers


def kmeans(points: Float[np.ndarray, "N D"], num: int, seed: int = 0, starts: int = 10) -> Clusters:
    """The best of some runs of k-means.

    Args:
      points: the points, at least ``num`` of which must be distinct.
      num: K, the number of clusters.
      seed: seed of the first centers.
      starts: number of runs, each with first centers of its own.

    Returns:
      The clusters of the run with the smallest inertia.
    """
    points, rng = points.astype(np.float64), np.random.default_rng(seed)
    runs = [lloyd(points, spread_start(rng, points, num)) for _ in range(starts)]
    return min(runs, key=lambda run: run.inertia)


def representatives(points: Float[np.ndarray, "N D"], num: int) -> Int[np.ndarray, "K"]:
    """The indices of ``num`` points that stand for all: of each cluster the point nearest to its center.

    They are in ascending order. Where all distinct points are asked for, nothing is clustered.
    """
    points, first = np.unique(points, axis=0, return_index=True)
    if num == len(points):
        return np.sort(first)
    found = kmeans(points, num)
    distances = squared_distances(points, found.centers)
    # A point of another cluster may be nearer to a center than all points of the center's own.
    distances[found.labels[:, None] != np.arange(num)] = np.inf
    kept = np.unique(found.labels)  # a cluster may have lost all its points
    return np.sort(first[np.argmin(distances[:, kept], axis=0)])
