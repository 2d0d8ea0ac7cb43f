"""Multi-goal prompts and their sampler, p ~ P(p | tau) (paper, section 3.1).

Pre-training uses the sampler to relabel the dataset in hindsight, and adaptation to draw new prompts from
the best trajectory. As in the authors' code, goals are drawn without replacement and kept in the order of
the trajectory, and their number is uniform in 1..K, clipped to the number of goals available.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import Goals, Trajectory
from envs.errors import UsageError


class Prompt(NamedTuple):
    """A sequence of up to P goals, right-aligned in P slots: the last slot always holds the final goal."""

    goals: Float[Array, "*batch P G"]
    mask: Bool[Array, "*batch P"]
    """Which slots hold a goal; the goals in the other slots are zero."""


def single_goal(goal: Float[Array, "G"], num_slots: int) -> Prompt:
    """The prompt (g) of one goal in ``num_slots`` slots. Adaptation starts from (g^M)."""
    goals = jnp.zeros((num_slots, *goal.shape), goal.dtype).at[-1].set(goal)
    return Prompt(goals, jnp.arange(num_slots) == num_slots - 1)


def prompt_of(goals: Any, num_slots: int) -> Prompt:
    """The prompt of a sequence of goals; the last is usually the task goal g^M.

    Raises:
      UsageError: if there are no goals, more than ``num_slots``, or a number is not finite.
    """
    rows = np.asarray(goals, np.float32)
    if rows.ndim != 2 or not 1 <= len(rows) <= num_slots:
        raise UsageError(
            f"a prompt is a list of 1 to {num_slots} goals, an array [k, G]; found shape "
            f"{list(rows.shape)}"
        )
    if not np.isfinite(rows).all():
        raise UsageError("the goals of a prompt must be finite numbers")
    empty = num_slots - len(rows)
    padded = np.concatenate([np.zeros((empty, rows.shape[1]), np.float32), rows])
    return Prompt(jnp.asarray(padded), jnp.arange(num_slots) >= empty)


def goals_of(prompt: Prompt) -> np.ndarray:
    """The goals of one prompt, ``[k, G]``."""
    return np.asarray(prompt.goals)[np.asarray(prompt.mask)]


def hindsight_outcome(trajectory: Trajectory | Goals) -> Float[Array, "G"]:
    """g_H, the task goal that the trajectory accomplished, which is the outcome at its last real step."""
    return trajectory.outcomes[trajectory.length - 1]


def until_reached(goals: Goals, goal: Float[Array, "G"]) -> Goals:
    """The goals up to the first step whose outcome is ``goal``; all of them if there is no such step.

    An episode can continue after that step, for example if objects were switched on in a wrong order, so
    that the task is not solved. The goals after that step do not help to solve it.
    """
    reached = jnp.all(goals.outcomes == goal, axis=-1)
    reached &= jnp.arange(len(reached)) < goals.length
    length = jnp.where(jnp.any(reached), 1 + jnp.argmax(reached), goals.length)
    return goals._replace(length=length.astype(goals.length.dtype))


# Long because of its documentation; the body is a single procedure.
def sample_prompt(
    key: PRNGKeyArray,
    trajectory: Trajectory | Goals,
    final_goal: Float[Array, "G"],
    num_slots: int,
    max_goals: int | Int[Array, ""] | None = None,
    kept: Bool[Array, "T"] | None = None,
) -> Prompt:
    """Draw (g_i1, .., g_ik, final_goal) with k ~ U[0, K-1] and i1 < .. < ik from a trajectory.

    Args:
      key: random key.
      trajectory: the trajectory to draw goals from. Candidates are the goals that it reached, except for
        the goal of its last step if that goal is the trajectory's outcome.
      final_goal: the last goal of the prompt: ``hindsight_outcome(trajectory)`` in pre-training, the task
        goal g^M in adaptation.
      num_slots: P, the number of slots of the returned prompt (static).
      max_goals: K <= P, the largest number of goals, including the final one (traced; default P).
      kept: which steps have goals that are in every prompt, as far as there is room (not in the paper;
        default: none). The number of goals is then uniform between the number of kept goals and the number
        of candidates, and goals reached after the last kept step are in a random order.

    Returns:
      A right-aligned prompt. Its goals are in the order in which the trajectory reached them, except for
      those that ``kept`` leaves in a random order.
    """
    key_count, key_index = jax.random.split(key)
    num_steps = trajectory.goal_reached.shape[0]
    time = jnp.arange(num_steps)
    # In hindsight the outcome is the final goal, which would only be repeated.
    repeats_end = (time == trajectory.length - 1) & jnp.all(
        trajectory.achieved_goals == trajectory.outcomes, axis=-1
    )
    eligible = trajectory.goal_reached & (time < trajectory.length) & ~repeats_end

    max_goals = num_slots if max_goals is None else max_goals
    if kept is None:
        count = jnp.minimum(jax.random.randint(key_count, (), 0, max_goals), eligible.sum())
    else:
        kept &= eligible
        most = jnp.minimum(max_goals - 1, eligible.sum())
        count = jax.random.randint(key_count, (), jnp.minimum(kept.sum(), most), most + 1)

    num_drawn = min(num_slots - 1, num_steps)
    rank = jnp.arange(num_drawn)
    scores = jnp.where(eligible, jax.random.uniform(key_index, (num_steps,)), -1.0)
    if kept is not None:
        scores = jnp.where(kept, 2.0, scores)
    _, drawn = jax.lax.top_k(scores, num_drawn)
    used, place = rank < count, drawn
    if kept is not None:
        # Goals after the last kept step stay in the random order in which they were drawn.
        place = jnp.where(drawn > jnp.max(jnp.where(kept, time, -1)), num_steps + rank, drawn)
    order = jnp.argsort(jnp.where(used, place, -1))  # unused slots first
    drawn, used = drawn[order], used[order]

    empty = num_slots - 1 - num_drawn
    mask = jnp.concatenate([jnp.zeros(empty, bool), used, jnp.ones(1, bool)])
    goals = jnp.concatenate(
        [
            jnp.zeros((empty, final_goal.shape[0])),
            trajectory.achieved_goals[drawn],
            final_goal[None],
        ]
    )
    return Prompt(jnp.where(mask[:, None], goals, 0.0), mask)
