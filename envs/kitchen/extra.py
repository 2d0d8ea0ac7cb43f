"""The packages behind the kitchen: found, complete and of matching versions, or a clear error.

The scene belongs to gymnasium-robotics, which ships it as files; nothing of it is copied here, and its
Python code is imported by ``official.py`` alone, to compare with it.
"""

from __future__ import annotations

import importlib.util
import os
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType

from envs.errors import MissingExtraError

INSTALL = "pip install -e ."
SCENE = Path("envs/assets/kitchen_franka/kitchen_assets/kitchen_env_model.xml")


class NoOpenGLError(ImportError):
    """There is no OpenGL of the kind that ``MUJOCO_GL`` names."""

    def __init__(self, cause: Exception) -> None:
        name = os.environ.get("MUJOCO_GL")
        found = f"found MUJOCO_GL={name}" if name else "MUJOCO_GL is not set"
        super().__init__(
            "no OpenGL to draw the kitchen with: install EGL or OSMesa and set MUJOCO_GL=egl or "
            f"MUJOCO_GL=osmesa; {found} ({cause})"
        )


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


def import_mujoco() -> ModuleType:
    """The module ``mujoco``, which looks for the OpenGL that ``MUJOCO_GL`` names when it is imported.

    Raises:
      MissingExtraError: if the packages of the kitchen are missing.
      NoOpenGLError: if that OpenGL is.
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
