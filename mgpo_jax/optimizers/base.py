"""The interface of prompt optimizers: pure functions over an explicit state, one episode at a time.

``ask`` names the prompt of the next episode and ``tell`` takes its result, so every method is charged
for every episode it uses, the first evaluation of the prompt (g^M) included. A factory closes over
hyper-parameters, which may be traced: a sweep is a ``vmap`` over a factory's arguments.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mgpo_jax.types import PRNGKeyArray


class PromptOptimizer(NamedTuple):
    """Searches a prompt for one task; ``jax.vmap`` searches for many."""

    init: Callable
    """``(key, task_goal, blank) -> state``, with a blank trajectory of the world for its shapes."""
    ask: Callable
    """``(key, state) -> (query, state)``: what to run in the next episode."""
    tell: Callable
    """``(state, query, episode) -> state``."""
    best: Callable
    """``(state) -> prompt``: the best prompt so far."""


@dataclass(frozen=True)
class SearchSpace:
    """What an optimizer may know of the world and of the policy, beside the task goal."""

    num_slots: int
    """P, slots of a prompt."""
    sample_goal: Callable[[PRNGKeyArray], Float[Array, "G"]]
    """Draws a goal that may stand in a prompt (GRIPS)."""
    return_range: tuple[float, float]
    """Smallest and largest possible return."""
    num_episodes: int
    """Budget N; sizes tables, does not stop the search."""
    max_goals: int | Int[Array, ""] | Any = None
    """K, the longest prompt to try; None means ``num_slots``."""
    deterministic: bool = True
    """Whether a prompt's greedy episode always has the same return."""
    keep_rewarded: bool = False
    """Whether prompts drawn from a trajectory keep the goals that were rewarded, and shuffle those that
    were reached afterwards (bandits)."""

    @property
    def longest(self) -> int | Int[Array, ""] | Any:
        return self.num_slots if self.max_goals is None else self.max_goals

    @property
    def return_span(self) -> float:
        return self.return_range[1] - self.return_range[0]


def choose(condition: Bool[Array, ""], if_true: Any, if_false: Any) -> Any:
    """``if_true`` or ``if_false``, two pytrees of the same shapes."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)
