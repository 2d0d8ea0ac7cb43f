"""Evaluate optimized prompts under noise: ``python -m experiments.evaluate RUN_DIR --obs-noise 0.1``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import tyro

from envs.noisy import Noisy
from experiments.adaptation import NUM_EVAL_EPISODES, evaluate_prompts
from experiments.configs import make_env, positive
from experiments.policies import load_network
from experiments.results import Results, load_results
from experiments.runtime import Common, provenance, run, write_json
from experiments.statistics import seed_spread
from experiments.tasks import load_tasks
from mgpo_jax.errors import UsageError
from mgpo_jax.types import Prompt


@dataclass(frozen=True)
class EvaluateConfig(Common):
    """Settings of ``experiments.evaluate``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of adaptations."""
    obs_noise: float = 0.0
    """Standard deviation of noise on observations, in their units."""
    action_noise: float = 0.0
    """Standard deviation of noise on actions; where they are discrete, the probability of a random one."""
    episodes: int = NUM_EVAL_EPISODES
    """Greedy episodes under each prompt."""
    seed: int = 0
    """Seed of the noise."""
    json: Path | None = None
    """Also write the rows to this file."""


def noisy_world(config: EvaluateConfig, result: Results) -> Noisy:
    """The world of an adaptation, with noise."""
    try:
        return Noisy(make_env(result.config["env"]), config.obs_noise, config.action_noise)
    except ValueError as error:
        raise UsageError(str(error)) from None


def evaluate_run(
    config: EvaluateConfig, folder: Path, result: Results, env: Noisy
) -> dict[str, str | float]:
    """The optimized prompts of one adaptation in its world with noise."""
    path = result.config.get("policy")
    network = load_network(env, path and Path(path))
    prompts = Prompt(
        jnp.asarray(result.best_goals[:, :, -1]), jnp.asarray(result.best_masks[:, :, -1])
    )
    returns, num_failed = evaluate_prompts(
        env,
        network,
        load_tasks(folder / "tasks.npz", env),
        prompts,
        episodes=config.episodes,
        seed=config.seed,
    )
    noisy, quiet = seed_spread(returns), seed_spread(result.eval_returns[:, :, -1])
    return {
        "env": result.config["env"],
        "optimizer": result.config["bandit"],
        "obs_noise": config.obs_noise,
        "action_noise": config.action_noise,
        "return": noisy.mean,
        "std_over_seeds": noisy.std,
        "without_noise": quiet.mean,
        "change": noisy.mean - quiet.mean,
        "failed_episodes": num_failed,
    }


def main(config: EvaluateConfig) -> None:
    """Evaluate the optimized prompts of adaptations once more, under noise (Table 3)."""
    positive(config, "episodes")
    if not config.runs:
        raise UsageError(
            "no result folder given; usage: python -m experiments.evaluate RUN_DIR ..."
        )
    if min(config.obs_noise, config.action_noise) < 0:
        raise UsageError("--obs-noise and --action-noise must not be negative")
    if config.json and not config.json.parent.is_dir():
        raise UsageError(f"no folder {config.json.parent} to write {config.json.name} to")
    results = [load_results(folder) for folder in config.runs]
    worlds = [noisy_world(config, result) for result in results]
    head = ["env", "optimizer", "without noise", "with noise (mean ± std over seeds)", "change"]
    print(f"| {' | '.join(head)} |\n|{' --- |' * len(head)}")
    rows = []
    for folder, result, env in zip(config.runs, results, worlds, strict=True):
        row = evaluate_run(config, folder, result, env)
        rows.append(row)
        print(
            f"| {row['env']} | {row['optimizer']} | {row['without_noise']:.3f} "
            f"| {row['return']:.3f} ± {row['std_over_seeds']:.3f} | {row['change']:+.3f} |",
            flush=True,
        )
    if config.json:
        write_json(config.json, {"rows": rows, **provenance()})
        print(f"rows in {config.json}", file=sys.stderr)


if __name__ == "__main__":
    run(EvaluateConfig, main)
