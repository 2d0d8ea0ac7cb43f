"""Show what is installed, and on which machine: ``python -m experiments.info``."""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from experiments.installed import extras, size_of
from experiments.runtime import Common, cache_folder, run, say
from experiments.store.provenance import provenance, versions_of
from experiments.store.settings import data_root
from experiments.store.tables import block
from mgpo_jax.memory import physical_bytes

FURTHER = ("orbax-checkpoint", "gymnasium", "minari")
"""Packages on which no result depends, but checkpoints, worlds and logs of others do."""


@dataclass(frozen=True)
class InfoConfig(Common):
    """Settings of ``experiments.info``."""

    json: bool = False
    """Print the report as JSON."""


def gathered() -> dict[str, Any]:
    """Versions, devices, memory, extras and folders, as JSON values."""
    import jax

    made = provenance()
    versions = made["versions"] | versions_of(FURTHER)
    folders = {"compiled programs": Path(cache_folder()), "datasets": data_root()}
    return {
        "versions": versions,
        "revision": made["revision"],
        "system": platform.platform(),
        "backend": jax.default_backend(),
        "devices": made["devices"],
        "cpu_count": made["cpu_count"],
        "memory_bytes": physical_bytes(),
        "extras": {extra.name: list(extra.missing) for extra in extras()},
        "folders": {
            name: {"place": str(place.absolute()), "bytes": size_of(place)}
            for name, place in folders.items()
        },
    }


def shown(found: dict[str, Any]) -> str:
    """What ``gathered`` found as lines of text."""
    rows = [
        *found["versions"].items(),
        ("revision", found["revision"]),
        ("system", found["system"]),
        ("devices", f"{len(found['devices'])} x {found['backend']}"),
        ("cores", str(found["cpu_count"])),
        ("memory", f"{found['memory_bytes'] / 1e9:.0f} GB"),
    ]
    for name, place in found["folders"].items():
        rows.append((name, f"{place['place']} ({place['bytes'] / 1e6:.0f} MB)"))
    rows += [("extra", str(extra)) for extra in extras()]
    return block("mgpo_jax", rows)


def main(config: InfoConfig) -> None:
    """Show versions, devices, memory, folders and extras, for bug reports."""
    found = gathered()
    say(json.dumps(found, indent=2) if config.json else shown(found))


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(InfoConfig, main, argv=argv)


if __name__ == "__main__":
    command()
