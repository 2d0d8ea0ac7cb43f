"""The factory of the method ``plan``, which chooses the kind of model by the world's specification."""

from __future__ import annotations

from typing import Any

from mgpo_jax.adaptation import Adapter
from mgpo_jax.methods import PlanHyper, Setting
from mgpo_jax.optimizers.methods import prompt_adapter, search_space
from mgpo_jax.planning.maps import plan_map
from mgpo_jax.planning.orders import plan_order
from mgpo_jax.planning.searching import Features
from mgpo_jax.planning.worths import plan_worth
from mgpo_jax.policy import transformer_policy


def make_plan(setting: Setting, params: Any, hyper: PlanHyper) -> Adapter:
    policy = transformer_policy(setting.network, params)
    space = search_space(setting, hyper)
    features = Features(hyper.rehearse, hyper.steer, hyper.splice, hyper.frontier)
    spec = setting.env.spec
    if spec.goals_are_states and spec.discrete:
        optimizer = plan_map(space, spec, policy, hyper.num_states, features)
    elif spec.reward_confirms_goals:
        optimizer = plan_order(space)
    else:
        optimizer = plan_worth(space)
    return prompt_adapter(policy, optimizer, setting.judged)
