"""Make an ablation of the paper with one command: ``python -m experiments.reproduce table5``.

Trains what is missing (a stopped run goes on where it was), adapts with UCB, prints the table and draws
the learning curves. All trainings of a table have the same budget, shorter than that of the released
policies and named above the table.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NoReturn

import tyro

import envs
from envs.errors import nearest
from experiments.runtime import Common, run
from experiments.store.settings import DEFAULT_WORLD, RUNS, file_name, pretrain_preset
from mgpo_jax.settings import number

ABLATIONS = ("table4", "table5", "figure8", "heads")


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


def main(config: ReproduceConfig) -> None:
    """Reproduce an ablation of the paper: train, adapt, print the table, draw the curves."""
    if config.what not in ABLATIONS:
        raise nearest(config.what, ABLATIONS, "ablation")
    envs.find(config.env)
    from experiments.ablations import MAKE, as_table, draw

    lines = MAKE[config.what](config)
    budget = (
        f", {config.num_steps:,} gradient steps on {config.num_trajectories:,} trajectories each"
    )
    budget = "" if config.what == "table4" else budget
    text = f"{config.env}, UCB, {config.seeds} seeds{budget}\n\n{as_table(lines)}\n"
    print(text)
    place = config.folder / f"{config.what}.md"
    place.write_text(text)
    draw(lines, config.env, place.with_suffix(".png"))
    print(f"table and curves in {place} and .png", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(ReproduceConfig, main, argv=argv)


if __name__ == "__main__":
    command()
