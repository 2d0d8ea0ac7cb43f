"""The plan where nothing is certain: an estimate of what goals, and orders of two goals, are worth.

In some worlds a goal reached says neither in which state the world is nor whether it was the right one, and
returns differ from episode to episode under the same prompt. What can be learned there is how the mean
return depends on the prompt. The model is a Gaussian process over prompts: two prompts are alike as far as
they share goals, and pairs of goals in the same order, where goals are alike as far as they are near each
other. Prompts are drawn from the best trajectory so far, and that one is tried of which a draw from the
posterior is highest (Thompson sampling). The best prompt is the tried one of the highest posterior mean.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.base import Episode, Goals
from mgpo_jax.optimizers.arms import no_goals
from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace
from mgpo_jax.planning.proposals import random_prompts
from mgpo_jax.prompts import Prompt, single_goal, until_reached
from mgpo_jax.rollout import Query
from mgpo_jax.trees import choose, put_row

NUM_CANDIDATES = 16
"""New prompts that are compared in an episode."""
NEAR = 0.5
"""Distance of two goals at which they begin to differ."""
SHARE_OF_PAIRS = 0.5
"""How much of the likeness of two prompts is that of their orders."""
SHARE_OF_PROMPT = 0.3
"""Standard deviation of mean returns between prompts, in units of that of returns between episodes."""


def alike(prompt: Prompt, other: Prompt) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How many goals, and how many pairs of goals in the same order, two prompts share."""
    both = prompt.mask[:, None] & other.mask
    apart = jnp.sum((prompt.goals[:, None] - other.goals) ** 2, axis=-1)
    same = jnp.where(both, jnp.exp(-apart / (2 * NEAR**2)), 0.0)
    later = jnp.cumsum(jnp.cumsum(same[::-1, ::-1], axis=0), axis=1)[::-1, ::-1]
    after_both = jnp.pad(later[1:, 1:], ((0, 1), (0, 1)))
    return jnp.sum(same), jnp.sum(same * after_both)


def likeness(prompt: Prompt, other: Prompt) -> Float[Array, ""]:
    """The kernel of the Gaussian process: 1 for a prompt and itself."""

    def share(index: int) -> Array:
        own, others = alike(prompt, prompt)[index], alike(other, other)[index]
        shared = alike(prompt, other)[index] / jnp.sqrt(jnp.maximum(own * others, 1e-12))
        return jnp.where((own == 0) & (others == 0), 1.0, shared)  # no pairs in either

    return (1 - SHARE_OF_PAIRS) * share(0) + SHARE_OF_PAIRS * share(1)


class WorthState(NamedTuple):
    """The plan between two episodes, with room for N of them."""

    task_goal: Float[Array, "G"]
    prompts: Prompt
    """The prompts that were acted with [N]."""
    returns: Float[Array, "N"]
    kernel: Float[Array, "N N"]
    """Likeness of these prompts."""
    size: Int[Array, ""]
    best_return: Float[Array, ""]
    best_goals: Goals
    """The goals of the best trajectory so far."""


class Posterior(NamedTuple):
    """What is known of the mean returns of some prompts."""

    mean: Float[Array, "C"]
    std: Float[Array, "C"]


def posterior(state: WorthState, rows: Float[Array, "C N"]) -> Posterior:
    """The posterior of prompts whose likeness to those that were acted with is ``rows``."""
    taken = jnp.arange(len(state.returns)) < state.size
    num = jnp.maximum(state.size, 1)
    center = jnp.sum(jnp.where(taken, state.returns, 0.0)) / num
    away = jnp.where(taken, state.returns - center, 0.0)
    noise = jnp.maximum(jnp.sqrt(jnp.sum(away**2) / num), 1e-3)
    between = (SHARE_OF_PROMPT * noise) ** 2
    pairs = taken[:, None] & taken
    covariance = jnp.where(pairs, between * state.kernel, 0.0)
    covariance += noise**2 * jnp.eye(len(away))
    cross = jnp.where(taken, between * rows, 0.0)
    factor = jax.scipy.linalg.cho_factor(covariance)
    mean = center + cross @ jax.scipy.linalg.cho_solve(factor, away)
    explained = jnp.sum(cross * jax.scipy.linalg.cho_solve(factor, cross.T).T, axis=1)
    return Posterior(mean, jnp.sqrt(jnp.maximum(between - explained, 0.0)))


def plan_worth(space: SearchSpace) -> PromptOptimizer:
    """The plan in a world of which nothing is certain."""

    def init(key: PRNGKeyArray, task_goal: Float[Array, "G"]) -> WorthState:
        del key
        num, slots, goal_dim = space.num_episodes, space.num_slots, task_goal.shape[-1]
        return WorthState(
            task_goal=task_goal,
            prompts=Prompt(jnp.zeros((num, slots, goal_dim)), jnp.zeros((num, slots), bool)),
            returns=jnp.zeros(num),
            kernel=jnp.eye(num),
            size=jnp.int32(0),
            best_return=jnp.float32(-jnp.inf),
            best_goals=no_goals(space.horizon, goal_dim),
        )

    def best(state: WorthState) -> Prompt:
        # Where a prompt's return is always the same, there is nothing to estimate.
        worth = state.returns if space.deterministic else posterior(state, state.kernel).mean
        taken = jnp.arange(len(state.returns)) < state.size
        index = jnp.argmax(jnp.where(taken, worth, -jnp.inf))
        prompt = jax.tree.map(lambda rows: rows[index], state.prompts)
        return choose(state.size == 0, single_goal(state.task_goal, space.num_slots), prompt)

    return PromptOptimizer(init, partial(_ask, space), _tell, best)


def _ask(space: SearchSpace, key: PRNGKeyArray, state: WorthState) -> tuple[Query, WorthState]:
    """The drawn prompt of the highest draw from the posterior; at first (g^M), greedily."""
    key_prompt, key_draw = jax.random.split(key)
    slots, longest = space.num_slots, space.longest
    drawn = random_prompts(
        key_prompt, state.best_goals, state.task_goal, slots, longest, NUM_CANDIDATES
    )
    found = posterior(state, jax.vmap(partial(_to_all, state))(drawn))
    values = found.mean + found.std * jax.random.normal(key_draw, found.mean.shape)
    chosen = jax.tree.map(lambda rows: rows[jnp.argmax(values)], drawn)
    begins = state.size == 0
    prompt = choose(begins, single_goal(state.task_goal, slots), chosen)
    return Query(prompt, begins | space.deterministic), state


def _to_all(state: WorthState, prompt: Prompt) -> Float[Array, "N"]:
    """How like a prompt is to each of those that were acted with."""
    return jax.vmap(partial(likeness, prompt))(state.prompts)


def _tell(state: WorthState, query: Query, episode: Episode) -> WorthState:
    """The state with the result of an episode; once it is full, the last one is replaced."""
    num = len(state.returns)
    row = jnp.minimum(state.size, num - 1)
    told = state._replace(
        prompts=put_row(state.prompts, query.prompt, row),
        returns=state.returns.at[row].set(episode.return_),
        size=jnp.minimum(state.size + 1, num),
    )
    to_others = _to_all(told, query.prompt)
    improves = episode.return_ >= state.best_return
    goals = until_reached(episode.trajectory.goals, state.task_goal)
    return told._replace(
        kernel=told.kernel.at[row].set(to_others).at[:, row].set(to_others),
        best_return=jnp.maximum(episode.return_, state.best_return),
        best_goals=choose(improves, goals, state.best_goals),
    )
