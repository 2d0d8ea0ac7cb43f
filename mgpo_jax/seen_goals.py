"""The goals that a policy was trained on, and a check of how far the goals of a prompt are from them.

A policy can follow goals like those in its training data; its behavior under other goals is unknown.
Policies therefore keep a sample of the goals that their demonstrations achieved (``goals.npz``). Prompts
that come from users, or from optimizers that invent goals, can be compared with it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mgpo_jax.dataset import Dataset

MOST_KEPT = 1024  # largest number of goals that a policy keeps
MOST_COMPARED = 20_000  # largest number of goals from which these are chosen
MOST_TRAJECTORIES = 5_000  # largest number of trajectories from which goals are taken
AT_ONCE = 128  # number of goals whose distances to all kept ones are computed at once
SEED = 0  # random seed of the subset of larger data
ROUNDING = 1e-6  # relative error of ``reach``, which files keep in single precision
EQUAL = 1e-5  # goals that differ by less, relative to the size of goals, are the same


class SeenGoals(NamedTuple):
    """A sample of the goals in the training data, chosen so that it covers them."""

    goals: Float[np.ndarray, "K G"]
    reach: float
    """A goal farther than this from all of ``goals`` is far from the training data."""

    def distances(self, goals: Any) -> np.ndarray:
        """Euclidean distances of goals ``[..., G]`` to the nearest goal of the sample, in units of
        goals."""
        rows = np.asarray(goals, np.float64)
        flat = rows.reshape(-1, rows.shape[-1])
        kept = self.goals.astype(np.float64)
        nearest = [
            np.linalg.norm(block[:, None] - kept, axis=-1).min(axis=1)
            for block in np.array_split(flat, len(flat) // AT_ONCE + 1)
        ]
        return np.concatenate(nearest).reshape(rows.shape[:-1])

    @property
    def limit(self) -> float:
        """The largest distance at which a goal counts as near: ``reach``, with room for rounding."""
        return self.reach * (1 + ROUNDING)

    def far(self, goals: Any) -> Bool[np.ndarray, "..."]:
        """Which goals ``[..., G]`` are far from the training data."""
        return self.distances(goals) > self.limit

    def joined(self, other: SeenGoals | None) -> SeenGoals:
        """The union of both samples, for training that continued from another policy."""
        if other is None:
            return self
        both = covering(np.concatenate([self.goals, other.goals]))
        return both._replace(reach=max(both.reach, self.reach, other.reach))


def seen_in(dataset: Dataset, before: SeenGoals | None = None) -> SeenGoals:
    """A sample of the goals that prompts drawn from a dataset can hold.

    These are the goals that trajectories reached along the way, and the task goals that they accomplished
    in hindsight. From larger datasets 5,000 trajectories are used.

    Args:
      dataset: the training data.
      before: the sample of the policy that training continues from, which is included.
    """
    rng = np.random.default_rng(SEED)
    which = np.arange(len(dataset))
    if len(which) > MOST_TRAJECTORIES:
        which = np.sort(rng.choice(which, MOST_TRAJECTORIES, replace=False))
    starts = dataset.starts
    found: list[np.ndarray] = []
    for piece in np.array_split(which, max(1, len(which) // 500)):
        steps = [slice(starts[i], starts[i] + dataset.lengths[i]) for i in piece]
        reached = [dataset.achieved_goals[s][dataset.goal_reached[s]] for s in steps]
        accomplished = [dataset.outcomes[s] for s in steps]
        found.append(np.unique(np.concatenate([*reached, *accomplished]), axis=0))
    return covering(np.unique(np.concatenate(found), axis=0)).joined(before)


def covering(goals: Float[np.ndarray, "M G"]) -> SeenGoals:
    """Choose at most 1,024 of M goals that cover all of them, each the farthest from those before it.

    A goal counts as far from the sample if it is farther away than the least well covered one of ``goals``,
    and farther than half the smallest distance between two goals of the sample. The second condition
    matters if all goals are kept, such as the cells of a maze, which are treated as the points of a grid.

    Source: the greedy choice of k centers in Gonzalez, *Clustering to minimize the maximum intercluster
    distance*, 1985. The paper has no such check.
    """
    distinct = np.unique(np.asarray(goals, np.float32), axis=0)
    if len(distinct) > MOST_COMPARED:
        rng = np.random.default_rng(SEED)
        distinct = distinct[np.sort(rng.choice(len(distinct), MOST_COMPARED, replace=False))]
    rows = distinct.astype(np.float64)
    same = EQUAL * max(1.0, float(np.abs(rows).max()))
    chosen, gaps = [0], []
    distance = np.linalg.norm(rows - rows[0], axis=1)
    while len(chosen) < MOST_KEPT and distance.max() > same:
        furthest = int(distance.argmax())
        chosen.append(furthest)
        gaps.append(float(distance[furthest]))
        distance = np.minimum(distance, np.linalg.norm(rows - rows[furthest], axis=1))
    radius = float(distance.max())
    # The distance of each new goal to those before it only decreases, so the last gap is that of the
    # closest pair.
    reach = max(radius, gaps[-1] / 2 if gaps else 0.0, same)
    return SeenGoals(distinct[np.asarray(chosen)], reach)


def warning_of_goals(seen: SeenGoals | None, goals: Any, what: str) -> str:
    """A warning about goals that are far from the training data; empty if none is, or nothing is known.

    Args:
      seen: the sample of the training goals, if it was kept.
      goals: goals ``[N, G]``, one of each task.
      what: what the goals are, as a plural noun for the message.
    """
    alone = np.asarray(goals)[:, None]  # as prompts of one goal
    return warning_of_prompts(seen, alone, np.ones(alone.shape[:2], bool), what)


def warning_of_prompts(seen: SeenGoals | None, goals: Any, mask: Any, what: str) -> str:
    """The same warning for prompts with goals ``[..., P, G]`` and masks ``[..., P]`` that hold any far
    goal."""
    if seen is None:
        return ""
    distances = np.where(np.asarray(mask), seen.distances(goals), 0.0)
    far = np.asarray((distances > seen.limit).any(axis=-1))
    if not far.any():
        return ""
    return (
        f"{int(far.sum())} of {far.size} {what} lie far from all goals that the policy was trained on (up "
        f"to {distances.max():.3g} from the nearest one, where goals within {seen.reach:.3g} count as "
        "near): it may not follow them"
    )
