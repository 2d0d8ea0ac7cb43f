"""Kinds of networks: each is trained, saved, loaded, and distinguished from the others."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np
import pytest
from test_training import DATASET

import envs
from envs.errors import DataError, UsageError
from envs.specs import ArraySpec, Discrete, EnvSpec
from experiments.networks import sized_network
from experiments.store.presets import check_pretraining, pretrain_preset
from experiments.store.settings import PretrainConfig
from mgpo_jax import methods
from mgpo_jax.baselines.commanded import CommandConfig
from mgpo_jax.baselines.skills import SkillConfig
from mgpo_jax.kinds import KINDS, MULTI_GOAL, Kind, Learned, kind_of
from mgpo_jax.network_configs import NetworkConfig, TransformerConfig, world_side
from mgpo_jax.policy_files import load_policy, read_policy, save_policy
from mgpo_jax.released import released_folder
from mgpo_jax.settings import TrainConfig
from mgpo_jax.sharding import device_mesh
from mgpo_jax.training import Trainer, batch_stream

SPEC = EnvSpec(
    name="tiny",
    obs=ArraySpec((3,)),
    goal_dim=2,
    actions=Discrete(3),
    horizon=6,
    return_range=(0.0, 1.0),
)
SIDE = world_side(SPEC, None, "linear")
TINY = {
    "mgpo": TransformerConfig(**SIDE, embed_dim=16, num_layers=1, dropout=0.0),
    "ptgm": CommandConfig(
        **SIDE, embed_dim=16, num_layers=1, dropout=0.0, max_prompt_length=1,
        commands=((0.0, 0.0), (0.5, 0.5), (1.0, 1.0)), every_position=True, ahead=2,
    ),
    "spirl": SkillConfig(**SIDE, embed_dim=16, num_layers=1, skill_steps=2, latent_dim=3),
}  # fmt: skip
TRAIN = TrainConfig(
    steps=300, batch_size=8, part_size=4, learning_rate=3e-3, warmup_steps=5, optimizer="adamw"
)


def test_every_kind_is_tried():
    assert set(TINY) == set(KINDS.names())
    assert {kind_of(config).name for config in TINY.values()} == set(TINY)


def test_a_kind_found_by_its_place_is_known_by_its_networks(monkeypatch):
    @dataclass(frozen=True)
    class OwnConfig(NetworkConfig):
        """Of a kind that is registered nowhere."""

    config = OwnConfig(**SIDE)
    with pytest.raises(UsageError, match="no kind of network has the config OwnConfig"):
        kind_of(config)

    learned = Learned(config=OwnConfig, init=lambda *args: None, loss=lambda *args: None)
    own = Kind(name="own", learned=learned, title="Own", watched="nothing")
    monkeypatch.setitem(KINDS._loaded, "own_kind:KIND", own)
    assert kind_of(config) is own


@pytest.mark.parametrize("name", TINY)
def test_a_kind_learns_to_act(name):
    """The action is the entry of the observation that is set; of a skill, what the actions were."""
    trainer = Trainer(TRAIN, TINY[name], DATASET, device_mesh(1))
    state, rows = trainer.init(), []
    stream = batch_stream(TRAIN, DATASET, truncate=False)
    for _ in range(TRAIN.steps):
        state, metrics = trainer.step(state, next(stream))
        rows.append({name: float(value) for name, value in metrics.items()})
    assert rows[0]["accuracy"] < 0.8
    assert np.mean([row["accuracy"] for row in rows[-10:]]) > 0.9
    assert np.mean([row["loss"] for row in rows[-10:]]) < 0.5 * rows[0]["loss"]


@pytest.mark.parametrize("name", TINY)
def test_a_kind_comes_back_from_disk(name, tmp_path):
    config = TINY[name]
    params = KINDS.find(name).load().init(jax.random.key(0), config)
    save_policy(tmp_path / "policy", config, params, {"env": "tiny"})
    document = json.loads((tmp_path / "policy" / "config.json").read_text())
    assert document.get("kind", MULTI_GOAL) == name
    found = read_policy(tmp_path / "policy", SPEC)
    assert found.config == config
    same = jax.tree.map(lambda a, b: bool(np.array_equal(a, b)), found.params, params)
    assert all(jax.tree.leaves(same))


def test_an_unknown_kind_is_refused(tmp_path):
    params = KINDS.find("spirl").load().init(jax.random.key(0), TINY["spirl"])
    save_policy(tmp_path / "policy", TINY["spirl"], params, {})
    path = tmp_path / "policy" / "config.json"
    path.write_text(path.read_text().replace('"spirl"', '"spril"'))
    with pytest.raises(DataError, match=r"unknown kind of network 'spril'.*did you mean 'spirl'"):
        read_policy(tmp_path / "policy")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"commands": []}, "commands must hold goals of 2 numbers"),
        ({"commands": [[0.0, 1.0, 2.0]]}, "commands must hold goals of 2 numbers"),
        ({"arrived": 1.5}, "arrived"),
    ],
)
def test_a_damaged_config_is_refused(tmp_path, changes, said):
    params = KINDS.find("ptgm").load().init(jax.random.key(0), TINY["ptgm"])
    save_policy(tmp_path / "policy", TINY["ptgm"], params, {})
    path = tmp_path / "policy" / "config.json"
    document = json.loads(path.read_text())
    document["network"] |= changes
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match=said):
        read_policy(tmp_path / "policy")


def test_a_missing_network_names_the_command_that_trains_it():
    world = replace(envs.find("maze15"), name="elsewhere")
    assert released_folder(world, "spirl").parent == released_folder(world)
    with pytest.raises(UsageError, match=r"pretrain --method spirl`"):
        load_policy(world, kind="spirl")


def test_settings_of_a_kind_win_in_all_presets_but_smoke():
    world, kind = (
        pretrain_preset("gridworld", "fast"),
        pretrain_preset("gridworld", "fast", "spirl"),
    )
    assert kind.train.optimizer == "adamw"
    assert kind.data == world.data
    assert pretrain_preset("gridworld", "smoke", "spirl").train.steps == 40
    for preset in (
        "fast",
        "paper",
    ):  # the learning rate of Table 9, and the steps of the released skills
        train = pretrain_preset("gridworld", preset, "spirl").train
        assert (train.learning_rate, train.schedule, train.warmup_steps) == (1e-3, "cosine", 300)
        assert train.steps == 8_000
    assert pretrain_preset("gridworld", "paper").train.learning_rate == 1e-4
    assert pretrain_preset("kitchen", "fast", "spirl").train.batch_size == 32  # the world's
    assert kind.folder != world.folder
    assert PretrainConfig().method == MULTI_GOAL


def test_skills_of_a_closed_loop_can_be_asked_for():
    config = replace(pretrain_preset("gridworld", "smoke", "spirl"), loop="closed")
    check_pretraining(config)
    assert sized_network(config, envs.make("gridworld").spec).loop == "closed"
    with pytest.raises(UsageError, match="--loop closed does not apply to --method mgpo"):
        check_pretraining(replace(config, method=MULTI_GOAL))
    with pytest.raises(UsageError, match="--loop closed does not apply to --init"):
        check_pretraining(replace(config, init=Path("policy")))


def test_every_method_starts_from_a_kind_that_there_is():
    for name in methods.names():
        assert methods.find(name).policy in KINDS.names()
