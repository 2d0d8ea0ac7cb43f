"""Policies on disk: round trips, clear errors for damage, and released policies that act as before."""

from __future__ import annotations

import hashlib
import json
import os
import time
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.errors import DataError, UsageError
from envs.specs import ArraySpec, Box, ObsLayout
from mgpo_jax.network_configs import TransformerConfig, network_config
from mgpo_jax.policy_files import load_policy, read_policy, save_policy
from mgpo_jax.prompts import single_goal
from mgpo_jax.released import released_folder
from mgpo_jax.rollout import Query, rollout
from mgpo_jax.tasks import load_tasks
from mgpo_jax.transformer import GoalTransformer

SPEC = envs.make("maze15").spec
CONFIG = network_config(SPEC, embed_dim=8, num_layers=1)


LAYOUT = {"num_cells": 2, "code_sizes": [3, 2], "num_counts": 3, "max_count": 4}


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


def test_a_layout_of_observations_comes_back(tmp_path: Path) -> None:
    layout = ObsLayout(num_cells=2, code_sizes=(3, 2), num_counts=3, max_count=4)
    spec = replace(SPEC, layout=layout)
    config = network_config(
        spec, embed_dim=8, num_layers=1, encoder="cells", tokens_per_step=1, num_heads=2
    )
    params = params_of(config)
    save_policy(tmp_path / "policy", config, params, {})
    loaded = read_policy(tmp_path / "policy", spec)
    assert loaded.config == config
    assert hash(loaded.config) == hash(config)
    jax.tree.map(np.testing.assert_array_equal, loaded.params, params)
    with pytest.raises(DataError, match=r"has obs_layout ObsLayout.*another world"):
        read_policy(tmp_path / "policy", SPEC)


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
        ({"obs_mean": [0.0] * 4}, "network.obs_mean must hold 6 numbers or none, found 4"),
        ({"obs_mean": [0.0] * 6}, "network.obs_std must hold as many numbers as obs_mean, found 0"),
        ({"obs_mean": 1.0}, "network.obs_mean must be a list, found 1.0"),
        ({"obs_std": [float("nan")] * 6}, r"network.obs_std must be a finite number, found \[nan"),
        ({"obs_std": [0.0] * 6}, "network.obs_std.0 must be above 0, found 0.0"),
        ({"obs_std": [-1.0] * 6}, "network.obs_std.0 must be above 0, found -1.0"),
        ({"head": "gausian"}, "network.head must be one of .*mixture.*, found 'gausian'"),
        ({"encoder": "lineal"}, "network.encoder must be one of linear, cells, .*found 'lineal'"),
        ({"obs_dtype": "uint7"}, "network.obs_dtype must be one of .*uint8.*, found 'uint7'"),
        ({"obs_shape": "six"}, "network.obs_shape must be a list, found 'six'"),
        ({"obs_shape": 6}, "network.obs_shape must be a list, found 6"),
        ({"obs_dim": 6}, "has the unknown entry network.obs_dim"),
        ({"dropout": True}, "network.dropout must be a number, found True"),
        ({"dropout": 1.5}, "network.dropout must be below 1, found 1.5"),
        ({"prompt_order": "yes"}, "network.prompt_order must be true or false, found 'yes'"),
        ({"tokens_per_step": 3}, "network.tokens_per_step must be 2 or 1, found 3"),
        ({"tokens_per_step": "1"}, "network.tokens_per_step must be 2 or 1, found '1'"),
        ({"encoder": "cells"}, "network.obs_layout must not be null with encoder cells"),
        ({"obs_layout": LAYOUT}, "network.obs_layout does not apply to encoder linear"),
        ({"obs_layout": {"num_cells": 2}}, "lacks network.obs_layout.code_sizes"),
        ({"obs_layout": {**LAYOUT, "more": 1}}, "has the unknown entry network.obs_layout.more"),
        (
            {"obs_layout": {**LAYOUT, "num_cells": "2"}},
            "network.obs_layout.num_cells must be an integer, found '2'",
        ),
        (
            {"obs_layout": {**LAYOUT, "num_cells": 4}, "encoder": "cells"},
            r"network.obs_layout must describe a flat observation, found .* of shape \[6\]",
        ),
        (
            {"obs_layout": {**LAYOUT, "max_count": -1}, "encoder": "cells"},
            "network.obs_layout must hold no negative numbers and code sizes of at least 1",
        ),
        (
            {"obs_layout": {**LAYOUT, "code_sizes": [10**12]}, "encoder": "cells"},
            "network.obs_layout must have 1 to 1048576 codes and counts",
        ),
        ({"num_heads": 3}, "network.num_heads must divide embed_dim 8, found 3"),
        ({"num_heads": 0}, "network.num_heads must be at least 1, found 0"),
        ({"num_heads": True}, "network.num_heads must be an integer, found True"),
        ({"num_layers": None}, "network.num_layers must be an integer, found None"),
        ({"num_layers": 2.5}, "network.num_layers must be an integer, found 2.5"),
        ({"num_layers": 2}, r"weights.npz has the weights of 1 blocks, .* num_layers 2"),
        ({"num_layers": 10**6}, "network.num_layers must be at most 256, found 1000000"),
        ({"num_layers": 10**400}, "network.num_layers must be at most 256, found 1"),
        ({"embed_dim": 10**12}, "network.embed_dim must be at most 16384, found 1"),
        ({"horizon": -1}, "network.horizon must be at least 1, found -1"),
    ],
)
def test_damaged_network_settings(policy: Path, change: dict, says: str) -> None:
    document = json.loads((policy / "config.json").read_text())
    document["network"] |= change
    (policy / "config.json").write_text(json.dumps(document))
    began = time.monotonic()
    with pytest.raises(DataError, match=says):
        read_policy(policy, SPEC)
    assert time.monotonic() - began < 1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"format": True}, "config.json: format must be an integer, found True"),
        ({"network": [1]}, "config.json: network must be an object"),
        ({"network": None}, "config.json: network must be an object, found None"),
        ({"made": 7}, "config.json: made must be an object, found 7"),
        (
            {"made": {"env": "../../x"}},
            r"made.env is not a name that is allowed here, found '../../x'",
        ),
        ({"made": {"steps": 1.5}}, r"made.steps must be an integer, found 1.5"),
        (
            {"sha256": "0"},
            "config.json: sha256 must be a SHA-256, 64 hexadecimal digits, found '0'",
        ),
        ({"more": 1}, "has the unknown entry more"),
    ],
)
def test_damaged_configs(policy: Path, change: dict, says: str) -> None:
    document = json.loads((policy / "config.json").read_text())
    (policy / "config.json").write_text(json.dumps({**document, **change}))
    with pytest.raises(DataError, match=says + ".*train it again") as caught:
        read_policy(policy, SPEC)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["format", "network", "made", "sha256"])
def test_configs_that_lack_an_entry(policy: Path, name: str) -> None:
    document = json.loads((policy / "config.json").read_text())
    del document[name]
    (policy / "config.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match=f"config.json lacks {name}; .*train it again"):
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


@pytest.mark.parametrize(
    ("weights", "says"),
    [
        (np.full(5, 3e38, np.float32), r"head/bias holds 3e\+38 at \[0\], must be from -1e\+18"),
        (np.zeros(5, complex), "head/bias must hold numbers, found complex128"),
        (np.zeros(5, bool), "head/bias must hold numbers, found bool"),
    ],
)
def test_weights_that_are_no_numbers(policy: Path, weights: np.ndarray, says: str) -> None:
    rewrite(policy, **{"params/head/bias": weights})
    with pytest.raises(DataError, match=says):
        read_policy(policy)


def test_weights_of_a_foreign_tool(policy: Path) -> None:
    """Big-endian doubles in the order of Fortran are the same weights."""
    before = read_policy(policy).params["params"]["embed_obs"]["kernel"]
    foreign = np.asfortranarray(np.asarray(before).astype(">f8"))
    rewrite(policy, **{"params/embed_obs/kernel": foreign})
    after = read_policy(policy).params["params"]["embed_obs"]["kernel"]
    assert after.dtype == before.dtype == np.float32
    np.testing.assert_array_equal(after, before)


def test_a_policy_is_whole_or_absent(
    policy: Path, params: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where writing it breaks off, there is the policy of before or none."""
    before = read_policy(policy)

    def stop(path: Path) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("mgpo_jax.policy_files.hash_file", stop)
    for folder in (policy, policy.with_name("new")):
        with pytest.raises(KeyboardInterrupt):
            save_policy(folder, CONFIG, params, {"steps": 1})
    assert [path.name for path in policy.parent.iterdir()] == ["policy"]
    monkeypatch.undo()
    assert (read_policy(policy).made, read_policy(policy).sha256) == (before.made, before.sha256)
    save_policy(policy, CONFIG, params, {"steps": 1})
    assert read_policy(policy).made == {"steps": 1}


def test_a_policy_keeps_the_files_beside_it(policy: Path, params: dict) -> None:
    (policy / "README.md").write_text("a card")
    (policy / "more").mkdir()
    (policy / "more/tasks.npz").write_bytes(b"tasks")
    link = policy.with_name("link")
    link.symlink_to(policy)
    for number, folder in enumerate((policy, link)):
        save_policy(folder, CONFIG, params, {"steps": number})
        assert read_policy(policy).made == {"steps": number}
        assert (policy / "README.md").read_text() == "a card"
        assert (policy / "more/tasks.npz").read_bytes() == b"tasks"
    assert link.is_symlink()
    assert {path.name for path in policy.parent.iterdir()} == {"policy", "link"}


def test_two_policies_are_exchanged_whole(
    policy: Path, params: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before and after each renaming, one of the two is there."""
    places = (policy, policy.with_name("policy.partial") / "before")
    seen: list[dict] = []
    rename = os.rename

    def watched(source: Path, target: Path) -> None:
        for step in (lambda: None, lambda: rename(source, target)):
            step()
            seen.append(next(read_policy(one).made for one in places if one.exists()))

    monkeypatch.setattr("os.rename", watched)
    save_policy(policy, CONFIG, params, {"steps": 1})
    old, new = {"env": "maze15"}, {"steps": 1}
    assert seen == [old, old, old, new]


@pytest.mark.parametrize("exchanged", [False, True])
def test_a_killed_exchange_of_policies_is_mended(
    policy: Path, params: dict, exchanged: bool
) -> None:
    """A process was killed between two renamings, or before it removed the old policy."""
    partial = policy.with_name("policy.partial")
    partial.mkdir()
    (partial / ".lock").touch()
    (policy / "card.md").write_text("mine")
    policy.rename(partial / "before")
    if exchanged:
        (policy.parent / "made").mkdir()
        save_policy(policy.parent / "made/new", CONFIG, params, {"steps": 1})
        (policy.parent / "made/new").rename(policy)
        (policy.parent / "made").rmdir()
        (policy / "card.md").write_text("mine")
    save_policy(policy, CONFIG, params, {"steps": 2})
    assert read_policy(policy).made == {"steps": 2}
    assert (policy / "card.md").read_text() == "mine"
    assert [path.name for path in policy.parent.iterdir()] == ["policy"]


def test_weights_that_are_not_finite_are_not_written(tmp_path: Path, params: dict) -> None:
    broken = jax.tree.map(lambda leaf: leaf * jnp.nan, params)
    with pytest.raises(
        DataError, match=r"policy was not saved to .*policy: the weight params/.* holds NaN"
    ):
        save_policy(tmp_path / "policy", CONFIG, broken, {})
    assert not list(tmp_path.iterdir())


def test_wrong_shape(policy: Path) -> None:
    rewrite(policy, **{"params/head/bias": np.zeros(4, np.float32)})
    with pytest.raises(DataError, match=r"head/bias has shape \[4\], wanted \[5\]"):
        read_policy(policy)


def test_foreign_weight(policy: Path) -> None:
    rewrite(policy, **{"params/tail/bias": np.zeros(4, np.float32)})
    with pytest.raises(DataError, match="has the unexpected array params/tail/bias"):
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
