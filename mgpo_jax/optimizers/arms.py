"""The table of prompts under trial, and Algorithm 1 around it (paper, section 3.2, appendix E.1).

UCB, BPE and the explore ablation differ only in which prompt they act with next; ``bandit`` is what they
share. The first episode evaluates (g^M) greedily. From then on episodes alternate: one acts with the chosen
prompt by sampling actions, the next evaluates a new prompt drawn from the best trajectory so far. The new
prompt becomes an arm if its return is higher than the best mean in the table.

A new prompt is evaluated greedily in deterministic worlds (as in the authors' code), where one greedy
episode gives its exact return, and by sampling actions in stochastic worlds (as in the paper's text). There
a greedy return is random as well, and sampling finds orders of goals that greedy actions never reach.

If a reward confirms the goals that led to it (``SearchSpace.keep_rewarded``; not in the paper), new prompts
keep the rewarded goals of the best trajectory and vary the goals after them, in content and in order: a
trajectory that earned k/n of a sequence had its first k parts right, and what followed was evidently wrong.

As in the authors' code, the chosen prompt acts by sampling, and the newest of several trajectories with the
best return counts as the best. Unlike in their code, an arm is inserted if it beats the best *mean* (as in
the paper), and the first evaluation counts as an episode.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import Episode, Goals
from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace
from mgpo_jax.prompts import Prompt, sample_prompt, single_goal, until_reached
from mgpo_jax.rollout import Query
from mgpo_jax.trees import choose

MAX_ARMS = 64
SHRINKAGE = 2.0  # pseudo-episodes of the table's mean return in ``estimated_returns``


class Arms(NamedTuple):
    """A table of M prompts with statistics of their returns; rows from ``size`` on are free."""

    prompts: Prompt
    pulls: Float[Array, "M"]
    mean: Float[Array, "M"]
    sum_sq: Float[Array, "M"]
    """Sum of squared deviations from the mean (Welford)."""
    entry_return: Float[Array, "M"]
    """Return of the episode after which the prompt was inserted."""
    size: Int[Array, ""]

    @property
    def taken(self) -> Bool[Array, "M"]:
        return jnp.arange(len(self.pulls)) < self.size

    @property
    def std(self) -> Float[Array, "M"]:
        """Population standard deviation of each arm's returns."""
        return jnp.sqrt(self.sum_sq / jnp.maximum(self.pulls, 1))

    def prompt(self, arm: Int[Array, ""]) -> Prompt:
        return jax.tree.map(lambda rows: rows[arm], self.prompts)


def empty_arms(num_arms: int, num_slots: int, goal_dim: int) -> Arms:
    prompts = Prompt(
        jnp.zeros((num_arms, num_slots, goal_dim)), jnp.zeros((num_arms, num_slots), bool)
    )
    zeros = jnp.zeros(num_arms)
    return Arms(
        prompts=prompts,
        pulls=zeros,
        mean=zeros,
        sum_sq=zeros,
        entry_return=jnp.full(num_arms, -jnp.inf),
        size=jnp.int32(0),
    )


def no_goals(horizon: int, goal_dim: int) -> Goals:
    """The goals of an episode without steps."""
    nothing = jnp.zeros((horizon, goal_dim))
    return Goals(
        achieved_goals=nothing,
        goal_reached=jnp.zeros(horizon, bool),
        outcomes=nothing,
        length=jnp.int32(0),
    )


def insert_arm(arms: Arms, prompt: Prompt, return_: Float[Array, ""]) -> Arms:
    """Insert a prompt with one return; in a full table it replaces the arm of the lowest
    ``entry_return``."""
    worst = jnp.argmin(jnp.where(arms.taken, arms.entry_return, jnp.inf))
    row = jnp.where(arms.size < len(arms.pulls), arms.size, worst)
    return Arms(
        prompts=jax.tree.map(lambda rows, new: rows.at[row].set(new), arms.prompts, prompt),
        pulls=arms.pulls.at[row].set(1.0),
        mean=arms.mean.at[row].set(return_),
        sum_sq=arms.sum_sq.at[row].set(0.0),
        entry_return=arms.entry_return.at[row].set(return_),
        size=jnp.minimum(arms.size + 1, len(arms.pulls)),
    )


def estimated_returns(arms: Arms, deterministic: bool) -> Float[Array, "M"]:
    """The estimated return of each prompt when it acts greedily; -inf for free rows.

    In a deterministic world this is the return of its one greedy evaluation. In a stochastic world a single
    return is random, and the best of many is mostly luck (the authors' code reports it). There the estimate
    is the mean of all returns of the arm, shrunk towards the mean of the whole table as if the arm had
    ``SHRINKAGE`` more episodes of that return.
    """
    if deterministic:
        return arms.entry_return
    overall = jnp.sum(arms.pulls * arms.mean) / jnp.maximum(jnp.sum(arms.pulls), 1)
    shrunk = (arms.pulls * arms.mean + SHRINKAGE * overall) / (arms.pulls + SHRINKAGE)
    return jnp.where(arms.taken, shrunk, -jnp.inf)


def update_arm(arms: Arms, arm: Int[Array, ""], return_: Float[Array, ""]) -> Arms:
    """Add one return to the history of an arm."""
    pulls = arms.pulls[arm] + 1
    delta = return_ - arms.mean[arm]
    mean = arms.mean[arm] + delta / pulls
    return arms._replace(
        pulls=arms.pulls.at[arm].set(pulls),
        mean=arms.mean.at[arm].set(mean),
        sum_sq=arms.sum_sq.at[arm].add(delta * (return_ - mean)),
    )


class BanditState(NamedTuple):
    """The state of Algorithm 1 between two episodes."""

    task_goal: Float[Array, "G"]
    arms: Arms
    episode: Int[Array, ""]
    """Number of episodes so far."""
    arm: Int[Array, ""]
    """The arm chosen last."""
    newest: Prompt
    """The prompt drawn last from the best trajectory."""
    best_return: Float[Array, ""]
    """R*."""
    best_goals: Goals
    """The goals of tau*, the best trajectory so far; none before the first episode."""
    confirmed: Bool[Array, "T"]
    """Which steps of tau* reached a goal and were rewarded."""


Select = Callable[[PRNGKeyArray, BanditState], Int[Array, ""]]


# Long because the four functions of an optimizer share its settings and are read together.
def bandit(space: SearchSpace, select: Select, act_with_newest: bool = False) -> PromptOptimizer:
    """Algorithm 1 with a rule that chooses arms.

    Args:
      space: the search space.
      select: ``(key, state) -> arm``, the index of the arm to act with.
      act_with_newest: act with the newest prompt instead, whether it is an arm or not (the explore
        ablation).
    """
    num_arms = min(MAX_ARMS, 1 + space.num_episodes // 2)

    def init(key: PRNGKeyArray, task_goal: Float[Array, "G"]) -> BanditState:
        del key
        goal_dim = task_goal.shape[-1]
        return BanditState(
            task_goal=task_goal,
            arms=empty_arms(num_arms, space.num_slots, goal_dim),
            episode=jnp.int32(0),
            arm=jnp.int32(0),
            newest=single_goal(task_goal, space.num_slots),
            best_return=jnp.float32(-jnp.inf),
            best_goals=no_goals(space.horizon, goal_dim),
            confirmed=jnp.zeros(space.horizon, bool),
        )

    def ask(key: PRNGKeyArray, state: BanditState) -> tuple[Query, BanditState]:
        key_select, key_prompt = jax.random.split(key)
        acts = state.episode % 2 == 1
        arm = select(key_select, state)
        chosen = state.newest if act_with_newest else state.arms.prompt(arm)
        drawn = sample_prompt(
            key_prompt,
            state.best_goals,
            state.task_goal,
            space.num_slots,
            space.max_goals,
            state.confirmed if space.keep_rewarded else None,
        )
        keeps = acts | (state.episode == 0)
        newest = choose(keeps, state.newest, drawn)
        prompt = choose(acts, chosen, newest)
        # In stochastic worlds greedy returns are noisy, so new prompts are evaluated by sampling.
        greedy = (state.episode == 0) | (~acts & space.deterministic)
        return Query(prompt, greedy), state._replace(arm=arm, newest=newest)

    def tell(state: BanditState, query: Query, episode: Episode) -> BanditState:
        return_ = episode.return_
        best_mean = jnp.max(jnp.where(state.arms.taken, state.arms.mean, -jnp.inf))
        acted = state.episode % 2 == 1
        inserts = ~acted & (return_ > best_mean)
        sampled = acted & (not act_with_newest)
        inserted = insert_arm(state.arms, query.prompt, return_)
        updated = update_arm(state.arms, state.arm, return_)
        improves = return_ >= state.best_return
        return state._replace(
            arms=choose(inserts, inserted, choose(sampled, updated, state.arms)),
            episode=state.episode + 1,
            best_return=jnp.maximum(return_, state.best_return),
            best_goals=choose(
                improves,
                until_reached(episode.trajectory.goals, state.task_goal),
                state.best_goals,
            ),
            confirmed=jnp.where(
                improves, episode.trajectory.goal_reached & (episode.rewards > 0), state.confirmed
            ),
        )

    def best(state: BanditState) -> Prompt:
        best_arm = jnp.argmax(estimated_returns(state.arms, space.deterministic))
        # Before the first episode there are no arms, and the newest prompt is (g^M).
        return choose(state.arms.size == 0, state.newest, state.arms.prompt(best_arm))

    return PromptOptimizer(init, ask, tell, best)
