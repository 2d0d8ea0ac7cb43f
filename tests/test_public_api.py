"""The public names of ``mgpo_jax``, and the shortest way from a dataset to a policy that acts."""

from __future__ import annotations

import ast
import inspect
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mgpo_jax
from envs.errors import DataError, UsageError
from envs.specs import ArraySpec, Box, Discrete, EnvSpec
from mgpo_jax import Actor, Dataset, LoadedPolicy, TrainConfig, load_policy, pretrain, save_policy
from mgpo_jax.dataset import BatchPlan
from mgpo_jax.policy_files import read_policy
from mgpo_jax.sharding import device_mesh
from mgpo_jax.training import Trainer

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", mgpo_jax.__all__)
def test_every_name_is_there(name):
    value = getattr(mgpo_jax, name)
    assert not inspect.ismodule(value)
    assert callable(value)
    assert value.__doc__ or name.startswith("save")


def test_names_are_listed():
    assert set(mgpo_jax.__all__) <= set(dir(mgpo_jax))
    assert len(set(mgpo_jax.__all__)) == len(mgpo_jax.__all__)
    scope = {}
    exec("from mgpo_jax import *", scope)
    assert set(mgpo_jax.__all__) <= scope.keys()


def test_type_checkers_see_the_same_names():
    tree = ast.parse(Path(mgpo_jax.__file__).read_text())
    (block,) = [
        node for node in tree.body
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
    ]  # fmt: skip
    seen = {
        alias.asname or alias.name: (line.module, alias.name)
        for line in block.body
        for alias in line.names
    }
    assert seen == mgpo_jax._PLACE_OF


def test_other_names_are_errors():
    with pytest.raises(AttributeError, match="module 'mgpo_jax' has no attribute 'adaptt'"):
        mgpo_jax.adaptt  # noqa: B018
    assert not hasattr(mgpo_jax, "types")


HORIZON = 6
SPEC = EnvSpec(
    name="toy",
    obs=ArraySpec((3,)),
    goal_dim=2,
    actions=Discrete(3),
    horizon=HORIZON,
    return_range=(0.0, 1.0),
    truncate_in_hindsight=True,
)
CONFIG = TrainConfig(
    steps=40,
    batch_size=8,
    part_size=4,
    bucket=HORIZON,
    optimizer="adamw",
    learning_rate=2e-2,
    warmup_steps=2,
)
SIZES = {"max_prompt_length": 3, "embed_dim": 16, "num_layers": 1}


@pytest.fixture(scope="module")
def dataset():
    """The action is the entry of the observation that is set: easy to learn."""
    rng = np.random.default_rng(0)
    lengths = np.array([6, 2, 5, 1, 4, 6, 3, 6], np.int32)
    total = int(lengths.sum())
    actions = rng.integers(3, size=total).astype(np.int32)
    goals = rng.random((total, 2)).astype(np.float32)
    return Dataset(
        obs=np.eye(3, dtype=np.float32)[actions],
        actions=actions,
        achieved_goals=goals,
        goal_reached=np.ones(total, bool),
        outcomes=goals,
        lengths=lengths,
    )


@pytest.fixture(scope="module")
def policy(dataset):
    return pretrain(dataset, SPEC, CONFIG, **SIZES)


def test_pretraining_lowers_the_loss(dataset, policy):
    trainer = Trainer(CONFIG, policy.config, dataset, device_mesh(1))
    whole = [BatchPlan(np.arange(8), dataset.lengths, HORIZON)]
    before = trainer.evaluate(trainer.init().params, whole)
    after = trainer.evaluate(policy.params, whole)
    assert after["loss"] < 0.5 * before["loss"]
    assert after["accuracy"] > 0.9


def test_a_pretrained_policy_acts(policy):
    assert isinstance(policy, LoadedPolicy)
    assert policy.config.dropout == 0
    assert policy.config.max_prompt_length == 3
    assert policy.made == {"steps": 40}
    actor = Actor(policy, [[0.5, 0.5]])
    shown = [2, 0, 1, 1, 2, 0]
    rows = np.eye(3, dtype=np.float32)[shown]
    actions = [int(actor.reset(rows[0])), *(int(actor.act(row)) for row in rows[1:])]
    assert actions == shown


def test_a_pretrained_policy_can_be_kept(policy, tmp_path):
    save_policy(tmp_path / "policy", policy.config, policy.params, policy.made)
    loaded = read_policy(tmp_path / "policy", SPEC)
    assert loaded.config == policy.config
    obs = np.eye(3, dtype=np.float32)[1]
    actions = [int(Actor(one, [[0.5, 0.5]]).reset(obs)) for one in (policy, loaded)]
    assert actions == [1, 1]
    with pytest.raises(DataError, match="was trained for another world"):
        load_policy("maze15", tmp_path / "policy")


def test_pretraining_says_what_does_not_fit(dataset):
    with pytest.raises(DataError, match="dataset: obs has shape"):
        pretrain(dataset, replace(SPEC, obs=ArraySpec((4,))), CONFIG)
    with pytest.raises(DataError, match="dataset: actions has shape"):
        pretrain(dataset, replace(SPEC, actions=Box(2)), CONFIG)
    with pytest.raises(UsageError, match="--learning-rate must be above 0"):
        pretrain(dataset, SPEC, replace(CONFIG, learning_rate=0.0))
    with pytest.raises(UsageError, match="unknown encoder"):
        pretrain(dataset, SPEC, CONFIG, encoder="pixels")
    with pytest.raises(UsageError, match="unknown head for toy"):
        pretrain(dataset, SPEC, CONFIG, head="gaussian")


@pytest.mark.parametrize("own", ["envs/__init__.py", "envs.py"])
def test_packages_of_the_name_of_ours_are_named(tmp_path: Path, own: str) -> None:
    """The current folder is searched first, so that a user's ``envs`` hides the one of this project."""
    (tmp_path / own).parent.mkdir(exist_ok=True)
    (tmp_path / own).write_text("raise RuntimeError('a stranger')")
    code = "import mgpo_jax; mgpo_jax.make('maze15')"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    place = tmp_path / own.removesuffix("/__init__.py")
    assert done.stderr.strip().splitlines()[-1] == (
        f"ImportError: mgpo_jax needs its own package envs in {ROOT / 'envs'}, but Python finds {place} "
        "under that name; rename that one, or start Python in another folder"
    )
