"""Adapt a policy to unseen tasks: ``python -m experiments.adapt --bandit ucb``."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from envs.base import Environment, Task
from experiments.adaptation import Outcome, run_adaptation
from experiments.configs import RUNS, make_env, positive
from experiments.policies import load_network, released_folder
from experiments.runtime import Common, provenance, refuse_existing, run, write_json
from experiments.statistics import seed_spread, stratified_bootstrap_iqm
from experiments.tasks import benchmark_tasks, evaluation_tasks, load_tasks, save_tasks
from mgpo_jax.errors import UsageError, nearest
from mgpo_jax.files import new_folder
from mgpo_jax.optimizers import OPTIMIZERS


@dataclass(frozen=True)
class OptimizerConfig:
    """Hyper-parameters of the optimizers; None leaves the optimizer's own default."""

    c: float | None = None
    """UCB: exploration constant [1]."""
    scale: float | None = None
    """UCB: unit of returns for c; 1 is Eq. 3 as printed (default: span of the world's returns)."""
    min_std: float | None = None
    """BPE: smallest spread of a prompt's returns, as a share of the prior's (default 0.02)."""
    num_edits: int | None = None
    """GRIPS: edited prompts an iteration [5]."""
    population_size: int | None = None
    """BBT: population of CMA-ES [10]."""
    latent_dim: int | None = None
    """BBT: dimension of z (default 5)."""
    std_init: float | None = None
    """BBT: initial step size, in units of goals (default 0.5)."""


@dataclass(frozen=True)
class AdaptConfig(Common):
    """Settings of ``experiments.adapt``; values in brackets are the paper's."""

    env: str = "maze15"
    """The world: maze15, maze30, gridworld or kitchen (kitchen-mjx, kitchen-native, kitchen-stock)."""
    bandit: str = "ucb"
    """The prompt optimizer: ucb, bpe, explore, grips or bbt."""
    policy: Path | None = None
    """Folder of a policy (default: the released one of the world)."""
    tasks: Path | None = None
    """Your own tasks, an npz file; mazes: maze [N, S, S] with 1 = wall, goal [N, 2] row and column;
    kitchen: order [N, 5], subtasks 0 to 4 and -1 for none (default: the test tasks of the world)."""
    validation: bool = False
    """As many tasks that are no test tasks, to choose an optimizer's settings by."""
    seeds: int = 3
    """Independent adaptations to each task [3]."""
    episodes: int = 100
    """Budget of episodes a task, the first evaluation of (g^M) included [100]."""
    seed: int = 0
    """Seed of the adaptations."""
    max_goals: int | None = None
    """K, the longest prompt to try (default: what the policy was trained with) [5]."""
    eval_every: int = 10
    """Episodes between evaluations of the best prompt, which are outside of the budget."""
    eval_episodes: int | None = None
    """Greedy episodes that an evaluation averages (default: 1 where task and actions determine an
    episode, else 10)."""
    keep_rewarded: bool = True
    """UCB, BPE, explore: in worlds that reward a sequence part by part, new prompts keep the goals of the
    best trajectory that were rewarded and shuffle those after them [False]."""
    out: Path | None = None
    """Result folder (default: runs/adapt/ENV/BANDIT-seedSEED)."""
    figures: bool = True
    """Draw the figures."""
    options: Annotated[OptimizerConfig, tyro.conf.arg(name="")] = field(
        default_factory=OptimizerConfig
    )

    @property
    def folder(self) -> Path:
        return self.out or RUNS / "adapt" / self.env / f"{self.bandit}-seed{self.seed}"


def summarize(
    config: AdaptConfig, outcome: Outcome, optimum: np.ndarray, policy_sha256: str
) -> dict[str, Any]:
    """The numbers of ``summary.json`` and of the printed table."""
    final = outcome.eval_returns[:, :, -1]
    regret = optimum - final
    iqm = stratified_bootstrap_iqm(final)
    after = np.searchsorted(outcome.eval_episodes, 40)
    at_40 = None
    if after < len(outcome.eval_episodes) and outcome.eval_episodes[after] == 40:
        at_40 = float((optimum - outcome.eval_returns[:, :, after]).mean())
    spread = seed_spread(final)
    return {
        "env": config.env,
        "optimizer": config.bandit,
        "policy_sha256": policy_sha256,
        "num_tasks": final.shape[1],
        "num_seeds": final.shape[0],
        "num_episodes": config.episodes,
        "initial_return": float(outcome.eval_returns[:, :, 0].mean()),
        "final_return": spread.mean,
        "final_return_std_over_seeds": spread.std,
        "final_return_iqm": iqm.value,
        "final_return_iqm_95": [iqm.low, iqm.high],
        "optimal_return": float(optimum.mean()),
        "regret": float(regret.mean()),
        "regret_std_over_seeds": seed_spread(regret).std,
        "regret_after_40": at_40,
        "solved_optimally": float((regret < 1e-4).mean()),
        "failed_episodes": outcome.num_failed,
        "best_episode_return": float(outcome.log.returns.max(axis=-1).mean()),
        "cpu_seconds": outcome.cpu_seconds,
        "episodes_per_cpu_second": outcome.num_episodes / outcome.cpu_seconds,
    }


def table(summary: dict[str, Any]) -> str:
    """The printed result."""
    low, high = summary["final_return_iqm_95"]
    after_40, failed = summary["regret_after_40"], summary["failed_episodes"]
    rows = [
        ("initial return", f"{summary['initial_return']:.3f}"),
        (
            "final return",
            f"{summary['final_return']:.3f} ± {summary['final_return_std_over_seeds']:.3f}"
            " (mean ± std over seeds)",
        ),
        ("  IQM", f"{summary['final_return_iqm']:.3f} [{low:.3f}, {high:.3f}] (95 %)"),
        ("optimal return", f"{summary['optimal_return']:.3f}"),
        ("regret", f"{summary['regret']:.3f} ± {summary['regret_std_over_seeds']:.3f}"),
        ("  after 40", "-" if after_40 is None else f"{after_40:.3f}"),
        ("solved optimally", f"{100 * summary['solved_optimally']:.0f} %"),
        *[("failed episodes", f"{failed} (the world broke down)")] * (failed > 0),
        (
            "speed",
            f"{summary['episodes_per_cpu_second']:.0f} episodes per CPU-second"
            f" ({summary['cpu_seconds']:.0f} CPU-seconds)",
        ),
    ]
    head = (
        f"{summary['env']}, {summary['optimizer']}: {summary['num_tasks']} tasks x "
        f"{summary['num_seeds']} seeds x {summary['num_episodes']} episodes"
    )
    return "\n".join([head, "-" * len(head), *(f"{name:<17} {text}" for name, text in rows)])


def save_results(
    folder: Path,
    config: AdaptConfig,
    outcome: Outcome,
    tasks: Task,
    optimum: np.ndarray,
    policy_sha256: str,
) -> dict[str, Any]:
    """Write raw results, tasks, summary and provenance to a new folder."""
    log = outcome.log
    summary = summarize(config, outcome, optimum, policy_sha256)
    with new_folder(folder) as partial:
        np.savez_compressed(
            partial / "results.npz",
            allow_pickle=False,
            returns=log.returns,
            greedy=log.greedy,
            prompt_goals=log.prompts.goals,
            prompt_masks=log.prompts.mask,
            best_goals=log.best.goals,
            best_masks=log.best.mask,
            eval_episodes=outcome.eval_episodes,
            eval_returns=outcome.eval_returns,
            optimal_returns=optimum,
        )
        save_tasks(partial / "tasks.npz", tasks)
        write_json(partial / "config.json", config)
        write_json(partial / "meta.json", provenance())
        write_json(partial / "summary.json", summary)
    return summary


def chosen_tasks(env: Environment, path: Path | None, validation: bool) -> Task:
    """A user's tasks, the world's test tasks, or as many others."""
    if validation and path is not None:
        raise UsageError("--validation draws the tasks; leave out --tasks")
    if validation:
        return evaluation_tasks(env, env.spec.num_test_tasks)
    if path is not None:
        return load_tasks(path, env)
    released = released_folder(env.spec.name) / "tasks.npz"
    return load_tasks(released, env) if released.is_file() else benchmark_tasks(env)


def chosen_optimizer(config: AdaptConfig) -> Callable[..., Any]:
    """The optimizer's factory with the hyper-parameters that were given."""
    if config.bandit not in OPTIMIZERS:
        raise nearest(config.bandit, OPTIMIZERS, "optimizer")
    values = {f.name: getattr(config.options, f.name) for f in fields(config.options)}
    given = {name: value for name, value in values.items() if value is not None}
    factory = OPTIMIZERS[config.bandit]
    takes = factory.__code__.co_varnames[: factory.__code__.co_argcount]
    for name in given:
        if name not in takes:
            raise UsageError(f"--{name.replace('_', '-')} is no option of {config.bandit}")
    return partial(factory, **given)


def main(config: AdaptConfig) -> None:
    """Search a prompt for each task within a budget of episodes."""
    positive(config, "seeds", "episodes", "max_goals", "eval_every", "eval_episodes")
    positive(config.options, "num_edits", "population_size", "latent_dim")
    for name in ("scale", "min_std", "std_init"):
        value = getattr(config.options, name)
        if value is not None and not 0 < value < math.inf:
            flag = f"--{name.replace('_', '-')}"
            raise UsageError(f"{flag} must be finite and above 0, found {value}")
    env = make_env(config.env)
    make_optimizer = chosen_optimizer(config)
    network = load_network(env, config.policy)
    longest = network.config.max_prompt_length
    if config.max_goals is not None and config.max_goals > longest:
        raise UsageError(
            f"--max-goals {config.max_goals} is longer than the policy's prompts ({longest} goals); "
            "pre-train with --max-prompt-length"
        )
    tasks = chosen_tasks(env, config.tasks, config.validation)
    folder = config.folder
    refuse_existing(folder, "remove it", "choose another with --out")
    optimum = np.asarray(jax.jit(jax.vmap(env.optimal_return))(tasks))
    outcome = run_adaptation(
        env,
        network,
        make_optimizer,
        tasks,
        seeds=config.seeds,
        episodes=config.episodes,
        seed=config.seed,
        max_goals=config.max_goals,
        eval_every=config.eval_every,
        eval_episodes=config.eval_episodes,
        keep_rewarded=config.keep_rewarded,
    )
    summary = save_results(folder, config, outcome, tasks, optimum, network.sha256)
    print(table(summary))
    if config.figures:
        from experiments.plot import draw_run

        draw_run(folder)
    print(f"results in {folder}", file=sys.stderr)


if __name__ == "__main__":
    run(tyro.conf.OmitArgPrefixes[AdaptConfig], main)
