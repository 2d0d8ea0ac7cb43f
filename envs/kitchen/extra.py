"""A check that the packages of the kitchen are installed, complete and of matching versions.

The scene is part of gymnasium-robotics, which ships it as files. Nothing of it is copied here, and its
Python code is imported only by ``official.py``, for comparisons.
"""

from __future__ import annotations

import importlib.util
import os
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType

from envs.errors import MissingExtraError
from envs.installing import how_to_install, how_to_reinstall

SCENE = Path("envs/assets/kitchen_franka/kitchen_assets/kitchen_env_model.xml")


class NoOpenGLError(ImportError):
    """The OpenGL backend that ``MUJOCO_GL`` names is not available."""

    def __init__(self, cause: Exception) -> None:
        name = os.environ.get("MUJOCO_GL")
        found = f"found MUJOCO_GL={name}" if name else "MUJOCO_GL is not set"
        super().__init__(
            "no OpenGL to draw the kitchen with: install EGL or OSMesa and set MUJOCO_GL=egl or "
            f"MUJOCO_GL=osmesa; {found} ({cause})"
        )


@cache
def check_extra() -> None:
    """Raise ``MissingExtraError`` unless the engine and the scene can be loaded, without importing
    either."""
    mujoco, mjx = (_installed_version(name) for name in ("mujoco", "mujoco-mjx"))
    if mujoco != mjx:
        raise MissingExtraError(
            f"mujoco {mujoco} and mujoco-mjx {mjx} do not match: the kitchen needs one version of "
            f"both; {how_to_install()} installs a pair that works"
        )
    if not any((folder / "batch.py").is_file() for folder in _folders("mujoco")):
        raise MissingExtraError(
            f"mujoco {mujoco} is too old to step many worlds at once; {how_to_install()} installs one that "
            "can"
        )
    scene_path()


def import_mujoco() -> ModuleType:
    """Import the module ``mujoco``, which on import loads the OpenGL backend that ``MUJOCO_GL`` names.

    Raises:
      MissingExtraError: if the packages of the kitchen are missing.
      NoOpenGLError: if that OpenGL backend is missing.
    """
    check_extra()
    try:
        import mujoco
    except (AttributeError, ImportError, OSError, RuntimeError) as error:
        if "MUJOCO_GL" in os.environ:
            raise NoOpenGLError(error) from None
        raise
    return mujoco


def scene_path() -> Path:
    """The main file of the scene in the installed gymnasium-robotics."""
    _installed_version("gymnasium-robotics")
    for folder in _folders("gymnasium_robotics"):
        if (path := folder / SCENE).is_file():
            return path
    raise MissingExtraError(
        f"gymnasium-robotics has no kitchen scene ({SCENE}); reinstall it with "
        f"{how_to_reinstall('gymnasium-robotics')}"
    )


def _installed_version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        raise MissingExtraError(f"the kitchen needs {package}: {how_to_install()}") from None


def _folders(module: str) -> list[Path]:
    """The folders of an installed module, without importing it."""
    spec = importlib.util.find_spec(module)
    return [Path(folder) for folder in (spec.submodule_search_locations or ())] if spec else []
