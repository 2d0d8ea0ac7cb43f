"""Check a world, or compare one with its official implementation under optimized prompts.

``python -m experiments.check my_package.my_world:WORLD`` and ``python -m experiments.check RUN_DIR``.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import tyro

import envs
from envs.errors import DataError, UsageError, nearest
from experiments.runtime import Common, refuse_existing_file, run, say
from experiments.signals import farewell
from mgpo_jax.settings import Name


@dataclass(frozen=True)
class CheckConfig(Common):
    """Settings of ``experiments.check``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Worlds to check, by name or as module:attribute; or result folders of adaptations, whose worlds are
    compared with their official implementations."""
    env: Name | None = None
    """The world to compare with its official implementation (default: the one that the prompts were found
    in)."""
    policy: Path | None = None
    """Folder of the policy that the results were made with, if it has been moved."""
    out: Path | None = None
    """JSON file to write the findings to."""
    json: bool = False
    """Print the findings as JSON."""


def main(config: CheckConfig) -> None:
    """Check whether worlds satisfy the environment contract; given result folders, act greedily under their
    optimized prompts in a world and in its official implementation, and compare."""
    if not config.runs:
        raise UsageError(
            "no result folder given, and no world; usage: python -m experiments.check RUN_DIR ..., or "
            "python -m experiments.check my_package.my_world:WORLD"
        )
    if config.out:
        refuse_existing_file(config.out, "--out")
    if worlds := named_worlds(config):
        check(worlds, config.out, config.json)
    else:
        compare_runs(config)


def named_worlds(config: CheckConfig) -> list[str]:
    """The worlds to check; empty if only result folders were given.

    Raises:
      UsageError: for an unknown world, or a mixture of worlds and result folders.
    """
    missing = [str(path) for path in config.runs if not os.path.lexists(path)]
    words = [name for name in missing if "/" not in name]  # the others can only be folders
    names = [name for name in words if name in envs.names() or ":" in name]
    if lost := [name for name in words if name not in names]:
        raise nearest(lost[0], envs.names(), "folder or world")
    if names and len(names) < len(config.runs):
        raise UsageError("give worlds to check, or result folders to compare, not both at once")
    if names and (config.env or config.policy):
        raise UsageError(
            "--env and --policy are for result folders; leave them out to check a world"
        )
    for name in names:
        envs.find(name)
    return names


def check(names: Sequence[str], out: Path | None, as_json: bool = False) -> None:
    """Check worlds one after the other, and print a report of each, or all of them as JSON.

    Raises:
      DataError: if any of them has a fault, after all reports.
    """
    from experiments.store.provenance import provenance
    from mgpo_jax.files import write_json

    reports = {}
    for name in names:
        reports[name] = envs.check_world(name)
        if not as_json:
            say(str(reports[name]))
    found = {name: dataclasses.asdict(report) for name, report in reports.items()}
    if as_json:
        say(json.dumps({"worlds": found}, indent=2))
    if out:
        write_json(out, {"worlds": found, **provenance()})
        print(f"results written to {out}", file=sys.stderr)
    broken = [name for name, report in reports.items() if report.faults]
    if broken:
        raise DataError(
            f"faults found in {', '.join(broken)}; fix those listed above before any training"
        )


def compare_runs(config: CheckConfig) -> None:
    """Compare the worlds of adaptations with their official implementations."""
    from experiments.checking import HEAD, cells, compare, officials_of, summaries, told
    from experiments.evaluation import open_case
    from experiments.store.provenance import provenance
    from experiments.store.tables import table
    from mgpo_jax.files import to_json, write_json

    cases = [open_case(folder, config.env, (), config.policy) for folder in config.runs]
    officials = officials_of(cases)
    rows: list[dict[str, Any]] = []

    def report() -> None:
        found = summaries(cases, rows)
        if config.json:
            say(json.dumps(to_json({"summaries": found, "rows": rows}), indent=2))
        else:
            say("\n".join([table(HEAD, [cells(row) for row in rows]), *map(told, found)]))
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
        print(f"results written to {config.out}", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(CheckConfig, main, argv=argv)


if __name__ == "__main__":
    command()
