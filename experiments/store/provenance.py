"""How and with what a result was made."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

from annotated_types import MaxLen
from pydantic import BaseModel, StringConstraints

from mgpo_jax.schema import STRICT, read_document

PACKAGES = (
    "mgpo-jax", "jax", "jaxlib", "flax", "optax", "evosax", "numpy", "mujoco", "mujoco-mjx",
    "gymnasium-robotics", "craftax",
)  # fmt: skip


Place = Annotated[str, StringConstraints(min_length=1, max_length=4096)]
"""A path in a file."""


class Meta(BaseModel):
    """What is read of a ``meta.json``; there may be other entries."""

    model_config = {**STRICT, "extra": "ignore"}

    format: int = 1
    command: list[str] = []
    revision: str = ""
    versions: dict[str, str] = {}
    devices: list[str] = []
    dataset: Place | None = None
    """The folder of the dataset of a training."""
    dataset_sha256: str = ""
    policy_places: Annotated[list[Place], MaxLen(8)] = []
    """Where the policy of an adaptation lies: relative to its folder, and absolute."""


def read_meta(path: Path, mend: str) -> Meta:
    """How and with what something was made. What was made by the first version may have no such file.

    Raises:
      DataError: if the file is damaged.
    """
    return read_document(path, Meta, mend) if path.exists() else Meta()


def versions() -> dict[str, str]:
    """Versions of what a result depends on, as far as it is installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def provenance() -> dict[str, Any]:
    """How and with what this process was started, for the run folder."""
    import jax

    try:
        here = Path(__file__).parent
        command = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
        commit = subprocess.run(command, cwd=here, capture_output=True, text=True, check=True)
        revision = commit.stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        revision = "unknown"
    return {
        "command": [Path(sys.executable).name, *sys.orig_argv[1:]],
        "revision": revision,
        "versions": versions(),
        "devices": [str(device) for device in jax.devices()],
        "cpu_count": os.cpu_count(),
    }
