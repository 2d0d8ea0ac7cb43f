"""Aggregates of scores over tasks and seeds, and comparisons of two sets of scores.

Confidence intervals follow Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical
Precipice" (2021): percentile intervals of a stratified bootstrap, which resamples the seeds within each
task. A single seed cannot be resampled, so it has no interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from envs.errors import UsageError

if TYPE_CHECKING:
    from envs.registry import StepCost
    from experiments.store.results import Results

MOST_PARTS = 20  # maximum number of parts of a task that are reported
WHOLE = 1e-3  # tolerance of a number of parts, since returns are sums of rounded rewards


class Interval(NamedTuple):
    """A point estimate with a confidence interval; ``low`` and ``high`` are None if there is none."""

    value: float
    low: float | None = None
    high: float | None = None

    def __str__(self) -> str:
        if self.low is None or self.high is None:
            return f"{self.value:.3f}"
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


def interquartile_mean(scores: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half of the scores along an axis.

    If the number of scores is not a multiple of four, the scores at the edges count in part.
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
    """The IQM of scores [S, N] over seeds and tasks, with its interval."""
    rng = np.random.default_rng(seed)
    iqms = [interquartile_mean(_resampled(scores, rng).ravel()) for _ in range(num_resamples)]
    value = float(interquartile_mean(scores.ravel()))
    return _percentile_interval(value, iqms, confidence, len(scores))


class SeedSpread(NamedTuple):
    """The mean over tasks and seeds, and the standard deviation over seeds of the mean over tasks."""

    mean: float
    std: float | None
    """None with a single seed."""

    def __str__(self) -> str:
        return f"{self.mean:.3f}" if self.std is None else f"{self.mean:.3f} ± {self.std:.3f}"


def seed_spread(scores: np.ndarray) -> SeedSpread:
    """The paper's mean ± std of scores [S, N]."""
    means = scores.mean(axis=1)
    return SeedSpread(float(means.mean()), float(means.std()) if len(means) > 1 else None)


class PartShare(NamedTuple):
    """p_k: how often the first k parts of a task were done in order."""

    share: float
    """Share of the tasks and seeds with at least k parts in which the first k were done in order."""
    num: int
    """Number of tasks and seeds with at least k parts."""

    def __str__(self) -> str:
        return f"{self.share:.2f} ({self.num})"


def part_shares(returns: np.ndarray, num_parts: np.ndarray) -> list[PartShare] | None:
    """p_1, p_2, .. up to the largest number of parts of a task, and at most ``MOST_PARTS``.

    Args:
      returns: [S, N] returns of single episodes. (A mean over episodes does not say how many parts were
        done in each.)
      num_parts: [N] numbers of equally rewarded parts of the tasks; tasks without parts (0) do not count.

    Returns:
      The shares, or None if no task has parts, or a return is not a whole number of parts.
    """
    having = num_parts > 0
    if not having.any():
        return None
    exact, num_parts = returns[:, having] * num_parts[having], num_parts[having]
    done = np.rint(exact)
    whole = (np.abs(exact - done) <= WHOLE) & (done >= 0) & (done <= num_parts)
    if not whole.all():
        return None
    ks = range(1, min(int(num_parts.max()), MOST_PARTS) + 1)
    reached = [done[:, num_parts >= k] >= k for k in ks]
    return [PartShare(float(those.mean()), those.size) for those in reached]


class Arrivals(NamedTuple):
    """How often and how directly episodes arrived at their goals, over tasks and seeds."""

    success_rate: float
    """Share of the episodes that arrived."""
    spl: float
    """Success weighted by path length (Anderson et al., "On Evaluation of Embodied Navigation Agents",
    2018): the mean ratio of the shortest path to the steps taken, which is 0 for an episode that did not
    arrive. Every step counts, including those against a wall."""


def arrivals(returns: np.ndarray, optimum: np.ndarray, cost: StepCost) -> Arrivals:
    """The success rate and SPL of episodes.

    Args:
      returns: [S, N] returns of single episodes.
      optimum: [N] optimal returns.
      cost: the world's cost of a step, from which numbers of steps follow.
    """
    steps, shortest = cost.num_steps(returns), cost.num_steps(optimum)
    arrived = np.isfinite(steps)
    walked = np.where(arrived, steps, 1.0)
    straight = np.where(arrived, np.minimum(shortest, walked) / walked, 0.0)
    return Arrivals(float(arrived.mean()), float(straight.mean()))


class Comparison(NamedTuple):
    """How much better the first of two sets of scores is than the second."""

    difference: Interval
    """Mean of the first minus mean of the second."""
    improvement: Interval
    """Probability that, on a random task, a random seed of the first beats a random seed of the second;
    ties count half."""


def paired_difference(
    a: np.ndarray,
    b: np.ndarray,
    confidence: float = 0.95,
    num_resamples: int = 2000,
    seed: int = 0,
) -> Comparison:
    """Compare scores [S, N] on the same N tasks; the numbers of seeds may differ.

    The bootstrap resamples the seeds of both sets within each task, and keeps the tasks. So the intervals
    say how the result would vary with other seeds on these tasks, not on other tasks. With few seeds a
    bootstrap is too narrow: the 95 % intervals of 3 seeds cover the truth in about 88 of 100 cases, those
    of 10 seeds in about 95. If either set has a single seed, there are no intervals.

    Raises:
      ValueError: if the scores are of different numbers of tasks.
    """
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1]:
        raise ValueError(
            f"scores must be [S, N] with the same N tasks, found {list(a.shape)} and {list(b.shape)}"
        )
    a, b = a.astype(np.float64), b.astype(np.float64)
    rng = np.random.default_rng(seed)
    drawn = ((_resampled(a, rng), _resampled(b, rng)) for _ in range(num_resamples))
    resamples = [(_difference(*pair), _chance_to_beat(*pair)) for pair in drawn]
    differences, chances = zip(*resamples, strict=True)
    seeds = min(len(a), len(b))
    return Comparison(
        _percentile_interval(_difference(a, b), differences, confidence, seeds),
        _percentile_interval(_chance_to_beat(a, b), chances, confidence, seeds),
    )


class Profile(NamedTuple):
    """A performance profile: the shares of tasks and seeds whose score reaches each of K thresholds."""

    share: np.ndarray
    """[K] shares."""
    low: np.ndarray | None
    """[K] lower ends of their intervals; None with a single seed."""
    high: np.ndarray | None
    """[K] upper ends; None with a single seed."""


def performance_profile(
    scores: np.ndarray,
    thresholds: np.ndarray,
    confidence: float = 0.95,
    num_resamples: int = 1000,
    seed: int = 0,
) -> Profile:
    """The performance profile of scores [S, N] at thresholds [K].

    The intervals are pointwise: each holds for its own threshold. The bootstrap resamples seeds within each
    task.
    """

    def shares(drawn: np.ndarray) -> np.ndarray:
        below = np.searchsorted(np.sort(drawn, axis=None), thresholds, side="left")
        return 1.0 - below / drawn.size

    if len(scores) < 2:
        return Profile(shares(scores), None, None)
    rng = np.random.default_rng(seed)
    resamples = [shares(_resampled(scores, rng)) for _ in range(num_resamples)]
    tail = 50 * (1 - confidence)
    low, high = np.percentile(resamples, [tail, 100 - tail], axis=0)
    return Profile(shares(scores), low, high)


def gain_over_tasks(
    a: np.ndarray,
    b: np.ndarray,
    confidence: float = 0.95,
    num_resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Mean of scores a minus mean of scores b, [S, N] each, on the same N tasks.

    The bootstrap resamples the tasks, with their means over seeds. So the interval says how the difference
    would vary on other tasks. With a single task there is no interval.
    """
    each = a.mean(axis=0, dtype=np.float64) - b.mean(axis=0, dtype=np.float64)
    rng = np.random.default_rng(seed)
    resamples = each[rng.integers(len(each), size=(num_resamples, len(each)))].mean(axis=1)
    return _percentile_interval(float(each.mean()), resamples, confidence, len(each))


def mean_log_success(shares: Sequence[float] | np.ndarray) -> float:
    """Crafter's score: the geometric mean of success rates in percent, each plus 1, minus 1.

    Source: Hafner, *Benchmarking the Spectrum of Agent Capabilities*, ICLR 2022, section 3.2.

    Args:
      shares: [M] success rates from 0 to 1.

    Returns:
      A number from 0 to 100. Rare successes count more than in the mean.
    """
    return float(np.expm1(np.mean(np.log1p(100 * np.asarray(shares, np.float64)))))


def _difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(a.mean() - b.mean())


def _chance_to_beat(a: np.ndarray, b: np.ndarray) -> float:
    """Share of the pairs of seeds, over all tasks, in which a is above b; ties count half."""
    above, equal = a[:, None] > b[None], a[:, None] == b[None]
    return float(np.mean(above + 0.5 * equal))


def _resampled(scores: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Scores [S, N] with the seeds resampled within each task."""
    return scores[rng.integers(len(scores), size=scores.shape), np.arange(scores.shape[1])]


def _percentile_interval(
    value: float, resamples: Sequence[Any] | np.ndarray, confidence: float, num_drawn: int
) -> Interval:
    """The percentile interval of resamples; there is none if only one seed or task was resampled."""
    if num_drawn < 2:
        return Interval(value)
    tail = 50 * (1 - confidence)
    low, high = np.percentile(resamples, [tail, 100 - tail])
    return Interval(value, float(low), float(high))


def same_tasks(a: Results, b: Results) -> bool:
    """Whether two adaptations ran on the same tasks in the same order."""
    return a.tasks.keys() == b.tasks.keys() and all(
        np.array_equal(array, b.tasks[name]) for name, array in a.tasks.items()
    )


def compare(a: Results, b: Results) -> Comparison:
    """Compare the final returns of two adaptations to the same tasks; see ``paired_difference``.

    Raises:
      UsageError: if they ran on different tasks.
    """
    if not same_tasks(a, b):
        raise UsageError(
            f"the results of {a.env} {a.method} and of {b.env} {b.method} are of different tasks, so that "
            "they cannot be compared; adapt both to the same ones"
        )
    return paired_difference(a.eval_returns[:, :, -1], b.eval_returns[:, :, -1])
