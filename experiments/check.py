"""Compare a world with its official program: ``python -m experiments.check RUN_DIR --out FILE.json``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import tyro

from experiments.runtime import Common, refuse_existing_file, require_runs, run, say
from experiments.signals import farewell
from mgpo_jax.settings import Name


@dataclass(frozen=True)
class CheckConfig(Common):
    """Settings of ``experiments.check``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of adaptations."""
    env: Name | None = None
    """World to compare with its official program (default: where the prompts were found)."""
    policy: Path | None = None
    """Folder of the policy that the results were found with, where it is no longer at its place."""
    out: Path | None = None
    """Also write what was found to this file."""


def main(config: CheckConfig) -> None:
    """Act greedily under optimized prompts in a world and in its official program, and compare."""
    require_runs(config.runs, "check")
    if config.out:
        refuse_existing_file(config.out, "--out")
    from experiments.checking import HEAD, cells, compare, officials_of, summaries, told
    from experiments.evaluation import open_case
    from experiments.store.provenance import provenance
    from experiments.store.tables import table
    from mgpo_jax.files import write_json

    cases = [open_case(folder, config.env, (), config.policy) for folder in config.runs]
    officials = officials_of(cases)
    rows: list[dict[str, Any]] = []

    def report() -> None:
        say(table(HEAD, [cells(row) for row in rows]))
        found = summaries(cases, rows)
        for summary in found:
            say(told(summary))
        if config.out:
            write_json(config.out, {"summaries": found, "rows": rows, **provenance()})

    def unfinished() -> str:
        if rows:
            report()
        return f"stopped after {len(rows)} prompts"

    with farewell(unfinished):
        for row in compare(cases, officials):
            rows.append(row)
    report()
    if config.out:
        print(f"rows in {config.out}", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(CheckConfig, main, argv=argv)


if __name__ == "__main__":
    command()
