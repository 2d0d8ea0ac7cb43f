"""The one sampler of goal prompts, p ~ P(p | tau) (paper, section 3.1).

Pre-training relabels the dataset with it in hindsight; adaptation draws new prompts from the best
trajectory with it. Indices are drawn without replacement and kept in order, the number of goals is
uniform in 1..K and clipped to the goals available, as in the authors' code.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mgpo_jax.types import PRNGKeyArray, Prompt, Trajectory


def single_goal(goal: Float[Array, "G"], num_slots: int) -> Prompt:
    """The prompt (g) of one goal in ``num_slots`` slots; (g^M) is where adaptation starts."""
    goals = jnp.zeros((num_slots, *goal.shape), goal.dtype).at[-1].set(goal)
    return Prompt(goals, jnp.arange(num_slots) == num_slots - 1)


def hindsight_outcome(trajectory: Trajectory) -> Float[Array, "G"]:
    """g_H: the task goal that the trajectory reached, read at its last real step."""
    return trajectory.outcomes[trajectory.length - 1]


def until_reached(trajectory: Trajectory, goal: Float[Array, "G"]) -> Trajectory:
    """The trajectory up to the first step whose outcome is ``goal``; all of it if there is none.

    Some episodes go on after that: objects switched on in a wrong order leave the task unsolved, and
    what is done then is on the way to nothing.
    """
    reached = jnp.all(trajectory.outcomes == goal, axis=-1)
    reached &= jnp.arange(len(reached)) < trajectory.length
    length = jnp.where(jnp.any(reached), 1 + jnp.argmax(reached), trajectory.length)
    return trajectory._replace(length=length.astype(trajectory.length.dtype))


def sample_prompt(
    key: PRNGKeyArray,
    trajectory: Trajectory,
    final_goal: Float[Array, "G"],
    num_slots: int,
    max_goals: int | Int[Array, ""] | None = None,
    kept: Bool[Array, "T"] | None = None,
) -> Prompt:
    """Draw (g_i1, .., g_ik, final_goal) with k ~ U[0, K-1] and i1 < .. < ik from a trajectory.

    Args:
      key: random key.
      trajectory: where the goals come from; only reached goals before its end are candidates.
      final_goal: last goal of the prompt; in hindsight ``hindsight_outcome(trajectory)``, in
        adaptation the task goal g^M.
      num_slots: P, the number of slots of the returned prompt (static).
      max_goals: K <= P, the largest number of goals with the final one (traced; default P).
      kept: steps whose goals are in every prompt, as far as there is room; the number of goals is
        then uniform between those kept and those there are, and goals reached after the last kept
        step come in any order (not in the paper; default none).

    Returns:
      A right-aligned prompt; goals keep the order in which the trajectory reached them, but for ``kept``.
    """
    key_count, key_index = jax.random.split(key)
    num_steps = trajectory.goal_reached.shape[0]
    time = jnp.arange(num_steps)
    # The step that reaches the final goal would only repeat it.
    repeats_end = (time == trajectory.length - 1) & jnp.all(
        trajectory.goals == trajectory.outcomes, axis=-1
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
        # Those after the last kept step stay as they were drawn: at random.
        place = jnp.where(drawn > jnp.max(jnp.where(kept, time, -1)), num_steps + rank, drawn)
    order = jnp.argsort(jnp.where(used, place, -1))  # unused slots first
    drawn, used = drawn[order], used[order]

    empty = num_slots - 1 - num_drawn
    mask = jnp.concatenate([jnp.zeros(empty, bool), used, jnp.ones(1, bool)])
    goals = jnp.concatenate(
        [jnp.zeros((empty, final_goal.shape[0])), trajectory.goals[drawn], final_goal[None]]
    )
    return Prompt(jnp.where(mask[:, None], goals, 0.0), mask)
