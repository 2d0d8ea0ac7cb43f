"""The results of adaptations: outcomes for users, and the records of lanes from which they are made."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from envs.base import Goals
from mgpo_jax.adaptation import (
    AdaptLog,
    Judged,
)
from mgpo_jax.lanes import Grid


class Reached(NamedTuple):
    """The goals that episodes reached, concatenated over all episodes."""

    counts: np.ndarray
    """``[S, N, E]``: number of goals that each episode reached."""
    steps: np.ndarray
    """``[total]``: the step in which each goal was reached, counted from 0."""
    goals: np.ndarray
    """``[total, G]``: the goals."""


class Outcome(NamedTuple):
    """Raw results of one method, with axes of S seeds, N tasks, E episodes, R rounds and C judgements."""

    returns: np.ndarray
    """``[S, N, E]``: returns of the search's episodes."""
    failed: np.ndarray
    """``[S, N, E]``: whether an episode ended because the simulation failed."""
    choices: Any
    """The choice of each round (such as a prompt), leaves ``[S, N, R, ..]``."""
    best: Any
    """The best choice after each round, leaves ``[S, N, R, ..]``."""
    lengths: np.ndarray
    """``[S, N, E]``: number of steps of the episodes."""
    keys: np.ndarray
    """``[S, N, E, 2]``: raw random keys of the episodes."""
    actions: np.ndarray | None
    """``[S, N, E, T]`` small integers (``adaptation.small_actions``); None if they were not kept."""
    reached: Reached
    eval_episodes: np.ndarray
    """``[C]``: number of episodes after which the best choice was judged."""
    eval_returns: np.ndarray
    """``[S, N, C]``: mean return of the judging episodes. The first judgement is that of the initial
    choice."""
    num_episodes: int
    """Number of all episodes of the searches, including those that judged. Lanes that only pad the last
    group do not count."""
    num_failed: int
    """Number of episodes that ended because the simulation failed."""
    cpu_seconds: float
    """CPU time of all episodes in seconds, without compilation."""
    eval_achieved: np.ndarray | None = None
    """``[S, N, C, M]``: fraction of the judging episodes that achieved each of the world's M named goals;
    None in worlds without named goals (``Environment.goal_names``)."""
    num_scored: np.ndarray | None = None
    """``[S, N, R]``: cumulative number of prompts rehearsed without an episode at the end of each round;
    None for methods that learn from episodes alone."""


class Part(NamedTuple):
    """The results of a finished part of a segment; all arrays have a leading axis of lanes."""

    log: AdaptLog
    judged: Judged
    """The latest judgement: the one after this part, or the one before it if the part ends no segment."""
    ends_segment: bool
    """Whether this is the last part of a segment, after which the best choice was judged."""
    cpu_seconds: float


class Record(NamedTuple):
    """The results of all segments of an adaptation; all arrays have a leading axis of lanes.

    The log is without the goals that were reached, which are in ``reached``.
    """

    log: AdaptLog
    judged: Judged
    reached: list[Goals]
    """The goals of the episodes of each part, ``[lanes, R, K, T, ..]``."""

    def outcome(
        self, variant: int, grid: Grid, after: np.ndarray, num_episodes: int, cpu_seconds: float
    ) -> Outcome:
        """The results of one variant."""

        def of_variant(rows: Any) -> np.ndarray:
            return grid.shape(rows)[variant]

        def by_episode(rows: Any) -> np.ndarray:
            rows = of_variant(rows)
            return rows.reshape(*rows.shape[:2], -1, *rows.shape[4:])

        failed = by_episode(self.log.failed)
        num_failed = failed.sum() + of_variant(self.judged.num_failed).sum()
        return Outcome(
            returns=by_episode(self.log.returns),
            failed=failed,
            choices=jax.tree.map(of_variant, self.log.choices),
            best=jax.tree.map(of_variant, self.log.best),
            lengths=np.concatenate([by_episode(goals.length) for goals in self.reached], axis=2),
            keys=by_episode(self.log.played.key),
            actions=jax.tree.map(by_episode, self.log.played.actions),
            reached=reached_in([jax.tree.map(by_episode, goals) for goals in self.reached]),
            eval_episodes=after,
            eval_returns=of_variant(self.judged.return_),
            num_episodes=num_episodes,
            num_failed=int(num_failed),
            cpu_seconds=cpu_seconds,
            eval_achieved=_by_judgement(jax.tree.map(of_variant, self.judged.achieved)),
            num_scored=jax.tree.map(of_variant, self.log.num_scored),
        )


def _by_judgement(achieved: np.ndarray | None) -> np.ndarray | None:
    """Move the axis of judgements: fractions [S, N, M, C] as [S, N, C, M]."""
    return None if achieved is None else np.moveaxis(achieved, -1, -2)


def without_goals(log: AdaptLog) -> AdaptLog:
    """The log without the goals that were reached, which take up most of its memory."""
    nothing: Any = None
    return log._replace(played=log.played._replace(goals=nothing))


def reached_in(parts: Sequence[Goals]) -> Reached:
    """The goals reached in the episodes of consecutive parts, ``[S, N, E, T, ..]`` each."""
    real = [
        goals.goal_reached & (np.arange(goals.goal_reached.shape[-1]) < goals.length[..., None])
        for goals in parts
    ]
    counts = np.concatenate([which.sum(axis=-1) for which in real], axis=2)
    reached = np.concatenate(real, axis=2)
    steps = np.nonzero(reached)[-1]
    achieved = np.concatenate([goals.achieved_goals for goals in parts], axis=2)
    small = np.min_scalar_type(reached.shape[-1])
    return Reached(counts.astype(np.int32), steps.astype(small), achieved[reached])
