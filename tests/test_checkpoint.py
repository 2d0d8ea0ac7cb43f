"""Training checkpoints: what is saved comes back, what is broken says so."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import envs
from envs.errors import DataError
from mgpo_jax.checkpoint import checkpoints, restore_state, save_state
from mgpo_jax.prompts import single_goal
from mgpo_jax.settings import TrainConfig
from mgpo_jax.training import TrainState, make_optimizer
from mgpo_jax.transformer import GoalTransformer, TransformerConfig, network_config

SPEC = envs.make("maze15").spec
CONFIG = network_config(SPEC, embed_dim=8, num_layers=1)


def params_of(config: TransformerConfig) -> dict:
    prompt = single_goal(jnp.zeros(config.goal_dim), config.max_prompt_length)
    obs, actions = jnp.zeros((1, *config.obs_shape)), jnp.zeros(1, jnp.int32)
    return GoalTransformer(config).init(jax.random.key(0), prompt, obs, actions)


@pytest.fixture(scope="module")
def params() -> dict:
    return params_of(CONFIG)


def train_state(params: dict, step: int) -> TrainState:
    weights, unravel = ravel_pytree(params)
    opt_state = make_optimizer(TrainConfig(), unravel).init(weights)
    filled = jax.tree.map(lambda leaf: jnp.full_like(leaf, step), (params, opt_state))
    return TrainState(*filled, step)


def test_state_comes_back(tmp_path: Path, params: dict) -> None:
    blank = train_state(params, 0)
    with checkpoints(tmp_path) as manager:
        assert restore_state(manager, blank) is None
        for step in (3, 7):
            save_state(manager, train_state(params, step))
    with checkpoints(tmp_path) as manager:
        state = restore_state(manager, blank)
    assert state is not None
    assert state.step == 7
    assert jax.tree.structure(state) == jax.tree.structure(blank)
    jax.tree.map(np.testing.assert_array_equal, state, train_state(params, 7))


def test_state_of_another_network(tmp_path: Path, params: dict) -> None:
    with checkpoints(tmp_path) as manager:
        save_state(manager, train_state(params, 1))
    other = params_of(network_config(SPEC, embed_dim=16, num_layers=1))
    with checkpoints(tmp_path) as manager, pytest.raises(DataError, match="of another network"):
        restore_state(manager, train_state(other, 0))


SAVER = """
import sys, itertools, jax.numpy as jnp
from mgpo_jax.checkpoint import checkpoints, save_state
from mgpo_jax.training import TrainState
with checkpoints(sys.argv[1]) as manager:
    for step in itertools.count(1):
        leaf = jnp.full((400, 400), step, jnp.float32)
        save_state(manager, TrainState({"a": leaf, "b": leaf}, (leaf,), step))
        print(step, flush=True)
"""


def test_kill_in_mid_save_loses_nothing(tmp_path: Path) -> None:
    """SIGKILL at any moment leaves a newest checkpoint that is whole."""
    process = subprocess.Popen(
        [sys.executable, "-c", SAVER, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) == 6:
            break
    time.sleep(0.013)  # somewhere within the next save
    process.send_signal(signal.SIGKILL)
    process.wait()
    blank = jnp.zeros((400, 400))
    with checkpoints(tmp_path) as manager:
        state = restore_state(manager, TrainState({"a": blank, "b": blank}, (blank,), 0))
    assert state is not None
    assert state.step >= 4  # saves run in the background, at most one behind
    for leaf in jax.tree.leaves((state.params, state.opt_state)):
        np.testing.assert_array_equal(leaf, state.step)
