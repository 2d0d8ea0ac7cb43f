"""What is installed: extras of this package, released networks, sizes of folders. Does not import jax."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from envs.installing import DISTRIBUTION, how_to_install
from envs.registry import World
from experiments.store.runs import WEIGHTS
from mgpo_jax.kinds import KINDS
from mgpo_jax.released import released_folder

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
OF_EXTRA = re.compile(r"extra\s*==\s*['\"]([^'\"]+)['\"]")
INDIRECT = (
    "all",
    "browser",
    "dev",
    "docs",
    "notebook",
)  # extras for developers, or made of other extras


class Extra(NamedTuple):
    """An extra of this package."""

    name: str
    packages: tuple[str, ...]
    missing: tuple[str, ...]
    """Those of its packages that are not installed."""

    def __str__(self) -> str:
        if not self.missing:
            return f"{self.name}: installed"
        return f"{self.name}: {', '.join(self.missing)} missing; {how_to_install(self.name)}"


def extras() -> list[Extra]:
    """The extras of this package that are for users; empty if this package itself is not installed."""
    packages: dict[str, list[str]] = {}
    try:
        required = metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        required = []
    for text in required:
        name, extra = NAME.match(text), OF_EXTRA.search(text)
        if name and extra and extra[1] not in INDIRECT:
            packages.setdefault(extra[1], []).append(name[0])
    return [
        Extra(name, tuple(found), tuple(part for part in found if not _is_installed(part)))
        for name, found in sorted(packages.items())
    ]


def _is_installed(package: str) -> bool:
    try:
        metadata.version(package)
    except metadata.PackageNotFoundError:
        return False
    return True


class Network(NamedTuple):
    """A released network."""

    kind: str
    num_bytes: int

    def __str__(self) -> str:
        return f"{self.kind} {self.num_bytes / 1e6:.1f} MB"


def released_networks(world: World) -> list[Network]:
    """The released networks of a world, by kind, with the sizes of their weights."""
    weights = {kind: released_folder(world, kind) / WEIGHTS for kind in KINDS.names()}
    return [Network(kind, path.stat().st_size) for kind, path in weights.items() if path.is_file()]


def size_of(folder: Path) -> int:
    """Total bytes of all files below a folder; 0 if it does not exist."""
    return sum(_sizes(folder))


def _sizes(folder: Path) -> Iterator[int]:
    for place, _, names in os.walk(folder):
        for name in names:
            try:
                yield os.lstat(os.path.join(place, name)).st_size
            except OSError:  # removed while we look
                continue
