"""The optional packages behind the kitchen: found, complete and of matching versions, or a clear error.

The scene belongs to gymnasium-robotics, which ships it as files; nothing of it is copied here, and its
Python code is not imported.
"""

from __future__ import annotations

import importlib.util
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

INSTALL = 'pip install "mgpo-jax[kitchen]"'
SCENE = Path("envs/assets/kitchen_franka/kitchen_assets/kitchen_env_model.xml")


class MissingExtraError(ImportError):
    """Packages of the extra ``kitchen`` are missing or do not fit together."""


@cache
def check_extra() -> None:
    """Raise ``MissingExtraError`` unless physics and scene can be loaded; imports neither."""
    mujoco, mjx = (_installed_version(name) for name in ("mujoco", "mujoco-mjx"))
    if mujoco != mjx:
        raise MissingExtraError(
            f"mujoco {mujoco} and mujoco-mjx {mjx} do not match: the kitchen needs one version of "
            f"both; {INSTALL} installs a pair that works"
        )
    if not any((folder / "batch.py").is_file() for folder in _folders("mujoco")):
        raise MissingExtraError(
            f"mujoco {mujoco} is too old to step many worlds at once; {INSTALL} installs one that can"
        )
    scene_path()


def scene_path() -> Path:
    """The scene's main file in the installed gymnasium-robotics."""
    _installed_version("gymnasium-robotics")
    for folder in _folders("gymnasium_robotics"):
        if (path := folder / SCENE).is_file():
            return path
    raise MissingExtraError(
        f"gymnasium-robotics has no kitchen scene ({SCENE}); reinstall it with {INSTALL}"
    )


def _installed_version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        raise MissingExtraError(f"the kitchen needs {package}: {INSTALL}") from None


def _folders(module: str) -> list[Path]:
    """Where an installed module is, without importing it."""
    spec = importlib.util.find_spec(module)
    return [Path(folder) for folder in (spec.submodule_search_locations or ())] if spec else []
