"""IQM and bootstrap intervals against scipy and against what they must do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import trim_mean

from experiments.store.statistics import (
    interquartile_mean,
    seed_spread,
    stratified_bootstrap_iqm,
)


@pytest.mark.parametrize("num", [4, 8, 40, 100])
def test_iqm_is_the_trimmed_mean_where_quarters_are_whole(num: int) -> None:
    scores = np.random.default_rng(num).normal(size=num)
    assert interquartile_mean(scores) == pytest.approx(trim_mean(scores, 0.25))


def test_iqm_weighs_the_edges_of_the_middle_half() -> None:
    # Of six scores the middle half is three wide: 2 and 3 whole, half of 1 and half of 4.
    assert interquartile_mean(np.array([100.0, 4, 3, 2, 1, -100])) == pytest.approx(2.5)
    assert interquartile_mean(np.array([0.0, 0, 3, 6, 9, 9])) == pytest.approx(
        (3 + 6 + 0 / 2 + 9 / 2) / 3
    )
    assert interquartile_mean(np.array([7.0])) == pytest.approx(7.0)


def test_interval_resamples_seeds_within_tasks() -> None:
    # Tasks differ a lot but seeds agree: strata leave no uncertainty.
    same = np.repeat(np.arange(8.0)[None], 3, axis=0)
    interval = stratified_bootstrap_iqm(same)
    assert interval == pytest.approx((3.5, 3.5, 3.5))


def test_interval_covers_the_truth() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for trial in range(60):
        scores = rng.normal(size=(10, 12))
        interval = stratified_bootstrap_iqm(scores, num_resamples=300, seed=trial)
        assert interval.low <= interval.value <= interval.high
        covered += interval.low <= 0 <= interval.high
    assert 50 <= covered <= 60


def test_seed_spread_is_over_means_of_tasks() -> None:
    spread = seed_spread(np.array([[0.0, 2.0], [4.0, 6.0]]))
    assert spread == (3.0, 2.0)
