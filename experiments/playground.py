"""Make a web page to guide a policy by hand: ``python -m experiments.playground --env maze15``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from envs.errors import UsageError, printable
from experiments.runtime import Common, run
from experiments.store.seals import check_page
from experiments.store.settings import DEFAULT_WORLD
from mgpo_jax.settings import Name


@dataclass(frozen=True)
class PlaygroundConfig(Common):
    """Settings of ``experiments.playground``."""

    env: tuple[Name, ...] = (DEFAULT_WORLD,)
    """The worlds of the page, by name or as module:attribute."""
    policy: Path | None = None
    """Folder of the policy that acts, for a page of one world (default: the world's released policy)."""
    out: Path = Path("playground.html")
    """HTML file to write; it is self-contained and needs no server or network."""


def main(config: PlaygroundConfig) -> None:
    """Make an HTML page in which anyone guides a frozen policy by clicking goals."""
    if not config.env:
        raise UsageError("--env names no world; name at least one")
    if config.policy is not None and len(set(config.env)) > 1:
        raise UsageError("--policy is for a page of one world; name one with --env")
    check_page(config.out)
    import envs

    worlds = [envs.find(name) for name in dict.fromkeys(config.env)]
    from experiments.pages.playground import playground
    from experiments.store.seals import write_sealed

    page = playground(worlds, config.policy)
    write_sealed(config.out, lambda path: path.write_text(page, encoding="utf-8"))
    print(printable(str(config.out)), file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(PlaygroundConfig, main, argv=argv)


if __name__ == "__main__":
    command()
