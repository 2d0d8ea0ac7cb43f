"""Every record of the method and its shape, once.

Axes: B batch, N dataset, T time, P prompt slots, D observation, G goal, A action.
Each record describes one example; ``jax.vmap`` adds leading axes.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

__all__ = ["Episode", "PRNGKeyArray", "Prompt", "Query", "Trajectory"]


class Prompt(NamedTuple):
    """A sequence of up to P goals, right-aligned: the last slot always holds the final goal."""

    goals: Float[Array, "*batch P G"]
    mask: Bool[Array, "*batch P"]


class Query(NamedTuple):
    """What a prompt optimizer asks for: one episode with this prompt."""

    prompt: Prompt
    greedy: Bool[Array, "*batch"]
    """Whether to act with the mode of the policy instead of sampling."""


class Trajectory(NamedTuple):
    """What an episode leaves behind for hindsight: the steps t < length are real, the rest padding.

    ``goals[t]``, ``goal_reached[t]`` and ``outcomes[t]`` describe the world after ``actions[t]``.
    """

    obs: Float[Array, "*batch T D"]
    actions: Array
    """``[T]`` integers, or ``[T, A]`` floats."""
    goals: Float[Array, "*batch T G"]
    goal_reached: Bool[Array, "*batch T"]
    outcomes: Float[Array, "*batch T G"]
    length: Int[Array, "*batch"]


class Episode(NamedTuple):
    """One finished episode of the policy."""

    trajectory: Trajectory
    rewards: Float[Array, "*batch T"]
    return_: Float[Array, "*batch"]
    """Undiscounted sum of rewards."""
    failed: Bool[Array, "*batch"] | bool = False
    """Whether the world broke down and ended it."""
