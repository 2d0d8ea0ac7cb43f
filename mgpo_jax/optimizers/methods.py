"""Prompt optimizers as methods: each is made from its hyper-parameters and wrapped in an adapter."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from envs.agents import Agent
from envs.base import Episode
from envs.errors import UsageError
from envs.registry import Judgement
from mgpo_jax.adaptation import Adapter
from mgpo_jax.methods import (
    BbtHyper,
    BpeHyper,
    ExploreHyper,
    GripsHyper,
    NoHyper,
    PromptHyper,
    Setting,
    UcbHyper,
)
from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace
from mgpo_jax.optimizers.bbt import bbt
from mgpo_jax.optimizers.bpe import bpe
from mgpo_jax.optimizers.explore import explore
from mgpo_jax.optimizers.grips import grips
from mgpo_jax.optimizers.ucb import ucb
from mgpo_jax.policy import Policy, transformer_policy
from mgpo_jax.prompts import Prompt, single_goal
from mgpo_jax.rollout import Query, acting_as, prompted


def prompt_adapter(
    policy: Policy, optimizer: PromptOptimizer, judged: Judgement | None = None
) -> Adapter:
    """Wrap a prompt optimizer in an adapter, whose choices are prompts for a frozen policy.

    Args:
      policy: the policy that acts under the prompts.
      optimizer: the prompt optimizer.
      judged: how the best prompt is judged (default: greedily).
    """
    judged = judged or Judgement()

    def ask(key: PRNGKeyArray, state: Any) -> tuple[Query, Any]:
        query, state = optimizer.ask(key, state)
        return query._replace(temperature=jnp.ones(()) if judged.tempered else None), state

    def agent(state: Any, query: Query) -> Agent:
        del state
        return prompted(policy, query)

    def tell(key: PRNGKeyArray, state: Any, query: Query, episodes: Episode) -> Any:
        del key
        return optimizer.tell(state, query, jax.tree.map(lambda leaf: leaf[0], episodes))

    def best(state: Any) -> Query:
        return judged_query(optimizer.best(state), judged)

    return Adapter(
        init=optimizer.init,
        ask=ask,
        agent=agent,
        tell=tell,
        best=best,
        num_scored=optimizer.num_scored,
    )


def judged_query(prompt: Prompt, judged: Judgement) -> Query:
    """The query that judges a prompt."""
    greedy, temperature = acting_as(judged)
    return Query(prompt, jnp.full(prompt.mask.shape[:-1], greedy), temperature)


def fixed_prompt(num_slots: int) -> PromptOptimizer:
    """The optimizer that uses the prompt (g^M) in all episodes: goal-conditioned behavior cloning."""

    def init(key: PRNGKeyArray, task_goal: Float[Array, "G"]) -> Prompt:
        del key
        return single_goal(task_goal, num_slots)

    def ask(key: PRNGKeyArray, state: Prompt) -> tuple[Query, Prompt]:
        del key
        return Query(state, jnp.ones((), bool)), state

    return PromptOptimizer(
        init=init,
        ask=ask,
        tell=lambda state, query, episode: state,
        best=lambda state: state,
    )


def search_space(setting: Setting, hyper: PromptHyper) -> SearchSpace:
    """The search space of a prompt optimizer in a setting."""
    spec = setting.env.spec
    return SearchSpace(
        num_slots=setting.network.max_prompt_length,
        horizon=spec.horizon,
        return_range=spec.return_range,
        num_episodes=setting.num_episodes,
        sample_goal=setting.env.sample_goal,
        max_goals=hyper.max_goals,
        deterministic=spec.deterministic,
        keep_rewarded=getattr(hyper, "keep_rewarded", False) and spec.reward_confirms_goals,
    )


def make_ucb(setting: Setting, params: Any, hyper: UcbHyper) -> Adapter:
    return _to_adapter(
        setting, params, ucb(search_space(setting, hyper), c=hyper.c, scale=hyper.scale)
    )


def make_bpe(setting: Setting, params: Any, hyper: BpeHyper) -> Adapter:
    return _to_adapter(setting, params, bpe(search_space(setting, hyper), min_std=hyper.min_std))


def make_explore(setting: Setting, params: Any, hyper: ExploreHyper) -> Adapter:
    return _to_adapter(setting, params, explore(search_space(setting, hyper)))


def make_grips(setting: Setting, params: Any, hyper: GripsHyper) -> Adapter:
    return _to_adapter(
        setting, params, grips(search_space(setting, hyper), num_edits=hyper.num_edits)
    )


def make_bbt(setting: Setting, params: Any, hyper: BbtHyper) -> Adapter:
    optimizer = bbt(
        search_space(setting, hyper),
        population_size=hyper.population_size,
        latent_dim=hyper.latent_dim,
        std_init=hyper.std_init,
    )
    return _to_adapter(setting, params, optimizer)


def make_gcbc(setting: Setting, params: Any, hyper: NoHyper) -> Adapter:
    del hyper
    return _to_adapter(setting, params, fixed_prompt(setting.network.max_prompt_length))


def _to_adapter(setting: Setting, params: Any, optimizer: PromptOptimizer) -> Adapter:
    return prompt_adapter(transformer_policy(setting.network, params), optimizer, setting.judged)


def check_prompts(setting: Setting, hyper: PromptHyper) -> None:
    """Raise ``UsageError`` for prompts longer than the policy was trained with."""
    longest = setting.network.max_prompt_length
    if hyper.max_goals is not None and hyper.max_goals > longest:
        raise UsageError(
            f"--max-goals {hyper.max_goals} is longer than the policy's prompts ({longest} goals); "
            "pre-train with --max-prompt-length"
        )


def check_grips(setting: Setting, hyper: GripsHyper) -> None:
    """Raise ``UsageError`` if the world cannot sample goals to insert into a prompt."""
    check_prompts(setting, hyper)
    jax.eval_shape(setting.env.sample_goal, jax.random.key(0))
