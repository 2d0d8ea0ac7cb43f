"""List the worlds, methods and networks: ``python -m experiments.list``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

from envs.errors import UsageError
from envs.registry import WORLDS, Registry
from experiments.runtime import Common, run, say
from mgpo_jax.kinds import KINDS
from mgpo_jax.methods import METHODS


@dataclass(frozen=True)
class ListConfig(Common):
    """Settings of ``experiments.list``."""


def main(config: ListConfig) -> None:
    """List the worlds, methods and networks that are known by name."""
    del config
    registries: dict[str, Registry[Any]] = {
        "worlds (--env)": WORLDS,
        "methods (adapt --method)": METHODS,
        "networks (pretrain --method)": KINDS,
    }
    for title, registry in registries.items():
        say(title)
        for name in registry.names():
            try:
                summary = registry.find(name).summary
            except UsageError as error:  # of a package that is installed beside this one
                summary = str(error)
            say(f"  {name:<18} {summary}")
        say("")
    say("Others are given as module:attribute, such as --env my_package.my_world:WORLD.")


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(ListConfig, main, argv=argv)


if __name__ == "__main__":
    command()
