"""Settings of commands that build on each other, and the presets they start from. Nothing imports jax.

``fast`` is the recipe for two cores, in ten minutes to two hours; ``paper`` has the paper's values
(Table 6, and its code's where the text is silent); ``smoke`` only shows that everything runs. What differs
between worlds stands in their ``World`` records.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

import envs
from envs.errors import UsageError, nearest
from experiments.runtime import Common, early_values
from mgpo_jax.settings import RECIPE_NETWORK, TrainConfig, number

RUNS = Path("runs")
DEFAULT_WORLD = "maze15"


def data_root() -> Path:
    """Where datasets are kept: ``$MGPO_DATA``, or the folder ``data``."""
    return Path(os.environ.get("MGPO_DATA", "data"))


@dataclass(frozen=True)
class CollectConfig(Common):
    """Settings of ``experiments.collect``."""

    env: str = DEFAULT_WORLD
    """The world, by name or as module:attribute (``python -m experiments.list`` shows the names)."""
    demonstrator: Annotated[str | None, tyro.conf.arg(aliases=("--policy",))] = None
    """Who demonstrates (default: the world's first demonstrator)."""
    trajectories: Annotated[int, tyro.conf.arg(aliases=("--episodes",))] = number(
        10_000, at_least=1
    )
    """Trajectories to keep."""
    seed: int = 0
    """Seed of tasks and demonstrator."""
    out: Path | None = None
    """Folder to write (default: data/ENV/DEMONSTRATOR-TRAJECTORIES-seedSEED, under $MGPO_DATA if set)."""


def dataset_folder(config: CollectConfig, demonstrator: str) -> Path:
    """Where a dataset lies."""
    name = f"{demonstrator}-{config.trajectories}-seed{config.seed}"
    return config.out or data_root() / envs.find(config.env).home / name


@dataclass(frozen=True)
class DataConfig:
    """Which dataset to train on."""

    demonstrator: Annotated[str | None, tyro.conf.arg(aliases=("--policy",))] = None
    """Who collects it (default: the world's first demonstrator)."""
    trajectories: Annotated[int, tyro.conf.arg(aliases=("--episodes",))] = number(
        10_000, at_least=1
    )
    """Trajectories to train on; they are collected first where they are not there yet."""
    data_seed: int = 0
    """Seed of the dataset."""


@dataclass(frozen=True)
class PretrainConfig(Common):
    """Settings of ``experiments.pretrain``; values in brackets are the paper's."""

    env: str = DEFAULT_WORLD
    """The world, by name or as module:attribute (``python -m experiments.list`` shows the names)."""
    preset: str = "fast"
    """Where the defaults below come from: fast, paper or smoke."""
    data: Annotated[DataConfig, tyro.conf.arg(name="")] = field(default_factory=DataConfig)
    train: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)
    max_prompt_length: int = number(5, at_least=1)
    """K, the longest prompt [5]."""
    dropout: float = number(RECIPE_NETWORK["dropout"], at_least=0)
    """Dropout rate [0.1]."""
    prompt_order: bool = True
    """Give prompt goals a position embedding [False]."""
    embed_dim: int = number(128, at_least=1)
    """Width of the network [128]."""
    num_layers: int = number(3, at_least=1)
    """Transformer blocks [3]."""
    num_heads: int = number(RECIPE_NETWORK["num_heads"], at_least=1)
    """Attention heads [1]."""
    encoder: str = "linear"
    """How observations become tokens [linear]."""
    head: str | None = None
    """Distribution of continuous actions: gaussian, mixture, binned or fixed_gaussian (default: that of
    the preset, else gaussian) [fixed_gaussian in the authors' code]."""
    standardize_obs: bool = False
    """Standardize observations by their mean and spread in the dataset [False]."""
    holdout: int = number(200, at_least=1)
    """Trajectories kept out of training for the validation loss."""
    eval_tasks: int = number(64, at_least=1)
    """Tasks of the greedy evaluation on the way (no test tasks)."""
    eval_every: int = number(1_000, at_least=1)
    """Steps between evaluations."""
    save_every: int = number(500, at_least=1)
    """Steps between checkpoints."""
    out: Path | None = None
    """Run folder (default: runs/pretrain/ENV/PRESET-seedSEED)."""
    resume: bool = False
    """Continue an interrupted run from its newest checkpoint, bit for bit."""
    tb: bool = False
    """Also write metrics for TensorBoard (extra: tb)."""
    wandb: bool = False
    """Also send metrics to Weights & Biases (extra: wandb)."""

    @property
    def folder(self) -> Path:
        name = f"{self.preset}-seed{self.train.seed}"
        return self.out or RUNS / "pretrain" / file_name(self.env) / name


def file_name(name: str) -> str:
    """A world's or method's name, or its place, as the name of a folder."""
    return name.replace(":", ".")


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
    """The config with some settings changed, by the names of their flags.

    Raises:
      UsageError: for a name that is no setting, with the nearest one.
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


def pretrain_preset(env: str, preset: str) -> PretrainConfig:
    """The default settings for a world: the general ones, then those of its record."""
    world = envs.find(env)
    if preset not in PRESETS:
        raise nearest(preset, PRESETS, "preset")
    config = PretrainConfig(env=env, preset=preset)
    if preset not in world.presets:  # it starts from the world's fast one
        config = with_settings(config, world.presets.get("fast", {}))
    config = with_settings(config, PRESETS[preset])
    config = with_settings(config, world.presets.get(preset, {}))
    if (
        preset == "smoke" and preset not in world.presets
    ):  # few padded lengths, so that little is compiled
        config = with_settings(config, {"bucket": 8 * config.train.bucket})
    return config


def pretrain_default(argv: Sequence[str]) -> PretrainConfig:
    """The defaults that ``--env`` and ``--preset`` choose."""
    return pretrain_preset(**early_values(argv, env=DEFAULT_WORLD, preset="fast"))


def saved_pretraining(saved: Mapping[str, Any], where: Path) -> dict[str, Any]:
    """The settings in the ``config.json`` of a run, also of one that was made with older names.

    Raises:
      UsageError: if they are no settings of a pre-training run.
    """
    if not isinstance(saved.get("data"), Mapping) or not isinstance(saved.get("train"), Mapping):
        raise UsageError(f"{where} holds no settings of a pre-training run")
    data = dict(saved["data"])
    if "episodes" in data:
        data["trajectories"] = data.pop("episodes")
    return {**saved, "data": data}


@dataclass(frozen=True)
class AdaptConfig(Common):
    """Settings of ``experiments.adapt``; values in brackets are the paper's."""

    env: str = DEFAULT_WORLD
    """The world, by name or as module:attribute (``python -m experiments.list`` shows the names)."""
    method: Annotated[str, tyro.conf.arg(aliases=("--bandit",))] = "ucb"
    """Who adapts, by name or as module:attribute (``python -m experiments.list`` shows the names)."""
    policy: Path | None = None
    """Folder of a policy (default: the released one of the world)."""
    tasks: Path | None = None
    """Your own tasks, an npz file with one array for each field of the world's task (default: the test
    tasks of the world)."""
    validation: bool = False
    """Adapt to as many tasks that are no test tasks, to choose a method's settings by."""
    seeds: int = number(3, at_least=1)
    """Independent adaptations to each task [3]."""
    episodes: int = number(100, at_least=1)
    """Budget of episodes a task, the first evaluation of (g^M) included [100]."""
    seed: int = 0
    """Seed of the adaptations."""
    eval_every: int = number(10, at_least=1)
    """Episodes between evaluations of the best choice, which are outside of the budget."""
    eval_episodes: int | None = number(None, at_least=1)
    """Episodes that an evaluation averages (default: as the world's record says)."""
    keep_actions: bool = False
    """Also keep continuous actions in the results; discrete ones are always kept."""
    out: Path | None = None
    """Result folder (default: runs/adapt/ENV/METHOD-seedSEED)."""
    figures: bool = True
    """Draw the figures."""
    hyper: Annotated[Any, tyro.conf.arg(name="")] = None
    """Hyper-parameters of the method."""

    @property
    def folder(self) -> Path:
        name = f"{file_name(self.method)}-seed{self.seed}"
        return self.out or RUNS / "adapt" / file_name(self.env) / name


@dataclass(frozen=True, kw_only=True)
class ReproduceConfig(Common):
    """Settings of ``experiments.reproduce``."""

    what: tyro.conf.Positional[str]
    """table4 (prompt length and c of UCB), table5 (datasets), figure8 (longer prompts) or heads
    (distributions of continuous actions)."""
    env: str = DEFAULT_WORLD
    """The world, by name or as module:attribute."""
    only: tuple[str, ...] = ()
    """Names of the datasets (table5), prompt lengths (figure8) or heads to train (default: all)."""
    steps: int | None = number(None, at_least=1)
    """Gradient steps of each training (default: those of the world's preset "ablation")."""
    trajectories: Annotated[int | None, tyro.conf.arg(aliases=("--episodes",))] = number(
        None, at_least=1
    )
    """Trajectories of each dataset (default: those of the world's preset "ablation")."""
    seeds: int = number(3, at_least=1)
    """Independent adaptations to each test task [3]."""
    out: Path = RUNS / "reproduce"
    """Folder of all trainings and results; tables share what they have in common."""

    @property
    def folder(self) -> Path:
        return self.out / file_name(self.env)

    @property
    def num_steps(self) -> int:
        return self.steps or self._preset("steps", pretrain_preset(self.env, "fast").train.steps)

    @property
    def num_trajectories(self) -> int:
        default = pretrain_preset(self.env, "fast").data.trajectories
        return self.trajectories or self._preset("trajectories", default)

    def _preset(self, name: str, default: int) -> int:
        return envs.find(self.env).presets.get("ablation", {}).get(name, default)
