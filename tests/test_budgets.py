"""The baselines spend exactly their budget of episodes, counted by the world itself."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import pytest

from envs.gridworld.env import GridWorld
from envs.registry import Judgement
from mgpo_jax import methods
from mgpo_jax.adaptation import search
from mgpo_jax.baselines import commanded, skills
from mgpo_jax.baselines.commanded import CommandConfig, complete
from mgpo_jax.baselines.skills import SkillConfig
from mgpo_jax.methods import Setting
from mgpo_jax.network_configs import network_config, world_side
from mgpo_jax.prompts import single_goal
from mgpo_jax.transformer import GoalTransformer

NUM_EPISODES = 10


class CountingGrid(GridWorld):
    episodes: ClassVar[int] = 0

    def reset(self, key: Any, task: Any) -> Any:
        jax.debug.callback(CountingGrid.count)
        return super().reset(key, task)

    @staticmethod
    def count() -> None:
        CountingGrid.episodes += 1


ENV = CountingGrid(name="gridworld", horizon=6)
SIDE = world_side(ENV.spec, None, "linear")
PARTS = {"embed_dim": 16, "num_layers": 1, "skill_steps": 2}


def network_of(kind: str) -> tuple[Any, Any]:
    """A small network of a kind, with random weights."""
    key = jax.random.key(0)
    if kind == "spirl":
        of_skills = SkillConfig(**SIDE, **PARTS, latent_dim=4)
        return of_skills, skills.init(key, of_skills)
    if kind == "ptgm":
        of_commands = complete(CommandConfig(**SIDE, **PARTS, num_heads=1, dropout=0.0), ENV, None)
        return of_commands, commanded.init(key, of_commands)
    config = network_config(
        ENV.spec, max_prompt_length=2, embed_dim=16, num_layers=1, num_heads=1, dropout=0.0
    )
    inputs = (jnp.zeros((2, *ENV.spec.obs.shape)), jnp.zeros(2, jnp.int32))
    prompt = single_goal(jnp.zeros(ENV.spec.goal_dim), 2)
    return config, GoalTransformer(config).init(key, prompt, *inputs)


CHANGES: dict[str, dict[str, Any]] = {
    "ptgm": {"batch_size": 8},
    "ptgm-goal": {"batch_size": 8},
    "ptgm-ppo": {"clusters": 3},
    "spirl": {"batch_size": 8, "warmup_episodes": 2},
}
"""Hyper-parameters of methods for a small budget."""
BASELINES = [
    name
    for name in methods.names()
    if "baselines" in str(methods.find(name).make) or name == "gcbc"
]


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_spends_its_budget_and_no_more(name: str) -> None:
    """Starting, warming up, learning and reading the result cost no episode beside the budget."""
    method = methods.find(name)
    config, params = network_of(method.policy)
    setting = Setting(ENV, config, NUM_EPISODES, Judgement())
    hyper = method.hyper(**CHANGES.get(name, {}))
    task = ENV.sample_task(jax.random.key(1))
    CountingGrid.episodes = 0

    @jax.jit
    def run(key: Any) -> Any:
        return search(key, ENV, method.adapter(setting, params, hyper), task, NUM_EPISODES)

    result = run(jax.random.key(2))
    jax.effects_barrier()
    assert CountingGrid.episodes == NUM_EPISODES == result.log.returns.size
