"""Evaluate optimized prompts under noise: ``python -m experiments.evaluate RUN_DIR --obs-noise 0.1``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import tyro

from envs.base import Environment, Task
from envs.noisy import Noisy
from experiments.adaptation import NUM_EVAL_EPISODES, evaluate_prompts
from experiments.configs import make_env, positive
from experiments.policies import LoadedPolicy, load_network_of
from experiments.results import Results, load_results
from experiments.runtime import Common, provenance, refuse_existing, run, write_json
from experiments.statistics import seed_spread
from experiments.tasks import load_tasks
from mgpo_jax.errors import UsageError
from mgpo_jax.types import Prompt


@dataclass(frozen=True)
class EvaluateConfig(Common):
    """Settings of ``experiments.evaluate``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of adaptations."""
    env: str | None = None
    """Evaluate in another world with the same tasks, such as kitchen-stock (default: where the prompts
    were found)."""
    obs_noise: tuple[float, ...] = ()
    """Standard deviations of noise on observations, in their units; a row for each."""
    action_noise: tuple[float, ...] = ()
    """Standard deviations of noise on actions; where they are discrete, probabilities of a random one."""
    episodes: int = NUM_EVAL_EPISODES
    """Greedy episodes under each prompt."""
    seed: int = 0
    """Seed of the noise."""
    json: Path | None = None
    """Also write the rows to this file."""


class Noise(NamedTuple):
    """Its sizes on observations and on actions."""

    obs: float = 0.0
    action: float = 0.0

    def __str__(self) -> str:
        named = {"observations": self.obs, "actions": self.action}
        return ", ".join(f"{name} {size:g}" for name, size in named.items() if size) or "none"


class Case(NamedTuple):
    """An adaptation, its tasks and network, and the world that its prompts go to."""

    result: Results
    env: Environment
    tasks: Task
    network: LoadedPolicy


def noises(config: EvaluateConfig) -> list[Noise]:
    """What to evaluate under: each size by itself, or none."""
    of_obs = [Noise(obs=size) for size in config.obs_noise]
    return of_obs + [Noise(action=size) for size in config.action_noise] or [Noise()]


def open_case(config: EvaluateConfig, folder: Path) -> Case:
    """Read an adaptation, and check that its policy and tasks fit the world."""
    result = load_results(folder)
    env = make_env(config.env or result.config["env"])
    tasks = load_tasks(folder / "tasks.npz", env)
    return Case(result, env, tasks, load_network_of(result, env))


def noisy_world(env: Environment, noise: Noise) -> Noisy:
    """The world behind noise, with the error of a command line."""
    try:
        return Noisy(env, noise.obs, noise.action)
    except ValueError as error:
        raise UsageError(str(error)) from None


def evaluate_case(config: EvaluateConfig, case: Case) -> Iterator[dict[str, Any]]:
    """The optimized prompts of one adaptation, a row for each noise."""
    result = case.result
    last = (slice(None), slice(None), -1)
    prompts = Prompt(jnp.asarray(result.best_goals[last]), jnp.asarray(result.best_masks[last]))
    before = seed_spread(result.eval_returns[last])
    for noise in noises(config):
        returns, num_failed = evaluate_prompts(
            noisy_world(case.env, noise),
            case.network,
            case.tasks,
            prompts,
            episodes=config.episodes,
            seed=config.seed,
        )
        now = seed_spread(returns)
        yield {
            "env": config.env or result.config["env"],
            "optimizer": result.config["bandit"],
            "noise": str(noise),
            "obs_noise": noise.obs,
            "action_noise": noise.action,
            "adapted": before.mean,
            "return": now.mean,
            "std_over_seeds": now.std,
            "change": now.mean - before.mean,
            "failed_episodes": num_failed,
            "num_episodes": returns.size * config.episodes,
        }


def main(config: EvaluateConfig) -> None:
    """Evaluate the optimized prompts of adaptations once more, under noise (Table 3) or elsewhere."""
    positive(config, "episodes")
    if not config.runs:
        raise UsageError(
            "no result folder given; usage: python -m experiments.evaluate RUN_DIR ..."
        )
    if config.json:
        if not config.json.parent.is_dir():
            raise UsageError(f"no folder {config.json.parent} to write {config.json.name} to")
        refuse_existing(config.json, "remove it", "choose another with --json")
    cases = [open_case(config, folder) for folder in config.runs]
    for case in cases:  # complain before the first row
        for noise in noises(config):
            noisy_world(case.env, noise)
    head = ["env", "optimizer", "adapted", "noise", "return (mean ± std over seeds)", "change"]
    print(f"| {' | '.join(head)} |\n|{' --- |' * len(head)}")
    rows = []
    for case in cases:
        for row in evaluate_case(config, case):
            rows.append(row)
            print(
                f"| {row['env']} | {row['optimizer']} | {row['adapted']:.3f} | {row['noise']} "
                f"| {row['return']:.3f} ± {row['std_over_seeds']:.3f} | {row['change']:+.3f} |",
                flush=True,
            )
    if num_failed := sum(row["failed_episodes"] for row in rows):
        total = sum(row["num_episodes"] for row in rows)
        print(f"{num_failed} of {total} episodes ended because the world broke down")
    if config.json:
        write_json(config.json, {"rows": rows, **provenance()})
        print(f"rows in {config.json}", file=sys.stderr)


if __name__ == "__main__":
    run(EvaluateConfig, main)
