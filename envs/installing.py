"""How to install what a message says is missing, in a clone and from a wheel. Nothing here imports jax."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

DISTRIBUTION = "mgpo-jax"


def how_to_install(extra: str = "") -> str:
    """The command that installs this package's dependencies, or the packages of one of its extras.

    If this package is installed, from a wheel or as a clone, pip only adds what is missing. If it is merely
    found on the path, pip does not know it, so the command names its folder.
    """
    try:
        metadata.version(DISTRIBUTION)
        what = DISTRIBUTION
    except metadata.PackageNotFoundError:
        what = str(Path(__file__).parent.parent)
    return f"pip install '{what}{f'[{extra}]' if extra else ''}'"


def how_to_reinstall(package: str) -> str:
    """The command that installs a package of others again, in the version that is there."""
    try:
        what = f"{package}=={metadata.version(package)}"
    except metadata.PackageNotFoundError:
        what = package
    return f"pip install --force-reinstall --no-deps '{what}'"
