"""Release a trained policy: ``python -m experiments.release runs/pretrain/maze15/fast-seed0``.

This puts the weights, the config, the world's test tasks and a model card into the package, where all other
commands find them by default.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import tyro

from envs.errors import UsageError
from experiments.runtime import Common, refuse_existing, run
from experiments.store.runs import is_finished
from mgpo_jax.settings import Name


@dataclass(frozen=True, kw_only=True)
class ReleaseConfig(Common):
    """Settings of ``experiments.release``."""

    source: tyro.conf.Positional[Path | None] = None
    """Folder of a finished pre-training run."""
    out: Path | None = None
    """Output folder (default: mgpo_jax/pretrained/ENV)."""
    env: Name | None = None
    """The world of the run, as module:attribute if it is not registered."""


def main(config: ReleaseConfig) -> None:
    """Package a finished pre-training run as a released policy."""
    if config.source is None:
        raise UsageError("no run folder given; usage: python -m experiments.release RUN_DIR")
    if not is_finished(config.source):
        raise UsageError(f"{config.source} has no finished policy; let its training end first")
    from experiments.store.cards import read_run, release

    finished = read_run(config.source, config.env)
    folder = config.out or finished.released
    refuse_existing(folder, "remove it", "choose another folder with --out")
    release(finished, folder)
    print(f"released in {folder}", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(ReleaseConfig, main, argv=argv)


if __name__ == "__main__":
    command()
