"""Provenance of results: the command, code revision, package versions and devices they were made with."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

from annotated_types import MaxLen
from pydantic import BaseModel, StringConstraints

from envs.errors import printable
from mgpo_jax.schema import STRICT, read_document

PACKAGES = (
    "mgpo-jax", "jax", "jaxlib", "flax", "optax", "evosax", "numpy", "mujoco", "mujoco-mjx",
    "gymnasium-robotics", "craftax",
)  # fmt: skip

ROOT = Path(__file__).parents[2]
"""The folder that holds the code: a checkout, or the site-packages of an installed copy."""
Place = Annotated[str, StringConstraints(min_length=1, max_length=4096)]
"""A path in a file."""


class Meta(BaseModel):
    """The entries of a ``meta.json`` that are read; there may be others."""

    model_config = {**STRICT, "extra": "ignore"}

    format: int = 1
    command: list[str] = []
    revision: str = ""
    versions: dict[str, str] = {}
    devices: list[str] = []
    device_kinds: list[str] = []
    """Models of the devices; absent in the files of older versions."""
    dataset: Place | None = None
    """Folder of the dataset of a training."""
    dataset_sha256: str = ""
    policy_places: Annotated[list[Place], MaxLen(8)] = []
    """Folder of the policy of an adaptation: relative to the results, and absolute."""

    @property
    def on_cpus(self) -> bool:
        """Whether all devices are CPUs; true as well if they are not recorded."""
        return all("cpu" in device.lower() for device in self.devices)

    @property
    def hardware(self) -> str:
        """The devices in words, such as ``2 x cpu`` or ``1 x cuda (NVIDIA H100 80GB HBM3)``."""
        models = [printable(model) for model in self.device_kinds if model != "cpu"]
        return count_devices(self.devices) + (f" ({', '.join(models)})" if models else "")


def read_meta(path: Path, mend: str) -> Meta:
    """Read a ``meta.json``. It may be missing if the first version made the results.

    Raises:
      DataError: if the file is damaged.
    """
    return read_document(path, Meta, mend) if path.exists() else Meta()


def count_devices(devices: Sequence[Any]) -> str:
    """The number of devices of each platform, such as ``2 x cpu``."""
    names = Counter(printable(re.sub(r"[_:]\d+$", "", str(device))) for device in devices)
    return ", ".join(f"{num} x {name}" for name, num in sorted(names.items()))


def versions() -> dict[str, str]:
    """The versions of Python and of those packages that results depend on and that are installed."""
    return {"python": platform.python_version(), **versions_of(PACKAGES)}


def versions_of(packages: Sequence[str]) -> dict[str, str]:
    """The versions of those of some packages that are installed."""
    found = {}
    for name in packages:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def provenance() -> dict[str, Any]:
    """The provenance of what this process makes, for its ``meta.json``."""
    import jax

    return {
        "command": [Path(sys.executable).name, *sys.orig_argv[1:]],
        "revision": revision(),
        "versions": versions(),
        "devices": [str(device) for device in jax.devices()],
        "device_kinds": sorted({device.device_kind for device in jax.devices()}),
        "cpu_count": os.cpu_count(),
    }


def revision(root: Path = ROOT) -> str:
    """The commit of the code, with ``-dirty`` after it if files were changed since; ``unknown`` for an
    installed copy, also where its environment lies within another repository."""

    def git(*words: str) -> str:
        command = ["git", *words]
        done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        if not os.path.samefile(git("rev-parse", "--show-toplevel"), root):
            return "unknown"
        return git("describe", "--always", "--dirty", "--abbrev=12")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
