"""Settings of ``experiments.reproduce``: what can be made, and which settings apply to it. No jax here."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

import envs
from envs.errors import UsageError, printable, shown
from experiments.joining import Joined
from experiments.store.presets import pretrain_preset
from experiments.store.settings import DEFAULT_WORLD, RUNS, file_name
from mgpo_jax.settings import Count, Name, NumSeeds, NumTrajectories, flag


@dataclass(frozen=True, kw_only=True)
class ReproduceConfig(Joined):
    """Settings of ``experiments.reproduce``."""

    what: tyro.conf.Positional[str] = ""
    """What to make: table1, table2, table8 (methods in all worlds), figure6, figure7 (their learning
    curves), table3 (optimized prompts under noise), figure2, figure3, figure5, figure9, figure10 (prompts
    and the episodes under them), figure11 (the worlds at a glance), table4 (prompt length and c of UCB),
    table5 (datasets), figure8 (longer prompts), heads (distributions of continuous actions), plan (our
    optimizer without some of its parts), list (what exists of each, and the cost of the rest), or all
    (everything that is missing)."""
    env: tuple[Name, ...] = ()
    """The worlds, by name or as module:attribute (default: those of the paper's table or figure; maze15 for
    ablations; all for figure11)."""
    scale: Literal["smoke", "cpu", "paper"] = "cpu"
    """Scale of comparisons and of drawn adaptations: cpu uses the released networks and the paper's budget;
    smoke five tasks, one seed and 20 episodes; paper networks trained with the preset "paper"."""
    only: tuple[Name, ...] = ()
    """Names of the datasets (table5), prompt lengths (figure8) or heads to train, of the variants of our
    optimizer (plan, such as "without steering"), or of the methods to compare (default: all)."""
    steps: Count | None = None
    """Gradient steps of each training (default: from the world's preset "ablation")."""
    trajectories: Annotated[NumTrajectories | None, tyro.conf.arg(aliases=("--episodes",))] = None
    """Trajectories in each dataset (default: from the world's preset "ablation")."""
    seeds: NumSeeds = 3
    """Number of independent adaptations to each test task [3]."""
    out: Path = RUNS / "reproduce"
    """Folder of all trainings and results, which tables and figures share where they can."""

    @property
    def world(self) -> str:
        """The world of an ablation, which has only one."""
        return self.env[0] if self.env else DEFAULT_WORLD

    @property
    def folder(self) -> Path:
        return self.out / file_name(self.world)

    @property
    def num_steps(self) -> int:
        return self.steps or self._preset("steps", pretrain_preset(self.world, "fast").train.steps)

    @property
    def num_trajectories(self) -> int:
        default = pretrain_preset(self.world, "fast").data.trajectories
        return self.trajectories or self._preset("trajectories", default)

    def _preset(self, name: str, default: int) -> int:
        return envs.find(self.world).presets.get("ablation", {}).get(name, default)


COMPARISONS = ("table1", "table2", "table3", "table8", "figure6", "figure7")
"""Tables and figures of ``experiments.reproduce`` that compare several methods in several worlds."""
PICTURES = ("figure2", "figure3", "figure5", "figure9", "figure10")
"""Figures that draw episodes of adaptations."""
ABLATIONS = ("table4", "table5", "figure8", "heads", "plan")
"""Studies that vary one factor in one world."""
TRAIN_NOTHING = ("table4", "plan")
"""Ablations that adapt the released policy instead of training policies of their own."""
GLANCE = "figure11"
"""The figure that shows all worlds."""
LIST, ALL = "list", "all"


def check_reproduction(config: ReproduceConfig) -> None:
    """Raise ``UsageError`` for settings of ``experiments.reproduce`` that do not apply to what is made."""
    if config.distributed and config.what not in COMPARISONS:
        raise UsageError(
            f"--distributed spreads the cells of a comparison; {config.what} is made by one process, leave "
            f"it out or name one of {', '.join(COMPARISONS)}"
        )
    if config.what not in ABLATIONS:
        useless = ["steps", "trajectories"]
        useless += ["only"] if config.what not in COMPARISONS else []
        _refuse(config, useless)
        return
    if config.scale != "cpu":
        raise UsageError(f"--scale {config.scale} does not apply to {config.what}; leave it out")
    if config.what in TRAIN_NOTHING:
        _refuse(config, (*(("only",) if config.what == "table4" else ()), "steps", "trajectories"))
    elif config.num_trajectories <= (kept := pretrain_preset(config.world, "fast").holdout):
        raise UsageError(
            f"--trajectories must be above {kept}, the trajectories kept out of training, found "
            f"{config.num_trajectories}"
        )


def _refuse(config: ReproduceConfig, names: Iterable[str]) -> None:
    """Raise ``UsageError`` for the first of some useless settings that is given."""
    for name in names:
        if value := getattr(config, name):
            text = printable(" ".join(value)) if isinstance(value, tuple) else shown(value)
            raise UsageError(f"{flag(name)} {text} does not apply to {config.what}; leave it out")
