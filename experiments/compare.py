"""Compare adaptations to the same tasks pair by pair: ``python -m experiments.compare RUN_DIR RUN_DIR``."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import tyro

import envs
from envs.errors import UsageError, printable
from experiments.runtime import Common, refuse_existing_file, run, say
from mgpo_jax.settings import Name


@dataclass(frozen=True)
class CompareConfig(Common):
    """Settings of ``experiments.compare``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of two or more adaptations; each is compared with the first."""
    env: Name | None = None
    """Your own world, as module:attribute, if the results are from one."""
    csv: Path | None = None
    """CSV file to write the final return of each task to: the mean of each run, and each of its seeds."""
    profile: Path | None = None
    """PNG file to draw performance profiles to: the share of tasks and seeds that reach each score."""
    json: bool = False
    """Print the comparison as JSON."""


def main(config: CompareConfig) -> None:
    """Compare the final returns of adaptations with those of the first, paired by task, with 95 %
    intervals."""
    if len(config.runs) < 2:
        found = "".join(printable(str(folder)) for folder in config.runs) or "none"
        raise UsageError(
            f"comparing needs two result folders or more, found {found}; usage: "
            "python -m experiments.compare RUN_DIR RUN_DIR ..."
        )
    if config.csv is not None:
        refuse_existing_file(config.csv, "--csv")
    if config.profile is not None:
        if config.profile.suffix != ".png":
            raise UsageError(f"--profile {config.profile} must end in .png")
        refuse_existing_file(config.profile, "--profile")
    if config.env is not None:
        envs.find(config.env)  # imports the module, so that the results may name it
    from experiments.pairing import as_csv, as_table, as_values, differing
    from experiments.store.result_files import load_results

    results = [load_results(folder, parts=()) for folder in config.runs]
    if config.json:
        text = json.dumps(as_values(config.runs, results), indent=2)
    else:
        text = as_table(config.runs, results)
    for warning in differing(config.runs, results):
        print(f"warning: {warning}", file=sys.stderr)
    say(text)
    if config.csv is not None:
        from mgpo_jax.files import write_text

        write_text(config.csv, as_csv(config.runs, results))
    if config.profile is not None:
        from experiments.drawing import labeled, write
        from experiments.figures import later, performance_profiles

        named = labeled(dict(zip(config.runs, results, strict=True)))
        write(config.profile, later(performance_profiles, named, results[0].env))


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(CompareConfig, main, argv=argv)


if __name__ == "__main__":
    command()
