"""Aggregates of scores over tasks and seeds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Interval(NamedTuple):
    """A point estimate with a confidence interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


def interquartile_mean(scores: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half of the scores along an axis.

    Where a quarter of the scores is no whole number, the scores at its edge count by the share of
    them that lies inside.
    """
    ordered = np.sort(scores, axis=axis)
    num = ordered.shape[axis]
    rank = np.arange(num)
    inside = np.minimum(rank + 1, 0.75 * num) - np.maximum(rank, 0.25 * num)
    weights = np.clip(inside, 0, None) / (0.5 * num)
    return np.tensordot(ordered, weights, axes=(axis, 0))


def stratified_bootstrap_iqm(
    scores: np.ndarray, confidence: float = 0.95, num_resamples: int = 2000, seed: int = 0
) -> Interval:
    """IQM over seeds and tasks of scores [S, N], resampling seeds within each task.

    The interval is the percentile interval of Agarwal et al. (2021), with tasks as strata.
    """
    num_seeds, num_tasks = scores.shape
    rng = np.random.default_rng(seed)
    rows = rng.integers(num_seeds, size=(num_resamples, num_seeds, num_tasks))
    resampled = scores[rows, np.arange(num_tasks)].reshape(num_resamples, -1)
    tail = 50 * (1 - confidence)
    low, high = np.percentile(interquartile_mean(resampled), [tail, 100 - tail])
    return Interval(float(interquartile_mean(scores.ravel())), float(low), float(high))


class SeedSpread(NamedTuple):
    """Mean over tasks and seeds, and the standard deviation over seeds of the mean over tasks."""

    mean: float
    std: float

    def __str__(self) -> str:
        return f"{self.mean:.3f} ± {self.std:.3f}"


def seed_spread(scores: np.ndarray) -> SeedSpread:
    """The paper's mean ± std of scores [S, N]."""
    means = scores.mean(axis=1)
    return SeedSpread(float(means.mean()), float(means.std()))
