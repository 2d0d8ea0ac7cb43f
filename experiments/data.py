"""Datasets of your own logs: ``python -m experiments.data import logs.hdf5 --goal-columns 0 1 --out mine``.

``import`` converts logs to a dataset, ``export`` converts a dataset to logs, ``check`` finds faults in a
dataset, and ``info`` describes it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from envs.errors import DataError, UsageError, nearest
from experiments.runtime import refuse_existing, refuse_existing_file, run, say
from experiments.store.data_settings import (
    SUBCOMMANDS,
    CheckDataConfig,
    DataCommandConfig,
    ExportConfig,
    ImportConfig,
    InfoConfig,
    check_import,
    require_folder,
)


def main(config: DataCommandConfig) -> None:
    """Import, export, check or describe datasets of your own logs."""
    if not config.what:
        raise UsageError(
            f"no command given; name one of {', '.join(SUBCOMMANDS)}, such as "
            "`python -m experiments.data import --help`"
        )
    raise nearest(config.what, SUBCOMMANDS, "command of experiments.data")


def import_logs(config: ImportConfig) -> None:
    """Convert logs to a dataset, which `experiments.pretrain --data FOLDER` trains on."""
    check_import(config)
    assert config.out is not None
    refuse_existing(config.out, "remove it", "choose another folder with --out")
    from experiments.importing import import_dataset

    say(import_dataset(config))


def export_logs(config: ExportConfig) -> None:
    """Export a dataset as flat arrays in an npz file, or as a Minari dataset in a folder."""
    folder = require_folder(config.folder, "export")
    if config.out is None:
        raise UsageError("--out is missing; give an npz file, or a folder for a Minari dataset")
    if config.out.suffix == ".npz":
        refuse_existing_file(config.out, "--out")
    else:
        refuse_existing(config.out, "remove it", "choose another folder with --out")
    from experiments.exporting_data import export_dataset

    export_dataset(folder, config.out, config.author)
    print(f"written to {config.out}", file=sys.stderr)


def check_data(config: CheckDataConfig) -> None:
    """Report the faults of a dataset, one sentence for each; exits with 1 if there are any."""
    folder = require_folder(config.folder, "check")
    from experiments.soundness import examine

    found = examine(folder, config.env, config.horizon)
    if config.json:
        from experiments.describing import findings

        say(json.dumps(findings(found, config.most), indent=2))
    else:
        say("\n".join(found.lines(config.most)))
    if found.faults:
        raise DataError(
            f"{folder} has {found.num_faults} fault(s) of {len(found.faults)} kind(s); fix the logs, or "
            "leave these trajectories out, and import them again"
        )


def show_info(config: InfoConfig) -> None:
    """Describe a dataset: counts, lengths, shapes, spreads, sizes, and origin."""
    folder = require_folder(config.folder, "info")
    from experiments.describing import described, facts_of

    say(json.dumps(facts_of(folder), indent=2) if config.json else described(folder))


RUNS: dict[str, Callable[[Any], None]] = {
    "import": import_logs,
    "export": export_logs,
    "check": check_data,
    "info": show_info,
}


def command(argv: Sequence[str] | None = None) -> NoReturn:
    words = list(sys.argv[1:] if argv is None else argv)
    if words and words[0] in SUBCOMMANDS:
        run(SUBCOMMANDS[words[0]], RUNS[words[0]], argv=words[1:], subcommand=words[0])
    if words and not words[0].startswith("-"):  # an unknown subcommand: report it, not its flags
        words = words[:1]
    run(DataCommandConfig, main, argv=words)


if __name__ == "__main__":
    command()
