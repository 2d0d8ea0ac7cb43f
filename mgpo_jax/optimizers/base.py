"""The interface of prompt optimizers: pure functions over an explicit state, one episode at a time.

``ask`` names the prompt of the next episode and ``tell`` takes its result, so every method is charged
for every episode that it uses, the first evaluation of the prompt (g^M) included. A factory such as
``ucb(space, c)`` closes over the hyper-parameters, which may be traced: a sweep is a ``vmap`` over them.
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
    """Searches a prompt for one task; ``jax.vmap`` searches for many."""

    init: Callable[[PRNGKeyArray, Float[Array, "G"]], Any]
    """``(key, task_goal) -> state``."""
    ask: Callable[[PRNGKeyArray, Any], tuple[Query, Any]]
    """``(key, state) -> (query, state)``: what to run in the next episode."""
    tell: Callable[[Any, Query, Episode], Any]
    """``(state, query, episode) -> state``."""
    best: Callable[[Any], Prompt]
    """``(state) -> prompt``: the best prompt so far."""
    num_scored: Callable[[Any], Int[Array, ""]] | None = None
    """``(state) -> number`` of prompts that it scored so far by asking the policy, without an episode; None
    for those that learn by episodes alone."""


@dataclass(frozen=True, kw_only=True)
class SearchSpace:
    """What an optimizer may know of the world and of the policy, beside the task goal."""

    num_slots: int
    """P, the number of slots of a prompt."""
    horizon: int
    """T, the largest number of steps of an episode."""
    return_range: tuple[float, float]
    """Smallest and largest possible return."""
    num_episodes: int
    """The budget N. It sizes tables; it does not stop the search."""
    sample_goal: Callable[[PRNGKeyArray], Float[Array, "G"]]
    """Draws a goal that may stand in a prompt, for methods that insert random goals."""
    max_goals: int | Int[Array, ""] | None = None
    """K, the number of goals of the longest prompt to try (None: ``num_slots``)."""
    deterministic: bool = True
    """Whether a prompt's greedy episode always has the same return."""
    keep_rewarded: bool = False
    """Whether prompts drawn from a trajectory keep the goals that were rewarded, and put those that were
    reached after them in a random order."""

    @property
    def longest(self) -> int | Int[Array, ""]:
        return self.num_slots if self.max_goals is None else self.max_goals

    @property
    def return_span(self) -> float:
        return self.return_range[1] - self.return_range[0]
