"""``plan`` in all other worlds: a Gaussian process that predicts the mean return of a prompt.

In these worlds a reached goal tells neither the state of the world nor whether it was the right goal, and
the returns of one prompt vary between episodes. What can be learned is how the mean return depends on the
prompt. The kernel of the Gaussian process compares the goals that two prompts share, and the pairs of goals
that they share in the same order; two goals count as shared to the degree that they are near each other.
Candidates are drawn from the best trajectory so far, and the one with the highest draw from the posterior
is run (Thompson sampling). The best prompt is the one with the highest posterior mean among those that were
run.
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
"""Number of candidate prompts in each episode."""
NEAR = 0.5
"""Length scale of the similarity of two goals, in units of goals."""
SHARE_OF_PAIRS = 0.5
"""Weight of shared pairs of goals in the kernel; the rest is the weight of shared goals."""
SHARE_OF_PROMPT = 0.3
"""Prior standard deviation of the mean returns of prompts, relative to that of the returns of episodes."""


def alike(prompt: Prompt, other: Prompt) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The (soft) number of goals, and of pairs of goals in the same order, that two prompts share."""
    both = prompt.mask[:, None] & other.mask
    apart = jnp.sum((prompt.goals[:, None] - other.goals) ** 2, axis=-1)
    same = jnp.where(both, jnp.exp(-apart / (2 * NEAR**2)), 0.0)
    later = jnp.cumsum(jnp.cumsum(same[::-1, ::-1], axis=0), axis=1)[::-1, ::-1]
    after_both = jnp.pad(later[1:, 1:], ((0, 1), (0, 1)))
    return jnp.sum(same), jnp.sum(same * after_both)


def likeness(prompt: Prompt, other: Prompt) -> Float[Array, ""]:
    """The kernel of the Gaussian process, in [0, 1]; it is 1 for two equal prompts."""

    def share(index: int) -> Array:
        own, others = alike(prompt, prompt)[index], alike(other, other)[index]
        shared = alike(prompt, other)[index] / jnp.sqrt(jnp.maximum(own * others, 1e-12))
        return jnp.where((own == 0) & (others == 0), 1.0, shared)  # neither has any pair

    return (1 - SHARE_OF_PAIRS) * share(0) + SHARE_OF_PAIRS * share(1)


class WorthState(NamedTuple):
    """The state of the optimizer between two episodes, with room for N episodes."""

    task_goal: Float[Array, "G"]
    prompts: Prompt
    """The prompt of each episode [N]."""
    returns: Float[Array, "N"]
    """The return of each episode."""
    kernel: Float[Array, "N N"]
    """The kernel matrix of the prompts (``likeness``)."""
    size: Int[Array, ""]
    best_return: Float[Array, ""]
    best_goals: Goals
    """The goals of the best trajectory so far."""


class Posterior(NamedTuple):
    """The posterior over the mean returns of C prompts."""

    mean: Float[Array, "C"]
    std: Float[Array, "C"]


def posterior(state: WorthState, rows: Float[Array, "C N"]) -> Posterior:
    """The posterior for C prompts, given the kernel values between them and the prompts of the N
    episodes."""
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
    """The optimizer ``plan`` for a world whose goals are no states and whose rewards confirm no goals."""

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
        # In deterministic worlds the return of a prompt is known exactly after one episode.
        worth = state.returns if space.deterministic else posterior(state, state.kernel).mean
        taken = jnp.arange(len(state.returns)) < state.size
        index = jnp.argmax(jnp.where(taken, worth, -jnp.inf))
        prompt = jax.tree.map(lambda rows: rows[index], state.prompts)
        return choose(state.size == 0, single_goal(state.task_goal, space.num_slots), prompt)

    return PromptOptimizer(init, partial(_ask, space), _tell, best)


def _ask(space: SearchSpace, key: PRNGKeyArray, state: WorthState) -> tuple[Query, WorthState]:
    """Choose the candidate with the highest draw from the posterior; the first episode runs (g^M)
    greedily."""
    key_prompt, key_draw = jax.random.split(key)
    slots, longest = space.num_slots, space.longest
    drawn = random_prompts(
        key_prompt, state.best_goals, state.task_goal, slots, longest, NUM_CANDIDATES
    )
    found = posterior(state, jax.vmap(partial(_kernel_row, state))(drawn))
    values = found.mean + found.std * jax.random.normal(key_draw, found.mean.shape)
    chosen = jax.tree.map(lambda rows: rows[jnp.argmax(values)], drawn)
    begins = state.size == 0
    prompt = choose(begins, single_goal(state.task_goal, slots), chosen)
    return Query(prompt, begins | space.deterministic), state


def _kernel_row(state: WorthState, prompt: Prompt) -> Float[Array, "N"]:
    """The kernel values between a prompt and the prompts of all episodes."""
    return jax.vmap(partial(likeness, prompt))(state.prompts)


def _tell(state: WorthState, query: Query, episode: Episode) -> WorthState:
    """Add an episode to the state; once the state is full, the newest episode replaces the last one."""
    num = len(state.returns)
    row = jnp.minimum(state.size, num - 1)
    added = state._replace(
        prompts=put_row(state.prompts, query.prompt, row),
        returns=state.returns.at[row].set(episode.return_),
        size=jnp.minimum(state.size + 1, num),
    )
    row_values = _kernel_row(added, query.prompt)
    improves = episode.return_ >= state.best_return
    goals = until_reached(episode.trajectory.goals, state.task_goal)
    return added._replace(
        kernel=added.kernel.at[row].set(row_values).at[:, row].set(row_values),
        best_return=jnp.maximum(episode.return_, state.best_return),
        best_goals=choose(improves, goals, state.best_goals),
    )
