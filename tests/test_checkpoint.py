"""Released policies and training checkpoints: what is saved comes back, what is broken says so."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import envs
from mgpo_jax.checkpoint import (
    checkpoints,
    load_policy_files,
    network_config,
    restore_state,
    save_policy,
    save_state,
)
from mgpo_jax.errors import DataError, UsageError
from mgpo_jax.pretrain import TrainConfig, TrainState, make_optimizer
from mgpo_jax.prompts import single_goal
from mgpo_jax.transformer import GoalTransformer, TransformerConfig

SPEC = envs.make("maze15").spec
CONFIG = network_config(SPEC, embed_dim=8, num_layers=1)


def params_of(config: TransformerConfig) -> dict:
    prompt = single_goal(jnp.zeros(config.goal_dim), config.max_prompt_length)
    obs, actions = jnp.zeros((1, config.obs_dim)), jnp.zeros(1, jnp.int32)
    return GoalTransformer(config).init(jax.random.key(0), prompt, obs, actions)


@pytest.fixture(scope="module")
def params() -> dict:
    return params_of(CONFIG)


@pytest.fixture
def policy(tmp_path: Path, params: dict) -> Path:
    save_policy(tmp_path / "policy", CONFIG, params, {"env": "maze15"})
    return tmp_path / "policy"


def rewrite(policy: Path, **changes: np.ndarray) -> None:
    """Change weights and keep the hash right, as a foreign tool might."""
    weights = {**np.load(policy / "weights.npz"), **changes}
    np.savez(policy / "weights.npz", **{k: v for k, v in weights.items() if v is not None})
    document = json.loads((policy / "config.json").read_text())
    import hashlib

    document["sha256"] = hashlib.sha256((policy / "weights.npz").read_bytes()).hexdigest()
    (policy / "config.json").write_text(json.dumps(document))


def test_policy_comes_back(policy: Path, params: dict) -> None:
    config, loaded, made = load_policy_files(policy, SPEC)
    assert config == CONFIG
    assert made == {"env": "maze15"}
    jax.tree.map(np.testing.assert_array_equal, loaded, params)


def test_standardization_comes_back(tmp_path: Path, params: dict) -> None:
    size = SPEC.obs_dim
    config = replace(
        CONFIG, obs_mean=(0.25,) * size, obs_std=tuple(0.1 * n + 1 for n in range(size))
    )
    save_policy(tmp_path / "policy", config, params, {})
    loaded, _, _ = load_policy_files(tmp_path / "policy", SPEC)
    assert loaded == config
    assert hash(loaded) == hash(config)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"obs_mean": [0.0] * 4}, "obs_mean must hold 6 finite numbers"),
        ({"obs_std": [float("nan")] * 6}, "obs_std must hold 6 finite numbers"),
        ({"head": "gausian"}, "unknown head 'gausian'"),
    ],
)
def test_damaged_network_settings(policy: Path, change: dict, says: str) -> None:
    document = json.loads((policy / "config.json").read_text())
    document["network"] |= change
    (policy / "config.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match=says):
        load_policy_files(policy, SPEC)


def test_heads_must_fit_the_actions() -> None:
    with pytest.raises(UsageError, match="unknown head for maze15 'gaussian'"):
        network_config(SPEC, head="gaussian")
    continuous = replace(SPEC, discrete=False)
    assert network_config(continuous).head == "gaussian"
    with pytest.raises(UsageError, match="did you mean 'mixture'"):
        network_config(continuous, head="mixtur")


def test_missing_policy_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"experiments\.pretrain"):
        load_policy_files(tmp_path)


def test_truncated_weights(policy: Path) -> None:
    whole = (policy / "weights.npz").read_bytes()
    (policy / "weights.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match="truncated"):
        load_policy_files(policy)


def test_config_that_is_no_json(policy: Path) -> None:
    (policy / "config.json").write_text("{")
    with pytest.raises(DataError, match="not the config of a policy"):
        load_policy_files(policy)


def test_nan_weights(policy: Path) -> None:
    rewrite(policy, **{"params/head/bias": np.full(5, np.nan, np.float32)})
    with pytest.raises(DataError, match="params/head/bias holds NaN"):
        load_policy_files(policy)


def test_wrong_shape(policy: Path) -> None:
    rewrite(policy, **{"params/head/bias": np.zeros(4, np.float32)})
    with pytest.raises(DataError, match=r"shape \[4\], the network needs \[5\]"):
        load_policy_files(policy)


def test_foreign_weight(policy: Path) -> None:
    rewrite(policy, **{"params/tail/bias": np.zeros(4, np.float32)})
    with pytest.raises(DataError, match="params/tail/bias is foreign"):
        load_policy_files(policy)


def test_policy_of_another_world(policy: Path) -> None:
    with pytest.raises(DataError, match="horizon 64, maze30 needs 500"):
        load_policy_files(policy, envs.make("maze30").spec)


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
from mgpo_jax.pretrain import TrainState
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
