"""Settings of ``experiments.adapt``. Nothing here imports jax."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from experiments.joining import Joined
from experiments.store.settings import DEFAULT_WORLD, RUNS, file_name
from mgpo_jax.methods import NoHyper
from mgpo_jax.settings import Count, Finite, Name, NotNegative, NumEpisodes, NumSeeds, Seed


@dataclass(frozen=True)
class AdaptConfig(Joined):
    """Settings of ``experiments.adapt``; values in brackets are the paper's."""

    env: Name = DEFAULT_WORLD
    """The world, by name or as module:attribute (``python -m experiments.list`` shows the names)."""
    method: Annotated[Name, tyro.conf.arg(aliases=("--bandit",))] = "ucb"
    """The adaptation method, by name or as module:attribute (``python -m experiments.list`` shows the
    names)."""
    policy: Path | None = None
    """Folder of a policy (default: the world's released policy)."""
    tasks: Path | None = None
    """Your own tasks, an npz file with one array for each field of the world's tasks (default: the world's
    test tasks)."""
    validation: bool = False
    """Adapt to validation tasks instead of the test tasks, to choose a method's settings."""
    validation_seed: Seed = 0
    """Random seed of the validation tasks; seed 0 gives those that trainings are evaluated on."""
    seeds: NumSeeds = 3
    """Number of independent adaptations to each task [3]."""
    episodes: NumEpisodes = 100
    """Episode budget per task, including the first episode, under the prompt (g^M) [100]."""
    seed: Seed = 0
    """Random seed of the adaptations."""
    eval_every: Count = 10
    """Episodes between evaluations of the best choice so far; they do not count toward the budget."""
    eval_episodes: NumEpisodes | None = None
    """Episodes averaged in an evaluation (default: from the world's record)."""
    stop_at: Finite | None = None
    """Stop searching on a task once its best choice so far reaches this return in an evaluation."""
    obs_noise: NotNegative = 0.0
    """Standard deviation of the noise on observations, in their units, during search and evaluation."""
    action_noise: NotNegative = 0.0
    """Standard deviation of the noise on continuous actions; the probability of a random action for
    discrete ones."""
    sweep: tuple[str, ...] = ()
    """Values of numeric hyper-parameters of the method to sweep over, such as ``c=0.1,1,10``; several
    hyper-parameters form a grid."""
    keep_actions: bool = False
    """Also store continuous actions in the results; discrete ones are always stored."""
    out: Path | None = None
    """Result folder (default: runs/adapt/ENV/METHOD-seedSEED, plus a suffix for noise or a sweep)."""
    figures: bool = True
    """Draw figures of the results."""
    json: bool = False
    """Print the summary as JSON."""
    dry_run: bool = False
    """Print what would be done and roughly how much CPU time it would take, then exit."""
    resume: bool = False
    """Continue an interrupted adaptation; the result is the same as that of an uninterrupted one."""
    hyper: Annotated[Any, tyro.conf.arg(name="")] = field(default_factory=NoHyper)
    """Hyper-parameters of the method."""

    @property
    def folder(self) -> Path:
        name = f"{file_name(self.method)}-seed{self.seed}"
        name += f"-obs{self.obs_noise:g}" if self.obs_noise else ""
        name += f"-action{self.action_noise:g}" if self.action_noise else ""
        name += "-sweep" if self.sweep else ""
        return self.out or RUNS / "adapt" / file_name(self.env) / name
