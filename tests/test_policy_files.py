"""Policies on disk: what is saved comes back, what is broken says so, what was released acts as before."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import ArraySpec, Box
from envs.errors import DataError, UsageError
from mgpo_jax.policy_files import load_policy, read_policy, released_folder, save_policy
from mgpo_jax.prompts import single_goal
from mgpo_jax.rollout import Query, rollout
from mgpo_jax.tasks import load_tasks
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


@pytest.fixture
def policy(tmp_path: Path, params: dict) -> Path:
    save_policy(tmp_path / "policy", CONFIG, params, {"env": "maze15"})
    return tmp_path / "policy"


def rewrite(policy: Path, **changes: np.ndarray) -> None:
    """Change weights and keep the hash right, as a foreign tool might."""
    weights = {**np.load(policy / "weights.npz"), **changes}
    np.savez(policy / "weights.npz", **{k: v for k, v in weights.items() if v is not None})
    document = json.loads((policy / "config.json").read_text())
    document["sha256"] = hashlib.sha256((policy / "weights.npz").read_bytes()).hexdigest()
    (policy / "config.json").write_text(json.dumps(document))


def test_policy_comes_back(policy: Path, params: dict) -> None:
    loaded = read_policy(policy, SPEC)
    assert loaded.config == CONFIG
    assert loaded.made == {"env": "maze15"}
    assert loaded.sha256 == hashlib.sha256((policy / "weights.npz").read_bytes()).hexdigest()
    assert loaded.folder == policy
    jax.tree.map(np.testing.assert_array_equal, loaded.params, params)
    assert json.loads((policy / "config.json").read_text())["format"] == 2


def test_a_policy_in_any_folder(policy: Path) -> None:
    loaded = load_policy("maze15", policy)
    assert loaded.config == CONFIG
    with pytest.raises(DataError, match="horizon 64, maze30 needs 500"):
        load_policy("maze30", str(policy))


def test_standardization_comes_back(tmp_path: Path, params: dict) -> None:
    size = SPEC.obs.size
    config = replace(
        CONFIG, obs_mean=(0.25,) * size, obs_std=tuple(0.1 * n + 1 for n in range(size))
    )
    save_policy(tmp_path / "policy", config, params, {})
    loaded = read_policy(tmp_path / "policy", SPEC).config
    assert loaded == config
    assert hash(loaded) == hash(config)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"obs_mean": [0.0] * 4}, "obs_mean must hold 6 finite numbers"),
        ({"obs_std": [float("nan")] * 6}, "obs_std must hold 6 finite numbers"),
        ({"head": "gausian"}, "unknown head 'gausian'"),
        ({"encoder": "lineal"}, "unknown encoder 'lineal'"),
        ({"obs_dtype": "uint7"}, "not the config of a policy .*uint7"),
        ({"obs_shape": "six"}, "not the config of a policy"),
        ({"obs_shape": 6}, "not the config of a policy"),
        ({"obs_dim": 6}, "not the config of a policy .*obs_dim"),
    ],
)
def test_damaged_network_settings(policy: Path, change: dict, says: str) -> None:
    document = json.loads((policy / "config.json").read_text())
    document["network"] |= change
    (policy / "config.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match=says):
        read_policy(policy, SPEC)


def test_heads_must_fit_the_actions() -> None:
    with pytest.raises(UsageError, match="unknown head for maze15 'gaussian'"):
        network_config(SPEC, head="gaussian")
    continuous = replace(SPEC, actions=Box(5))
    assert network_config(continuous).head == "gaussian"
    with pytest.raises(UsageError, match="did you mean 'mixture'"):
        network_config(continuous, head="mixtur")


def test_unknown_encoders() -> None:
    with pytest.raises(UsageError, match="unknown encoder 'liner'; did you mean 'linear'"):
        network_config(SPEC, encoder="liner")


def test_missing_policy_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"experiments\.pretrain"):
        read_policy(tmp_path)


def test_truncated_weights(policy: Path) -> None:
    whole = (policy / "weights.npz").read_bytes()
    (policy / "weights.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match="truncated"):
        read_policy(policy)


def test_config_that_is_no_json(policy: Path) -> None:
    (policy / "config.json").write_text("{")
    with pytest.raises(DataError, match=r"config\.json is not readable JSON"):
        read_policy(policy)


def test_nan_weights(policy: Path) -> None:
    rewrite(policy, **{"params/head/bias": np.full(5, np.nan, np.float32)})
    with pytest.raises(DataError, match="params/head/bias holds NaN"):
        read_policy(policy)


def test_wrong_shape(policy: Path) -> None:
    rewrite(policy, **{"params/head/bias": np.zeros(4, np.float32)})
    with pytest.raises(DataError, match=r"shape \[4\], the network needs \[5\]"):
        read_policy(policy)


def test_foreign_weight(policy: Path) -> None:
    rewrite(policy, **{"params/tail/bias": np.zeros(4, np.float32)})
    with pytest.raises(DataError, match="params/tail/bias is foreign"):
        read_policy(policy)


def test_policy_of_another_world(policy: Path) -> None:
    with pytest.raises(DataError, match="horizon 64, maze30 needs 500"):
        read_policy(policy, envs.make("maze30").spec)


def test_an_observation_of_another_kind(policy: Path) -> None:
    for obs, says in (
        (ArraySpec((7,)), r"obs_shape \(6,\), maze15 needs \(7,\)"),
        (ArraySpec((6,), "uint8"), "obs_dtype float32, maze15 needs uint8"),
    ):
        with pytest.raises(DataError, match=says):
            read_policy(policy, replace(SPEC, obs=obs))


def test_bytes_of_any_shape_come_back(tmp_path: Path) -> None:
    spec = replace(SPEC, obs=ArraySpec((3, 2), "uint8"))
    config = network_config(spec, embed_dim=8, num_layers=1)
    save_policy(tmp_path / "policy", config, params_of(config), {})
    loaded = read_policy(tmp_path / "policy", spec).config
    assert loaded == config
    assert hash(loaded) == hash(config)
    assert loaded.obs_shape == (3, 2)


def test_other_formats(policy: Path) -> None:
    document = json.loads((policy / "config.json").read_text())
    (policy / "config.json").write_text(json.dumps({**document, "format": 3}))
    with pytest.raises(DataError, match="has format 3, this version reads 1 and 2"):
        read_policy(policy)


def test_format_1_had_flat_observations(policy: Path) -> None:
    document = json.loads((policy / "config.json").read_text())
    network = document["network"]
    network["obs_dim"] = network.pop("obs_shape")[0]
    del network["obs_dtype"], network["encoder"]
    (policy / "config.json").write_text(json.dumps({**document, "format": 1}))
    assert read_policy(policy, SPEC).config == CONFIG


# Returns, lengths and sums of actions on the first test tasks under the prompt (g^M), with key 0 split in
# six, as they were before datasets and networks had shapes of observations.
RELEASED = {
    ("maze15", True): (
        [-0.5, -0.7, -4.8, 0.2, -0.1, -2.7],
        [15, 17, 58, 8, 11, 37],
        [18, 11, 82, 6, 21, 44],
    ),
    ("maze15", False): (
        [-2.3, -2.5, -2.4, -1.4, -0.1, -3.5],
        [33, 35, 34, 24, 11, 45],
        [42, 37, 48, 26, 21, 50],
    ),
    ("gridworld", True): (
        [0, 0, 1 / 7, 1 / 3, 0, 1 / 6],
        [90] * 6,
        [147, 179, 154, 146, 218, 178],
    ),
    ("gridworld", False): (
        [1, 0, 0, 0, 0, 0],
        [38, *[90] * 5],
        [74, 177, 158, 191, 172, 195],
    ),
}


@pytest.mark.parametrize("name", ["maze15", "gridworld"])
def test_released_policies_act_as_before(name: str) -> None:
    """Their files are of format 1, with flat observations of size ``obs_dim``."""
    env, folder = envs.make(name), released_folder(envs.find(name))
    document = json.loads((folder / "config.json").read_text())
    assert document["format"] == 1
    loaded = load_policy(name)
    assert loaded.config.obs_shape == (document["network"]["obs_dim"],) == env.spec.obs.shape
    assert loaded.config.encoder == "linear"
    assert loaded.sha256 == document["sha256"]
    tasks = jax.tree.map(lambda leaf: jnp.asarray(leaf[:6]), load_tasks(folder / "tasks.npz", env))

    @jax.jit
    @lambda f: jax.vmap(f, in_axes=(0, 0, None))
    def run(key, task, greedy):
        prompt = single_goal(env.task_goal(task), loaded.policy.num_slots)
        return rollout(key, env, loaded.policy, task, Query(prompt, greedy))

    for greedy in (True, False):
        episodes = run(jax.random.split(jax.random.key(0), 6), tasks, jnp.asarray(greedy))
        returns, lengths, actions = RELEASED[name, greedy]
        np.testing.assert_allclose(episodes.return_, returns, atol=1e-5)
        np.testing.assert_array_equal(episodes.trajectory.length, lengths)
        np.testing.assert_array_equal(episodes.trajectory.actions.sum(axis=1), actions)
