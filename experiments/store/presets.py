"""Presets of pre-training, the defaults that they imply, and which settings contradict each other.

``fast`` is our recipe, which takes 22 minutes to 6 hours of CPU time, depending on the world; ``paper``
has the paper's values (Table 6, or its code's where the text is silent); ``smoke`` only shows that
everything runs.
Settings that differ between worlds are in their ``World`` records. Nothing here imports jax.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import envs
from envs.errors import UsageError, nearest
from experiments.store import recipes
from experiments.store.initial import OF_INITIAL, check_initial, goes_on, read_initial
from experiments.store.layout import CONFIG
from experiments.store.settings import DEFAULT_WORLD, NO_WORLD, PretrainConfig, saved_pretraining
from mgpo_jax.kinds import KINDS, MULTI_GOAL
from mgpo_jax.manifest import read_facts

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "fast": {},
    "paper": {
        "optimizer": "adamw",
        "learning_rate": 1e-4,
        "warmup_steps": 10_000,
        "schedule": "constant",
        "clip_norm": 0.25,
        "dropout": 0.1,
        "prompt_order": False,
        "num_heads": 1,
    },
    "smoke": {
        "trajectories": 256,
        "steps": 40,
        "warmup_steps": 10,
        "embed_dim": 32,
        "num_layers": 2,
        "holdout": 32,
        "eval_tasks": 8,
        "eval_every": 20,
        "save_every": 20,
    },
}


def with_settings(config: PretrainConfig, changes: Mapping[str, Any]) -> PretrainConfig:
    """The config with some settings replaced, wherever they are nested.

    Args:
      config: the config.
      changes: new values by the names of the settings.

    Raises:
      UsageError: for an unknown setting, with the nearest known name.
    """
    groups: dict[str, dict[str, Any]] = {"": {}, "data": {}, "train": {}}
    known: dict[str, Any] = {"": config, "data": config.data, "train": config.train}
    for name, value in changes.items():
        for group, part in known.items():
            if name in {f.name for f in dataclasses.fields(part)}:
                groups[group][name] = value
                break
        else:
            names = [f.name for part in known.values() for f in dataclasses.fields(part)]
            raise nearest(name, names, "setting of a preset")
    data = replace(config.data, **groups["data"])
    train = replace(config.train, **groups["train"])
    return replace(config, data=data, train=train, **groups[""])


def pretrain_preset(env: str, preset: str, method: str = MULTI_GOAL) -> PretrainConfig:
    """The default settings of a preset, in which the world's record and the kind of network have a say."""
    world, kind = envs.find(env), KINDS.find(method)
    if preset not in PRESETS:
        raise nearest(preset, PRESETS, "preset")
    config = PretrainConfig(env=env, preset=preset, method=method)
    own = world.presets.get(preset, {})
    smoke = preset == "smoke"
    if smoke or not own:  # start from the world's fast preset
        config = with_settings(config, world.presets.get("fast", {}))
    if smoke:
        config = with_settings(config, kind.preset)
    config = with_settings(config, PRESETS[preset])
    if smoke:  # fewer padded lengths mean fewer compilations
        config = with_settings(config, {"bucket": 8 * config.train.bucket})
    config = with_settings(config, own)
    # A world's recipe is for the multi-goal policy, so what a kind says of itself is worth more.
    return config if smoke else with_settings(config, kind.preset)


def pretrain_default(config: PretrainConfig, flags: Iterable[str] = ()) -> PretrainConfig:
    """The defaults that a config's world, its preset and the policy that it starts from imply.

    Raises:
      UsageError: if there is no such world, preset or policy.
      DataError: if the config of that policy, or of the run to resume, is damaged.
    """
    default = _preset_of(config)
    if config.init is None:
        return default
    config = replace(config, env=default.env)  # which the folder of the run depends on
    if goes_on(config):
        run = saved_pretraining(config.folder / CONFIG)
        return with_settings(default, {name: getattr(run, name) for name in OF_INITIAL})
    return with_settings(default, read_initial(config).network)


def _preset_of(config: PretrainConfig) -> PretrainConfig:
    """The defaults for a world, or for a user's own dataset."""
    folder = config.data.data_folder
    if folder is None:
        env = DEFAULT_WORLD if config.env == NO_WORLD else config.env
        return pretrain_preset(env, config.preset, config.method)
    facts = read_facts(folder)
    if config.env != NO_WORLD:
        default = pretrain_preset(config.env, config.preset, config.method)
        return with_settings(default, recipes.of_data(facts, default.holdout))
    if config.preset not in PRESETS:
        raise nearest(config.preset, PRESETS, "preset")
    default = with_settings(
        PretrainConfig(preset=config.preset, method=config.method), recipes.recipe(facts)
    )
    default = with_settings(default, PRESETS[config.preset])
    return with_settings(default, recipes.of_data(facts, default.holdout))


def check_pretraining(config: PretrainConfig) -> None:
    """Raise ``UsageError`` for training settings that are valid on their own but not in combination."""
    train, trajectories = config.train, config.data.trajectories
    _check_own_data(config)
    if train.batch_size % train.part_size:
        raise UsageError(
            f"--batch-size {train.batch_size} is not a multiple of --part-size {train.part_size}"
        )
    if config.loop == "closed" and "loop" not in KINDS.find(config.method).settings:
        raise UsageError(f"--loop closed does not apply to --method {config.method}; leave it out")
    if config.init is not None and not goes_on(config):
        if config.loop == "closed":
            raise UsageError(
                "--loop closed does not apply to --init, which fixes the network; leave it out"
            )
        check_initial(config)
    if config.standardize_obs and config.encoder != "linear":
        raise UsageError(
            f"--standardize-obs does not apply to --encoder {config.encoder}, whose inputs are codes "
            "rather than quantities; leave it out"
        )
    if config.init is None and config.embed_dim % config.num_heads:
        raise UsageError(
            f"--embed-dim {config.embed_dim} is not a multiple of --num-heads {config.num_heads}"
        )
    check_holdout(config.holdout, trajectories)


def check_holdout(holdout: int, trajectories: int) -> None:
    """Raise ``UsageError`` if the trajectories kept out of training leave none to train on."""
    if holdout >= trajectories:
        raise UsageError(
            f"--holdout {holdout} leaves nothing of {trajectories} trajectories to train on; lower it, or "
            "raise --trajectories"
        )


def _check_own_data(config: PretrainConfig) -> None:
    """Raise ``UsageError`` for settings that make no sense with, or without, the user's own dataset."""
    data = config.data
    if data.data_folder is None:
        if config.env == NO_WORLD:
            raise UsageError(
                f"--env {NO_WORLD} is for data of your own; give its folder with --data, or name a world"
            )
        return
    if data.demonstrator is not None or data.data_seed:
        name = "--data-seed" if data.demonstrator is None else "--demonstrator"
        raise UsageError(
            f"--data is already collected, so {name} does not apply to it; leave {name} out"
        )
    if config.env == NO_WORLD and config.method != MULTI_GOAL:
        raise UsageError(
            f"--method {config.method} needs a world; name the one that the data is from with --env"
        )
    num = read_facts(data.data_folder).num_trajectories
    if data.trajectories > num:
        raise UsageError(
            f"--trajectories {data.trajectories} is more than the {num} in {data.data_folder}; lower it"
        )
