"""The interface of prompt optimizers: pure functions over an explicit state, one episode at a time.

``ask`` returns the prompt of the next episode and ``tell`` takes the result. Every episode that a method
uses therefore counts against its budget, including the first evaluation of the prompt (g^M). A factory such
as ``ucb(space, c)`` closes over the hyper-parameters, which may be traced: a sweep is a ``vmap`` over them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.base import Episode
from mgpo_jax.prompts import Prompt
from mgpo_jax.rollout import Query


class PromptOptimizer(NamedTuple):
    """A search for the best prompt of one task; use ``jax.vmap`` for several tasks."""

    init: Callable[[PRNGKeyArray, Float[Array, "G"]], Any]
    """``(key, task_goal) -> state``."""
    ask: Callable[[PRNGKeyArray, Any], tuple[Query, Any]]
    """``(key, state) -> (query, state)``: the prompt of the next episode, and how it acts."""
    tell: Callable[[Any, Query, Episode], Any]
    """``(state, query, episode) -> state``."""
    best: Callable[[Any], Prompt]
    """``(state) -> prompt``: the best prompt so far."""
    num_scored: Callable[[Any], Int[Array, ""]] | None = None
    """``(state) -> number`` of prompts that were rehearsed so far: the policy acted under them in a model
    of the task, without an episode. None for optimizers that learn from episodes alone."""


@dataclass(frozen=True, kw_only=True)
class SearchSpace:
    """What an optimizer may know about the world and the policy, besides the task goal."""

    num_slots: int
    """P, the number of slots of a prompt."""
    horizon: int
    """T, the largest number of steps of an episode."""
    return_range: tuple[float, float]
    """Smallest and largest possible return."""
    num_episodes: int
    """The budget N in episodes. It determines the size of tables; it does not stop the search."""
    sample_goal: Callable[[PRNGKeyArray], Float[Array, "G"]]
    """``(key) -> goal``: a random goal for a prompt, for methods that insert random goals."""
    max_goals: int | Int[Array, ""] | None = None
    """K, the number of goals of the longest prompt to try (None: ``num_slots``)."""
    deterministic: bool = True
    """Whether the greedy episodes of a prompt always have the same return."""
    keep_rewarded: bool = False
    """Whether prompts drawn from a trajectory keep its rewarded goals and shuffle the goals reached after
    them."""

    @property
    def longest(self) -> int | Int[Array, ""]:
        return self.num_slots if self.max_goals is None else self.max_goals

    @property
    def return_span(self) -> float:
        return self.return_range[1] - self.return_range[0]
