"""List the worlds and methods: ``python -m experiments.list``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

import envs
from experiments.runtime import Common, run
from mgpo_jax import methods


@dataclass(frozen=True)
class ListConfig(Common):
    """Settings of ``experiments.list``."""


def main(config: ListConfig) -> None:
    """List the worlds and methods that are known by name."""
    del config
    print("worlds (--env)")
    for name in envs.names():
        print(f"  {name:<16} {envs.find(name).summary}")
    print("\nmethods (--method)")
    for name in methods.names():
        print(f"  {name:<16} {methods.find(name).summary}")
    print("\nOthers are given as module:attribute, such as --env my_package.my_world:WORLD.")


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(ListConfig, main, argv=argv)


if __name__ == "__main__":
    command()
