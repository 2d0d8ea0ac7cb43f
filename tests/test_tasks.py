"""Tasks of training, evaluation and test never meet; what is evaluated on the way of a training."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from experiments.collect import find_demonstrator
from experiments.pretrain import greedy_evaluation
from experiments.tasks import benchmark_tasks, evaluation_tasks, num_tasks, task_hashes
from mgpo_jax.checkpoint import network_config
from mgpo_jax.prompts import single_goal
from mgpo_jax.transformer import GoalTransformer


@pytest.mark.parametrize("name", ["maze15", "gridworld", "kitchen"])
def test_evaluation_tasks_are_no_test_tasks(name):
    env = envs.make(name)
    tasks = evaluation_tasks(env, 64)
    assert num_tasks(tasks) == 64
    assert not np.isin(task_hashes(env, tasks), task_hashes(env, benchmark_tasks(env))).any()


@pytest.mark.parametrize(("name", "demonstrates"), [("gridworld", True), ("maze15", False)])
def test_what_a_policy_makes_of_a_demonstration(name, demonstrates):
    """Is measured where the demonstrator does the task at hand."""
    env = envs.make(name)
    config = network_config(env.spec, embed_dim=8, num_layers=1, num_heads=1, dropout=0.0)
    _, demonstrator = find_demonstrator(env, None)
    prompt = single_goal(env.task_goal(env.sample_task(jax.random.key(0))), 5)
    obs = jnp.zeros((2, env.spec.obs_dim))
    params = GoalTransformer(config).init(jax.random.key(0), prompt, obs, jnp.zeros(2, jnp.int32))
    found = greedy_evaluation(env, config, demonstrator, 4)(params)
    assert ("eval/followed_return" in found) == demonstrates
    assert all(np.isfinite(value) for value in found.values())
    assert found["eval/initial_return"] < 0.9
