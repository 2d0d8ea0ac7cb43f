"""Which goals a policy was trained on, and which goals of a prompt lie far from all of those.

A policy follows goals that it has seen, and what lies between them; what it does under others is not known.
Trained policies keep a sample of the goals that their demonstrations achieved (``goals.npz``), so that a
prompt, which may come from a user or from an optimizer that invents goals, can be measured against it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mgpo_jax.dataset import Dataset

MOST_KEPT = 1024  # goals that a policy keeps
MOST_COMPARED = 20_000  # goals of the data that those are chosen of
MOST_TRAJECTORIES = 5_000  # of the data that are looked at
AT_ONCE = 128  # goals whose distances to all kept ones are in memory together
SEED = 0  # of what is drawn from larger data
EQUAL = 1e-5  # goals that differ by less, relative to the size of goals, are the same


class SeenGoals(NamedTuple):
    """A sample of the goals of a training that covers them."""

    goals: Float[np.ndarray, "K G"]
    reach: float
    """A goal further than this from all of ``goals`` is far from the training."""

    def distances(self, goals: Any) -> np.ndarray:
        """Euclidean distances of goals ``[..., G]`` to the nearest of the training, in units of goals."""
        rows = np.asarray(goals, np.float64)
        flat = rows.reshape(-1, rows.shape[-1])
        kept = self.goals.astype(np.float64)
        nearest = [
            np.linalg.norm(block[:, None] - kept, axis=-1).min(axis=1)
            for block in np.array_split(flat, len(flat) // AT_ONCE + 1)
        ]
        return np.concatenate(nearest).reshape(rows.shape[:-1])

    def far(self, goals: Any) -> Bool[np.ndarray, "..."]:
        """Which goals ``[..., G]`` are far from all goals of the training."""
        return self.distances(goals) > self.reach

    def joined(self, other: SeenGoals | None) -> SeenGoals:
        """The goals of both, of a training that went on from another."""
        if other is None:
            return self
        both = covering(np.concatenate([self.goals, other.goals]))
        return both._replace(reach=max(both.reach, self.reach, other.reach))


def seen_in(dataset: Dataset, before: SeenGoals | None = None) -> SeenGoals:
    """The goals that prompts of a dataset can hold, those of 5,000 trajectories where there are more.

    Those are the goals reached on the way, and the task goals that a trajectory accomplished in hindsight.

    Args:
      dataset: what a policy is trained on.
      before: the goals of the training that this one goes on from, which count as well.
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
    """At most 1,024 goals that cover others, each the one furthest from those before it.

    A goal counts as far from them if it is further away than the least well covered of ``goals``, and
    further than half the distance between the two that are closest to each other: goals that are all kept,
    such as the cells of a maze, are taken for the points of a grid.

    Source: the greedy choice of k centers of Gonzalez, *Clustering to minimize the maximum intercluster
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
    # Distances to what was chosen before only fall, so that the last gap is the closest pair's.
    reach = max(radius, gaps[-1] / 2 if gaps else 0.0, same)
    return SeenGoals(distinct[np.asarray(chosen)], reach)


def warning_of_goals(seen: SeenGoals | None, goals: Any, what: str) -> str:
    """A sentence on goals that are far from those of the training; empty if none is, or nothing is known.

    Args:
      seen: the goals of the training.
      goals: goals ``[N, G]``, each of one task.
      what: what they are, in the plural.
    """
    alone = np.asarray(goals)[:, None]  # as prompts of one goal
    return warning_of_prompts(seen, alone, np.ones(alone.shape[:2], bool), what)


def warning_of_prompts(seen: SeenGoals | None, goals: Any, mask: Any, what: str) -> str:
    """The same for prompts with goals ``[..., P, G]`` and masks ``[..., P]``: one far goal is enough."""
    if seen is None:
        return ""
    distances = np.where(np.asarray(mask), seen.distances(goals), 0.0)
    far = np.asarray((distances > seen.reach).any(axis=-1))
    if not far.any():
        return ""
    return (
        f"{int(far.sum())} of {far.size} {what} lie far from all goals that the policy was trained on (up "
        f"to {distances.max():.3g} from the nearest one, where goals within {seen.reach:.3g} count as "
        "near): it may not follow them"
    )
