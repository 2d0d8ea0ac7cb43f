"""How the method ``plan`` is made: with the model that fits what a world says of itself."""

from __future__ import annotations

from typing import Any

from envs.errors import UsageError
from mgpo_jax.adaptation import Adapter
from mgpo_jax.methods import PlanHyper, Setting
from mgpo_jax.optimizers.methods import check_prompts, prompt_adapter, search_space
from mgpo_jax.planning.maps import Features, plan_map
from mgpo_jax.policy import transformer_policy


def make_plan(setting: Setting, params: Any, hyper: PlanHyper) -> Adapter:
    policy = transformer_policy(setting.network, params)
    space = search_space(setting, hyper)
    features = Features(hyper.rehearse, hyper.splice, hyper.frontier)
    optimizer = plan_map(space, setting.env.spec, policy, hyper.num_states, features)
    return prompt_adapter(policy, optimizer, setting.judged)


def check_plan(setting: Setting, hyper: PlanHyper) -> None:
    """Raise ``UsageError`` in a world of which no model can be made."""
    check_prompts(setting, hyper)
    spec = setting.env.spec
    if not (spec.goals_are_states and spec.discrete):
        raise UsageError(
            f"plan needs a world of discrete actions whose goals say in which state it is (EnvSpec."
            f"goals_are_states), which {spec.name} does not say of itself; use ucb or bpe"
        )
