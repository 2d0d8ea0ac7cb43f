"""Settings of the command lines, and the presets of each world.

``fast`` is the recipe for two cores, in ten minutes to two hours; ``paper`` has the paper's values
(Table 6, and its code's where the text is silent); ``smoke`` only shows that everything runs.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

import envs
from envs.base import Environment
from experiments.runtime import Common, peek
from mgpo_jax.errors import UsageError, nearest
from mgpo_jax.pretrain import TrainConfig

RUNS = Path("runs")
PRETRAINED = Path(__file__).parent.parent / "pretrained"


def data_root() -> Path:
    return Path(os.environ.get("MGPO_DATA", "data"))


def make_env(name: str) -> Environment:
    """``envs.make`` with the error of a command line."""
    try:
        return envs.make(name)
    except (ImportError, ValueError) as error:
        raise UsageError(str(error)) from None


def positive(config: Any, *fields: str) -> None:
    """Raise ``UsageError`` for a number that must be at least 1."""
    for name in fields:
        value = getattr(config, name)
        if value is not None and value < 1:
            raise UsageError(f"--{name.replace('_', '-')} must be at least 1, found {value}")


@dataclass(frozen=True)
class DataConfig:
    """Which dataset."""

    demonstrator: Annotated[str | None, tyro.conf.arg(name="policy")] = None
    """Who collects it: astar1, astar2, astar4 or random in mazes (default: the world's first)."""
    episodes: int = 10_000
    """Trajectories kept [10,000 in mazes, 13,600 in gridworld, 9,000 in kitchen]."""
    data_seed: Annotated[int, tyro.conf.arg(name="data-seed")] = 0
    """Seed of the dataset."""


@dataclass(frozen=True)
class PretrainConfig(Common):
    """Settings of ``experiments.pretrain``; values in brackets are the paper's."""

    env: str = "maze15"
    """The world: maze15, maze30, gridworld or kitchen."""
    preset: str = "fast"
    """Where the defaults below come from: fast, paper or smoke."""
    data: Annotated[DataConfig, tyro.conf.arg(name="")] = field(default_factory=DataConfig)
    train: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)
    max_prompt_length: int = 5
    """K, the longest prompt [5 in mazes, 8 in gridworld, 6 in kitchen]."""
    dropout: float = 0.0
    """Dropout rate [0.1]."""
    prompt_order: bool = True
    """Position embedding on prompt goals [False]."""
    embed_dim: int = 128
    """Width of the network [128]."""
    num_layers: int = 3
    """Transformer blocks [3]."""
    num_heads: int = 4
    """Attention heads [1]."""
    head: str | None = None
    """Distribution of continuous actions: gaussian, mixture, binned or fixed_gaussian (default: binned in
    kitchen) [fixed_gaussian in the authors' code]."""
    standardize_obs: bool = False
    """Standardize observations by their mean and spread in the dataset [False]."""
    holdout: int = 200
    """Trajectories kept out of training for the validation loss."""
    eval_tasks: int = 64
    """Tasks of the greedy evaluation on the way (no test tasks)."""
    eval_every: int = 1_000
    """Steps between evaluations."""
    save_every: int = 500
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
        return self.out or RUNS / "pretrain" / self.env / name


PRESETS = ("fast", "paper", "smoke")


@dataclass(frozen=True)
class Recipe:
    """What differs between the trainings of two worlds."""

    steps: int
    episodes: int
    max_prompt_length: int
    bucket: int
    batch_size: int = 64
    part_steps: int = 1024
    demonstrator: str | None = None
    save_every: int = 500
    head: str | None = None
    standardize_obs: bool = False
    obs_noise: float = 0.0


# Demonstrations are cheaper than regularization: 10,000 of maze15 are soon overfitted, 100,000 take a
# minute to collect and are not.
FAST = {
    "maze15": Recipe(steps=8_000, episodes=100_000, max_prompt_length=5, bucket=4),
    "maze30": Recipe(
        steps=5_000,
        episodes=30_000,
        max_prompt_length=20,
        bucket=32,
        demonstrator="astar2",
        save_every=250,
    ),
    # Each of the 13,600 training tasks five times.
    "gridworld": Recipe(steps=3_000, episodes=68_000, max_prompt_length=8, bucket=8),
    # Long trajectories: half of them are enough for a gradient step.
    "kitchen": Recipe(
        steps=5_000,
        episodes=9_000,
        max_prompt_length=6,
        bucket=32,
        batch_size=32,
        part_steps=2048,
        head="binned",
        standardize_obs=True,
        obs_noise=0.03,
    ),
}

# Steps of the authors' code; their text gives none.
PAPER = {
    "maze15": Recipe(steps=50_000, episodes=10_000, max_prompt_length=5, bucket=4),
    "maze30": Recipe(steps=200_000, episodes=10_000, max_prompt_length=5, bucket=32),
    "gridworld": Recipe(steps=50_000, episodes=13_600, max_prompt_length=8, bucket=8),
    "kitchen": Recipe(
        steps=200_000, episodes=9_000, max_prompt_length=6, bucket=32, head="fixed_gaussian"
    ),
}


def pretrain_preset(env: str, preset: str) -> PretrainConfig:
    """The default settings for a world."""
    world = make_env(env).spec.name  # complains about an unknown name
    if preset not in PRESETS:
        raise nearest(preset, PRESETS, "preset")
    if world not in FAST:
        raise UsageError(
            f"there is no recipe for {world}: choose one of {', '.join(FAST)}, and act in {world} "
            "with the policy of that (adapt --policy)"
        )
    recipe = (PAPER if preset == "paper" else FAST)[world]
    fast = PretrainConfig(
        env=env,
        preset=preset,
        data=DataConfig(recipe.demonstrator, recipe.episodes),
        train=TrainConfig(
            steps=recipe.steps,
            batch_size=recipe.batch_size,
            part_steps=recipe.part_steps,
            bucket=recipe.bucket,
            obs_noise=recipe.obs_noise,
        ),
        max_prompt_length=recipe.max_prompt_length,
        save_every=recipe.save_every,
        head=recipe.head,
        standardize_obs=recipe.standardize_obs,
    )
    if preset == "paper":
        train = replace(
            fast.train,
            optimizer="adamw",
            learning_rate=1e-4,
            warmup_steps=10_000,
            schedule="constant",
            clip_norm=0.25,
        )
        return replace(fast, train=train, dropout=0.1, prompt_order=False, num_heads=1)
    if preset == "smoke":
        return replace(
            fast,
            data=replace(fast.data, episodes=256),
            train=replace(fast.train, steps=40, warmup_steps=10, bucket=8 * recipe.bucket),
            embed_dim=32,
            num_layers=2,
            holdout=32,
            eval_tasks=8,
            eval_every=20,
            save_every=20,
        )
    return fast


def pretrain_default(argv: Sequence[str]) -> PretrainConfig:
    """The defaults that ``--env`` and ``--preset`` choose."""
    return pretrain_preset(peek(argv, "env", "maze15"), peek(argv, "preset", "fast"))
