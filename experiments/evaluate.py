"""Evaluate optimized prompts under noise: ``python -m experiments.evaluate RUN_DIR --obs-noise 0.1``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import tyro

from envs.errors import UsageError
from experiments.runtime import Common, refuse_existing, run
from mgpo_jax.settings import number


@dataclass(frozen=True)
class EvaluateConfig(Common):
    """Settings of ``experiments.evaluate``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of adaptations."""
    env: str | None = None
    """Evaluate in another world that has the same tasks (default: where the prompts were found)."""
    obs_noise: tuple[float, ...] = ()
    """Standard deviations of noise on observations, in their units; a row for each."""
    action_noise: tuple[float, ...] = ()
    """Standard deviations of noise on actions; where they are discrete, probabilities of a random one."""
    episodes: int = number(10, at_least=1)
    """Episodes under each prompt, judged as the world's record says."""
    seed: int = 0
    """Seed of the noise."""
    json: Path | None = None
    """Also write the rows to this file."""


def main(config: EvaluateConfig) -> None:
    """Evaluate the optimized prompts of adaptations once more, under noise (Table 3) or elsewhere."""
    if not config.runs:
        raise UsageError(
            "no result folder given; usage: python -m experiments.evaluate RUN_DIR ..."
        )
    if config.json:
        if not config.json.parent.is_dir():
            raise UsageError(f"no folder {config.json.parent} to write {config.json.name} to")
        refuse_existing(config.json, "remove it", "choose another with --json")
    from experiments.evaluation import HEAD, cells, evaluate_case, noises, open_case
    from experiments.store.provenance import provenance
    from experiments.store.tables import table
    from mgpo_jax.files import write_json

    sizes = noises(config.obs_noise, config.action_noise)
    cases = [open_case(folder, config.env, sizes) for folder in config.runs]
    rows = [row for case in cases for row in evaluate_case(case, config.episodes, config.seed)]
    print(table(HEAD, [cells(row) for row in rows]))
    if num_failed := sum(row["failed_episodes"] for row in rows):
        total = sum(row["num_episodes"] for row in rows)
        print(f"{num_failed} of {total} episodes ended because the world broke down")
    if config.json:
        write_json(config.json, {"rows": rows, **provenance()})
        print(f"rows in {config.json}", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(EvaluateConfig, main, argv=argv)


if __name__ == "__main__":
    command()
