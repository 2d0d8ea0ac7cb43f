"""Release a trained policy: ``python -m experiments.release runs/pretrain/maze15/fast-seed0``.

Puts weights, config, the world's test tasks and a model card into the package, where every other command
finds them by default.
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


@dataclass(frozen=True, kw_only=True)
class ReleaseConfig(Common):
    """Settings of ``experiments.release``."""

    source: tyro.conf.Positional[Path]
    """Folder of a finished pre-training run."""
    out: Path | None = None
    """Folder to write (default: mgpo_jax/pretrained/ENV)."""


def main(config: ReleaseConfig) -> None:
    """Package a finished pre-training run as a released policy."""
    policy = config.source / "policy"
    if not policy.is_dir():
        raise UsageError(f"{config.source} has no finished policy; let its training end first")
    from experiments.store.cards import release, world_of

    folder = config.out or world_of(policy)
    refuse_existing(folder, "remove it", "choose another with --out")
    release(config.source, folder)
    print(f"released in {folder}", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(ReleaseConfig, main, argv=argv)


if __name__ == "__main__":
    command()
