"""Make an ablation of the paper with one command: ``python -m experiments.reproduce table5``.

Trains what is missing (a stopped run goes on where it was), adapts with UCB, prints the table and draws
the learning curves. All trainings of a table have the same budget, shorter than that of the released
policies and named above the table.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro

from experiments.adapt import AdaptConfig, OptimizerConfig, save_results
from experiments.adaptation import run_variants
from experiments.configs import RUNS, DataConfig, make_env, positive, pretrain_preset
from experiments.figures import learning_curve
from experiments.policies import check_weights, load_network
from experiments.pretrain import main as pretrain
from experiments.results import load_results
from experiments.runtime import Common, run
from experiments.table import read_summary
from experiments.tasks import benchmark_tasks
from mgpo_jax.distributions import HEADS
from mgpo_jax.errors import UsageError, nearest
from mgpo_jax.optimizers import ucb

EPISODES = 100  # of an adaptation
LONGEST = 5  # goals of a prompt where the paper varies c
# Gradient steps of each training of a table, and its trajectories.
STEPS = {"maze15": 2_000, "maze30": 1_000, "kitchen": 1_000}
TRAJECTORIES = {"maze15": 10_000, "maze30": 10_000, "kitchen": 9_000}


@dataclass(frozen=True, kw_only=True)
class ReproduceConfig(Common):
    """Settings of ``experiments.reproduce``."""

    what: tyro.conf.Positional[str]
    """table4 (prompt length and c of UCB), table5 (datasets), figure8 (longer prompts) or heads
    (distributions of continuous actions)."""
    env: str = "maze15"
    """The world: maze15, maze30 or kitchen."""
    only: tuple[str, ...] = ()
    """Names of the datasets (table5), prompt lengths (figure8) or heads to train (default: all)."""
    steps: int | None = None
    """Gradient steps of each training (default: 2,000 for maze15, 1,000 for the others)."""
    episodes: int | None = None
    """Trajectories of each dataset (default: as in the paper) [10,000 in mazes, 9,000 in kitchen]."""
    seeds: int = 3
    """Independent adaptations to each test task [3]."""
    out: Path = RUNS / "reproduce"
    """Folder of all trainings and results; tables share what they have in common."""

    @property
    def folder(self) -> Path:
        return self.out / self.env

    @property
    def num_steps(self) -> int:
        return self.steps or STEPS[self.env]

    @property
    def num_trajectories(self) -> int:
        return self.episodes or TRAJECTORIES[self.env]


class Line(NamedTuple):
    """One row of a table: its results, and what the paper has for it."""

    label: str
    results: Path
    paper: str


# Paper, Tables 4 and 5: MGPO-UCB, mean return over test tasks of its own.
PAPER = {
    "maze15": {
        "K = 1": "-2.63 ± 0.00",
        "K = 2": "-1.13 ± 0.10",
        "K = 3": "-0.77 ± 0.04",
        "K = 5": "-0.41 ± 0.10",
        "c = 0": "-0.44 ± 0.07",
        "c = 1": "-0.41 ± 0.10",
        "c = 10": "-0.40 ± 0.04",
        "random": "-1.05 ± 0.01",
        "astar1": "-0.97 ± 0.03",
        "astar2": "-0.36 ± 0.02",
        "astar4": "-0.41 ± 0.10",
    },
    "maze30": {
        "K = 1": "-27.06 ± 0.00",
        "K = 2": "-19.57 ± 1.21",
        "K = 3": "-17.12 ± 0.47",
        "K = 5": "-14.21 ± 0.19",
        "c = 0": "-15.86 ± 0.51",
        "c = 1": "-14.21 ± 0.19",
        "c = 10": "-14.70 ± 0.66",
        "random": "-17.13 ± 0.52",
        "astar1": "-9.26 ± 0.38",
        "astar2": "-8.66 ± 0.35",
        "astar4": "-14.21 ± 0.19",
    },
    "kitchen": {
        "K = 1": "0.09 ± 0.00",
        "K = 2": "0.28 ± 0.00",
        "K = 3": "0.48 ± 0.02",
        "K = 5": "0.63 ± 0.02",
        "c = 0": "0.63 ± 0.05",
        "c = 1": "0.63 ± 0.02",
        "c = 10": "0.66 ± 0.02",
    },
}


def trained(
    config: ReproduceConfig, label: str, demonstrator: str | None = None, **changes: Any
) -> Path:
    """The policy of one training, which is run or continued if it is not finished.

    Args:
      config: settings of the command.
      label: what the run's folder is named after, beside its size.
      demonstrator: whose dataset (default: that of the world's recipe).
      **changes: what else differs from the world's ``PretrainConfig``.
    """
    fast = pretrain_preset(config.env, "fast")
    settings = replace(
        fast,
        data=DataConfig(demonstrator or fast.data.demonstrator, config.num_trajectories),
        train=replace(fast.train, steps=config.num_steps),
        **changes,
    )
    size = f"{config.num_steps}steps-{config.num_trajectories}episodes"
    folder = config.folder / "policies" / f"{label}-k{settings.max_prompt_length}-{size}"
    if not (folder / "policy").is_dir():
        print(f"training {folder}", file=sys.stderr)
        pretrain(replace(settings, out=folder, resume=folder.exists()))
    return folder / "policy"


def adapted(
    config: ReproduceConfig,
    policy: Path | None,
    folders: Mapping[Path, Mapping[str, Any]],
    scale: float | None = None,
) -> None:
    """UCB with each variant of its settings, as one program; finished results stay as they are.

    Args:
      config: settings of the command.
      policy: folder of the policy; None for the released one.
      folders: result folders to write, with the variant (``c``, ``max_goals``) of each.
      scale: of ``ucb``.
    """
    env = make_env(config.env)
    network = load_network(env, policy)
    missing = {folder: variant for folder, variant in folders.items() if not folder.exists()}
    for folder in folders.keys() - missing.keys():
        check_weights(load_results(folder), network, f"remove {folder}")
    if not missing:
        return
    tasks = benchmark_tasks(env)
    print(f"adapting with {policy or 'the released policy'}", file=sys.stderr)
    outcomes = run_variants(
        env,
        network,
        partial(ucb, scale=scale),
        tasks,
        list(missing.values()),
        seeds=config.seeds,
        episodes=EPISODES,
    )
    optimum = np.asarray(jax.jit(jax.vmap(env.optimal_return))(tasks))
    for (folder, variant), outcome in zip(missing.items(), outcomes, strict=True):
        adapt = AdaptConfig(
            env=config.env,
            policy=policy,
            seeds=config.seeds,
            episodes=EPISODES,
            max_goals=variant.get("max_goals"),
            out=folder,
            options=OptimizerConfig(c=variant.get("c"), scale=scale),
        )
        save_results(folder, adapt, outcome, tasks, optimum, network.sha256)


def table4(config: ReproduceConfig) -> list[Line]:
    """Longest prompt K and exploration constant c, with the released policy (Table 4)."""
    folder, paper = config.folder / "table4", PAPER[config.env]
    lengths = {folder / f"K{k}-{config.seeds}seeds": {"max_goals": k} for k in (1, 2, 3, LONGEST)}
    constants = {
        folder / f"c{c}-{config.seeds}seeds": {"c": float(c), "max_goals": LONGEST}
        for c in (0, 1, 10)
    }
    adapted(config, None, lengths)
    adapted(config, None, constants, scale=1.0)  # Eq. 3 as printed
    lines = [(f"K = {variant['max_goals']}", path) for path, variant in lengths.items()]
    lines += [(f"c = {variant['c']:.0f}", path) for path, variant in constants.items()]
    return [Line(label, path, paper[label]) for label, path in lines]


def chosen(config: ReproduceConfig, names: Sequence[str]) -> Sequence[str]:
    """Those of ``names`` that ``--only`` leaves."""
    for name in config.only:
        if name not in names:
            raise nearest(name, names, f"row of {config.what}")
    return config.only or names


def compared(
    config: ReproduceConfig,
    names: Sequence[str],
    train: Callable[[str], Path],
    label: str = "{}",
    paper: Mapping[str, str] | None = None,
) -> list[Line]:
    """One policy, and one adaptation with it, for each of the names that ``--only`` leaves."""
    lines = []
    for name in chosen(config, names):
        policy = train(name)
        results = config.folder / config.what / f"{policy.parent.name}-{config.seeds}seeds"
        adapted(config, policy, {results: {}})
        lines.append(Line(label.format(name), results, (paper or {}).get(name, "")))
    return lines


def table5(config: ReproduceConfig) -> list[Line]:
    """One policy for each dataset (Table 5)."""
    datasets = ("random", "astar1", "astar2", "astar4")
    return compared(
        config, datasets, lambda name: trained(config, name, name), paper=PAPER[config.env]
    )


def figure8(config: ReproduceConfig) -> list[Line]:
    """One policy for each longest prompt K (Figure 8)."""
    return compared(
        config,
        ("5", "10", "20", "40"),
        lambda length: trained(config, "astar4", "astar4", max_prompt_length=int(length)),
        "K = {}",
    )


def heads(config: ReproduceConfig) -> list[Line]:
    """One policy for each distribution of continuous actions; the authors' code has the fixed Gaussian."""
    names = [name for name in HEADS if name != "categorical"]
    return compared(config, names, lambda head: trained(config, head, head=head))


class Ablation(NamedTuple):
    """A table that the command makes, and the worlds it is of."""

    make: Callable[[ReproduceConfig], list[Line]]
    worlds: tuple[str, ...]


MAZES = ("maze15", "maze30")
ABLATIONS = {
    "table4": Ablation(table4, (*MAZES, "kitchen")),
    "table5": Ablation(table5, MAZES),
    "figure8": Ablation(figure8, MAZES),
    "heads": Ablation(heads, ("kitchen",)),
}


def markdown(lines: Sequence[Line]) -> str:
    """The table, one row for each line."""
    head = ["", "initial", "final (mean ± std over seeds)", "regret", "after 40", "paper: final"]
    rows = [head, ["---"] * len(head)]
    for line in lines:
        summary = read_summary(line.results)
        after_40 = summary["regret_after_40"]
        rows.append(
            [
                line.label,
                f"{summary['initial_return']:.2f}",
                f"{summary['final_return']:.3f} ± {summary['final_return_std_over_seeds']:.3f}",
                f"{summary['regret']:.3f}",
                "" if after_40 is None else f"{after_40:.3f}",
                line.paper,
            ]
        )
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def main(config: ReproduceConfig) -> None:
    """Reproduce an ablation of the paper: train, adapt, print the table, draw the curves."""
    positive(config, "steps", "episodes", "seeds")
    if config.what not in ABLATIONS:
        raise nearest(config.what, ABLATIONS, "ablation")
    ablation = ABLATIONS[config.what]
    if config.env not in ablation.worlds:
        worlds = " or ".join(ablation.worlds)
        raise UsageError(f"there is no {config.what} for {config.env}; choose --env {worlds}")
    lines = ablation.make(config)
    budget = (
        ""
        if config.what == "table4"
        else f", {config.num_steps:,} gradient steps on {config.num_trajectories:,} trajectories each"
    )
    text = f"{config.env}, UCB, {config.seeds} seeds{budget}\n\n{markdown(lines)}\n"
    print(text)
    results = {line.label: load_results(line.results) for line in lines}
    place = config.folder / f"{config.what}.md"
    place.write_text(text)
    learning_curve(results, config.env).savefig(place.with_suffix(".png"))
    print(f"table and curves in {place} and .png", file=sys.stderr)


if __name__ == "__main__":
    run(ReproduceConfig, main)
