"""IQM, bootstrap intervals and comparisons, against scipy and known properties."""

from __future__ import annotations

from math import erf

import numpy as np
import pytest
from made_results import made_results
from scipy.stats import bootstrap, mannwhitneyu, trim_mean

from envs.errors import UsageError
from envs.registry import StepCost
from experiments.store.statistics import (
    MOST_PARTS,
    Interval,
    arrivals,
    compare,
    gain_over_tasks,
    interquartile_mean,
    mean_log_success,
    paired_difference,
    part_shares,
    same_tasks,
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


def test_one_seed_has_neither_spread_nor_interval() -> None:
    scores = np.arange(8.0)[None]
    assert seed_spread(scores) == (3.5, None)
    assert str(seed_spread(scores)) == "3.500"
    assert stratified_bootstrap_iqm(scores) == (3.5, None, None)
    assert str(stratified_bootstrap_iqm(scores)) == "3.500"
    assert paired_difference(scores, scores - 1) == (Interval(1.0), Interval(1.0))
    several = np.repeat(scores, 3, axis=0)
    assert paired_difference(scores, several).difference.low is None
    assert paired_difference(several, several).difference == (0, 0, 0)


def two_sets(num_a: int = 6, num_b: int = 4, num_tasks: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Scores of two methods on tasks that differ a lot, with many ties."""
    rng = np.random.default_rng(7)
    worth = 10 * np.arange(num_tasks)
    a = rng.integers(0, 4, size=(num_a, num_tasks)) + worth
    b = rng.integers(-1, 4, size=(num_b, num_tasks)) + worth
    return a.astype(float), b.astype(float)


def test_the_probability_of_improvement_is_that_of_the_rank_test() -> None:
    a, b = two_sets()
    wins = [mannwhitneyu(x, y).statistic / (len(a) * len(b)) for x, y in zip(a.T, b.T, strict=True)]
    found = paired_difference(a, b)
    assert found.improvement.value == pytest.approx(np.mean(wins))
    assert paired_difference(b, a).improvement.value == pytest.approx(1 - np.mean(wins))
    assert paired_difference(a, a).improvement.value == 0.5  # ties count half
    assert paired_difference(b + 9, a).improvement == (1, 1, 1)


def test_intervals_are_those_of_scipy_with_each_task_of_each_method_as_a_stratum() -> None:
    a, b = two_sets()
    num = a.shape[1]

    def difference(*strata: np.ndarray, axis: int = -1) -> np.ndarray:
        means = [stratum.mean(axis=axis) for stratum in strata]
        return np.mean(means[:num], axis=0) - np.mean(means[num:], axis=0)

    def improvement(*strata: np.ndarray, axis: int = -1) -> np.ndarray:
        pairs = zip(strata[:num], strata[num:], strict=True)
        chances = [
            (np.sign(x[..., :, None] - y[..., None, :]) / 2 + 0.5).mean(axis=(-2, -1))
            for x, y in pairs
        ]
        return np.mean(chances, axis=0)

    found = paired_difference(a, b, num_resamples=20_000)
    for interval, statistic in zip(found, (difference, improvement), strict=True):
        wanted = bootstrap(
            (*a.T, *b.T),
            statistic,
            n_resamples=20_000,
            method="percentile",
            random_state=np.random.default_rng(1),
        ).confidence_interval
        assert interval.value == pytest.approx(float(statistic(*a.T, *b.T)))
        width = wanted.high - wanted.low
        assert interval.low == pytest.approx(wanted.low, abs=0.04 * width)
        assert interval.high == pytest.approx(wanted.high, abs=0.04 * width)


def test_shares_of_parts_by_hand() -> None:
    """Two seeds of tasks of 1, 3 and 2 parts, and one that is not rewarded part by part."""
    returns = np.array([[1, 2 / 3, 0.5, -5], [0, 1, 0, 0.3]], np.float32)
    found = part_shares(returns, np.array([1, 3, 2, 0]))
    assert found == [(4 / 6, 6), (2 / 4, 4), (1 / 2, 2)]
    assert [str(share) for share in found] == ["0.67 (6)", "0.50 (4)", "0.50 (2)"]


def test_shares_of_parts_count_every_part_that_was_done() -> None:
    """As loops over searches count them, from returns that are sums of float32 rewards."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        num_parts = rng.integers(0, 8, size=9)
        num_parts[0] = 7
        done = rng.integers(0, num_parts + 1, size=(3, 9))
        rewards = np.float32(1) / np.maximum(num_parts, 1).astype(np.float32)
        returns = np.array(
            [
                [np.sum([r] * n, dtype=np.float32) for r, n in zip(rewards, row, strict=True)]
                for row in done
            ]
        )
        found = part_shares(returns, num_parts)
        assert found is not None
        for k, (share, num) in enumerate(found, 1):
            having = [
                n for row in done for n, most in zip(row, num_parts, strict=True) if most >= k
            ]
            assert num == len(having)
            assert share == pytest.approx(sum(n >= k for n in having) / num)
        assert sum(share * num for share, num in found) == pytest.approx(done.sum())
        assert len(found) == 7


@pytest.mark.parametrize(
    ("returns", "num_parts"),
    [
        ([[1.0, -0.3]], [0, 0]),  # no world of parts
        ([[1.0, 0.35]], [2, 2]),  # a mean of several episodes, or another reward
        ([[1.0, -0.5]], [2, 2]),
        ([[1.5, 0.5]], [2, 2]),
        ([[1.0, np.nan]], [2, 2]),
    ],
)
def test_returns_that_are_no_parts_have_no_shares(
    returns: list[list[float]], num_parts: list[int]
) -> None:
    assert part_shares(np.array(returns), np.array(num_parts)) is None


def test_of_many_parts_the_first_are_told() -> None:
    found = part_shares(np.array([[0.5]]), np.array([1000]))
    assert found == [(1.0, 1)] * MOST_PARTS


@pytest.mark.parametrize(("num_seeds", "least", "most"), [(3, 0.82, 0.96), (10, 0.91, 0.98)])
def test_intervals_hold_the_truth_as_often_as_documented(
    num_seeds: int, least: float, most: float
) -> None:
    rng = np.random.default_rng(num_seeds)
    worth = np.linspace(-2, 2, 12)  # of the tasks, which are the same for both
    truth = 0.3, 0.5 * (1 + erf(0.3 / 2))
    held = np.zeros(2)
    for trial in range(300):
        a = rng.normal(size=(num_seeds, 12)) + worth + 0.3
        b = rng.normal(size=(num_seeds, 12)) + worth
        found = paired_difference(a, b, num_resamples=200, seed=trial)
        held += [
            interval.low <= true <= interval.high
            for interval, true in zip(found, truth, strict=True)
        ]
    assert np.all((held / 300 >= least) & (held / 300 <= most)), held / 300


def test_a_gain_is_paired_and_its_interval_over_tasks() -> None:
    """As scipy's percentile bootstrap of the differences of tasks; seeds are only averaged."""
    rng = np.random.default_rng(3)
    tasks = rng.normal(0, 10, size=40)
    b = tasks + rng.normal(size=(3, 40))
    a = tasks + rng.normal(0.5, 1, size=(3, 40))
    gain = gain_over_tasks(a, b)
    each = a.mean(axis=0) - b.mean(axis=0)
    wanted = bootstrap((each,), np.mean, n_resamples=20_000, method="percentile", rng=1)
    assert gain.value == pytest.approx(each.mean())
    assert gain[1:] == pytest.approx(tuple(wanted.confidence_interval), abs=0.03)
    assert gain_over_tasks(a, b) == gain
    assert gain_over_tasks(a[:, :1], b[:, :1]) == Interval(pytest.approx(each[0]), None, None)


def test_arrivals_by_hand() -> None:
    """Of a shortest way of 5 steps and one of 8, walked in 5, 10 and 8 steps, and once not at all."""
    cost = StepCost(step=0.1, arrival=1.0, horizon=20)
    returns = np.float32([[0.5, -2.0], [0.0, 0.2]])
    assert cost.num_steps(returns).tolist() == [[5, np.inf], [10, 8]]
    found = arrivals(returns, np.float32([0.5, 0.2]), cost)
    assert found == (0.75, pytest.approx((1 + 0 + 0.5 + 1) / 4))
    nobody = arrivals(np.float32([[-2.0]]), np.float32([-2.0]), cost)  # out of everybody's reach
    assert nobody == (0.0, 0.0)


def test_the_score_of_crafter() -> None:
    """Equal rates are their own score; a rate of 0 and one of 100 % give sqrt(101) - 1."""
    assert mean_log_success(np.full(22, 0.3)) == pytest.approx(30)
    assert mean_log_success(np.array([0.0, 1.0])) == pytest.approx(101**0.5 - 1)
    assert mean_log_success(np.zeros(22)) == 0


def test_scores_of_different_tasks_are_refused() -> None:
    with pytest.raises(ValueError, match=r"same N tasks, found \[3, 4\] and \[3, 5\]"):
        paired_difference(np.zeros((3, 4)), np.zeros((3, 5)))
    with pytest.raises(ValueError, match="scores must be"):
        paired_difference(np.zeros(4), np.zeros(4))


def test_results_are_compared_on_the_same_tasks_only() -> None:
    ucb, bbt = made_results(), made_results("bbt", shift=-1)
    found = compare(ucb, bbt)
    assert found.difference.value == pytest.approx(1)
    assert found == paired_difference(ucb.eval_returns[:, :, -1], bbt.eval_returns[:, :, -1])
    swapped = {name: array[::-1] for name, array in bbt.tasks.items()}
    elsewhere = made_results("bbt", tasks=swapped)
    assert same_tasks(ucb, bbt)
    assert not same_tasks(ucb, elsewhere)
    with pytest.raises(UsageError, match="tiny ucb and of tiny bbt are of different tasks"):
        compare(ucb, elsewhere)
    with pytest.raises(UsageError, match="different tasks"):
        compare(ucb, made_results(tasks={"order": ucb.tasks["goal"]}))
