"""Evaluate optimized prompts under noise: ``python -m experiments.evaluate RUN_DIR --obs-noise 0.1``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NoReturn

import tyro

from experiments.joining import Joined, check_flags, join
from experiments.runtime import refuse_existing_file, require_runs, run, say
from experiments.signals import farewell
from mgpo_jax import processes
from mgpo_jax.settings import Name, NotNegative, NumEpisodes, Seed


@dataclass(frozen=True)
class EvaluateConfig(Joined):
    """Settings of ``experiments.evaluate``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of adaptations."""
    env: Name | None = None
    """The world to evaluate in, which must have the same tasks (default: the one that the prompts were
    found in)."""
    obs_noise: tuple[NotNegative | Literal["official"], ...] = ()
    """Standard deviations of the noise on observations, in their units, or ``official`` for the noise that
    the world's official implementation adds by default; a row for each."""
    action_noise: tuple[NotNegative, ...] = ()
    """Standard deviations of the noise on continuous actions, or probabilities of a random action for
    discrete ones; a row for each."""
    episodes: NumEpisodes = 10
    """Number of episodes under each prompt, greedy or sampled as the world's record says."""
    seed: Seed = 0
    """Random seed of the episodes."""
    policy: Path | None = None
    """Folder of the policy that the results were made with, if it has been moved."""
    json: Path | None = None
    """JSON file to write the rows to."""


def main(config: EvaluateConfig) -> None:
    """Evaluate optimized prompts of adaptations once more, under noise (Table 3) or in another world."""
    check_flags(config)
    require_runs(config.runs, "evaluate")
    if config.json:
        refuse_existing_file(config.json, "--json")
    join(config)
    from experiments.evaluation import (
        HEAD,
        achieved_table,
        cells,
        evaluate_cases,
        noises,
        open_case,
    )
    from experiments.store.provenance import provenance
    from experiments.store.tables import table
    from mgpo_jax.files import write_json

    sizes = noises(config.obs_noise, config.action_noise)
    cases = [open_case(folder, config.env, sizes, config.policy) for folder in config.runs]
    rows: list[dict[str, Any]] = []

    def unfinished() -> str:
        if rows:
            say(table(HEAD, [cells(row) for row in rows]))
            if config.json and processes.is_first():
                write_json(config.json, {"rows": rows, **provenance()})
        return f"stopped after {len(rows)} rows; run it again with the runs or noises that are left"

    with farewell(unfinished):
        for row in evaluate_cases(cases, config.episodes, config.seed):
            rows.append(row)
    say(table(HEAD, [cells(row) for row in rows]))
    if goals := achieved_table(rows):
        say(goals)
    if num_failed := sum(row["failed_episodes"] for row in rows):
        total = sum(row["num_episodes"] for row in rows)
        say(f"{num_failed} of {total} episodes ended because the simulation failed")
    if config.json and processes.is_first():
        write_json(config.json, {"rows": rows, **provenance()})
        print(f"results written to {config.json}", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(EvaluateConfig, main, argv=argv)


if __name__ == "__main__":
    command()
