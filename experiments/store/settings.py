"""Settings of collection and pre-training, and how they are kept in a run. Nothing here imports jax."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

import envs
from envs.errors import DataError, shown
from experiments.joining import OF_PROCESSES, Joined
from mgpo_jax.kinds import MULTI_GOAL
from mgpo_jax.schema import Json, read_document
from mgpo_jax.settings import (
    RECIPE_NETWORK,
    Count,
    EncoderName,
    Head,
    Name,
    NumGoals,
    NumLayers,
    NumTasks,
    NumTrajectories,
    Seed,
    Share,
    TokensPerStep,
    TrainConfig,
    Width,
    get_parts,
    setting_fault,
    types_of,
)

RUNS = Path("runs")
DEFAULT_WORLD = "maze15"
NO_WORLD = "none"
"""The value of ``--env`` when training on a dataset without a registered world."""


def data_root() -> Path:
    """The folder of all datasets: ``$MGPO_DATA``, or ``data`` if that is not set."""
    return Path(os.environ.get("MGPO_DATA", "data"))


@dataclass(frozen=True)
class CollectConfig(Joined):
    """Settings of ``experiments.collect``."""

    env: Name = DEFAULT_WORLD
    """The world, by name or as module:attribute (``python -m experiments.list`` shows the names)."""
    demonstrator: Annotated[Name | None, tyro.conf.arg(aliases=("--policy",))] = None
    """The demonstrator; some take settings, as in ``expert,drop=0.3`` (default: the world's first
    demonstrator)."""
    trajectories: Annotated[NumTrajectories, tyro.conf.arg(aliases=("--episodes",))] = 10_000
    """Number of trajectories to collect."""
    seed: Seed = 0
    """Random seed of the tasks and the demonstrator."""
    out: Path | None = None
    """Output folder (default: data/ENV/DEMONSTRATOR-TRAJECTORIES-seedSEED, under $MGPO_DATA if set)."""
    resume: bool = False
    """Continue an interrupted collection; the dataset is the same as that of an uninterrupted one."""


def dataset_folder(config: CollectConfig, demonstrator: str) -> Path:
    """The folder of the dataset that a config describes."""
    name = f"{demonstrator}-{config.trajectories}-seed{config.seed}"
    return config.out or data_root() / envs.find(config.env).home / name


@dataclass(frozen=True)
class DataConfig:
    """The dataset to train on."""

    demonstrator: Annotated[Name | None, tyro.conf.arg(aliases=("--policy",))] = None
    """The demonstrator of the dataset; some take settings, as in ``expert,drop=0.3`` (default: the world's
    first demonstrator)."""
    trajectories: Annotated[NumTrajectories, tyro.conf.arg(aliases=("--episodes",))] = 10_000
    """Number of trajectories to train on; a dataset that does not exist yet is collected first."""
    data_seed: Seed = 0
    """Random seed of the dataset."""
    data_folder: Annotated[Path | None, tyro.conf.arg(aliases=("--data",))] = None
    """Folder of your own dataset (made by ``python -m experiments.data import``) to train on; needs no
    world."""


@dataclass(frozen=True)
class PretrainConfig(Joined):
    """Settings of ``experiments.pretrain``; values in brackets are the paper's."""

    env: Name = NO_WORLD
    """The world, by name or as module:attribute (``python -m experiments.list`` shows the names). With
    ``--data`` it defaults to none, and the policy is not evaluated during training."""
    method: Name = MULTI_GOAL
    """What to train: mgpo, a policy that follows prompts; ptgm or spirl, the low-level policy of that
    method."""
    preset: Name = "fast"
    """Preset that the defaults below come from: fast, paper or smoke."""
    data: Annotated[DataConfig, tyro.conf.arg(name="")] = field(default_factory=DataConfig)
    train: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)
    init: Path | None = None
    """Folder of a policy to initialize the network and its weights from (default: random weights)."""
    max_prompt_length: NumGoals = 5
    """Maximum number of goals in a prompt, K [5]."""
    dropout: Share = RECIPE_NETWORK["dropout"]
    """Dropout rate [0.1]."""
    prompt_order: bool = True
    """Add position embeddings to the goals of a prompt [False]."""
    embed_dim: Width = 128
    """Embedding dimension of the transformer [128]."""
    num_layers: NumLayers = 3
    """Number of transformer blocks [3]."""
    num_heads: Width = RECIPE_NETWORK["num_heads"]
    """Number of attention heads; must divide the embedding dimension [1]."""
    tokens_per_step: TokensPerStep = 2
    """Tokens per time step: 2 for an observation token and an action token, 1 for the sum of the previous
    action and the observation [2]."""
    loop: Literal["open", "closed"] = "open"
    """How the skills of spirl are decoded: all steps from the first observation (open), or each step from
    its own (closed)."""
    encoder: EncoderName = "linear"
    """Observation encoder [linear]; ``cells`` embeds the codes and counts of worlds that have them, and the
    others each serve the one world that defines them."""
    head: Head | None = None
    """Action distribution; discrete actions need categorical, continuous ones any other (default: the
    preset's, or else the first that fits) [fixed_gaussian in the authors' code]."""
    standardize_obs: bool = False
    """Standardize observations by their mean and standard deviation in the dataset [False]."""
    holdout: NumTrajectories = 200
    """Trajectories held out for the validation loss."""
    eval_tasks: NumTasks = 64
    """Tasks of an evaluation during training, one episode each; never test tasks."""
    eval_every: Count = 1_000
    """Gradient steps between evaluations."""
    save_every: Count = 500
    """Gradient steps between checkpoints."""
    out: Path | None = None
    """Run folder (default: runs/pretrain/ENV/PRESET-seedSEED; methods other than mgpo come before the
    preset)."""
    resume: bool = False
    """Continue an interrupted run from its latest checkpoint, bit for bit."""
    dry_run: bool = False
    """Print what would be done and roughly how much CPU time it would take, then exit."""
    json: bool = False
    """Print this estimate as JSON; only with ``--dry-run``."""
    tb: bool = False
    """Also log metrics to TensorBoard (extra: tb)."""
    wandb: bool = False
    """Also log metrics to Weights & Biases (extra: wandb)."""

    @property
    def folder(self) -> Path:
        method = "" if self.method == MULTI_GOAL else f"{file_name(self.method)}-"
        name = f"{method}{self.preset}-seed{self.train.seed}"
        data = self.data.data_folder
        place = data.absolute().name if data and self.env == NO_WORLD else file_name(self.env)
        return self.out or RUNS / "pretrain" / place / name


def file_name(name: str) -> str:
    """The folder name for a world or method, given by name or as module:attribute."""
    return name.replace(":", ".")


NO_SETTINGS = frozenset(
    {
        "preset", "init", "out", "resume", "debug", "quiet", "config", "dry_run", "json", "tb", "wandb",
        "eval_every", "save_every", "data_folder", *OF_PROCESSES,
    }
)  # fmt: skip
"""Settings that may change when a run is resumed, because they do not affect its weights. Datasets and
initial policies are compared by hash instead of by path."""


def training_settings(config: PretrainConfig) -> dict[str, Any]:
    """The settings that determine the result of a training, by name, as JSON values."""
    settings = dataclasses.asdict(config)
    parts = {**settings, **settings["data"], **settings["train"]}
    return {k: v for k, v in parts.items() if k not in NO_SETTINGS | {"data", "train"}}


def saved_pretraining(path: Path) -> PretrainConfig:
    """The settings in the ``config.json`` of a run.

    Raises:
      DataError: if the file does not hold settings of a pre-training run.
    """
    return pretraining_from(read_document(path, dict[str, Json], MEND_RUN), path)


MEND_RUN = "restore the file, or start a new run with --out"


def pretraining_from(values: Mapping[str, Any], where: Path) -> PretrainConfig:
    """The settings of a run from JSON values, in which older names of settings are accepted.

    Args:
      values: the values; missing settings get their defaults.
      where: the file that they are from, for error messages.

    Raises:
      DataError: if they are not the settings of a pre-training run.
    """
    if "env" not in values:
        raise DataError(f"{where} lacks env; {MEND_RUN}")
    data = values.get("data")
    if isinstance(data, Mapping) and "episodes" in data:
        renamed = {{"episodes": "trajectories"}.get(k, k): v for k, v in data.items()}
        values = {**values, "data": renamed}
    return _from_json(PretrainConfig, values, where)


def _from_json(settings_class: type, values: Any, where: Path) -> Any:
    """A settings dataclass from JSON values; the ``DataError`` names the first invalid one."""
    if not isinstance(values, Mapping):
        raise DataError(f"{where} holds no settings of a pre-training run; {MEND_RUN}")
    types = types_of(settings_class)
    found = {}
    for name, value in values.items():
        if name not in types:
            raise DataError(f"{where} has the unknown setting {shown(name)}; {MEND_RUN}")
        parts = list(get_parts(types[name]))
        if group := [p for p in parts if isinstance(p, type) and dataclasses.is_dataclass(p)]:
            found[name] = _from_json(group[0], value, where)
            continue
        found[name] = Path(value) if Path in parts and isinstance(value, str) else value
        if said := setting_fault(types[name], found[name]):
            raise DataError(f"{where}: {name} {said}; {MEND_RUN}")
    return settings_class(**found)
