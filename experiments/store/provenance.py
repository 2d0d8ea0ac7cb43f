"""How and with what a result was made."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = (
    "mgpo-jax", "jax", "jaxlib", "flax", "optax", "evosax", "numpy", "mujoco", "mujoco-mjx",
    "gymnasium-robotics",
)  # fmt: skip


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
