"""A check that the package behind Crafter is installed and new enough. Nothing here imports jax.

Craftax provides the rules and the textures. Its own renderer writes a cache of textures to the folder in
which it is installed; that renderer is not used here, so nothing is ever written there.
"""

from __future__ import annotations

import importlib.util
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from envs.errors import MissingExtraError
from envs.installing import how_to_install, how_to_reinstall

OLDEST = (1, 6, 1)
TEXTURES = Path("craftax_classic/assets")


@cache
def check_extra() -> None:
    """Raise ``MissingExtraError`` unless Craftax can be loaded, without importing it."""
    oldest, install = ".".join(map(str, OLDEST)), how_to_install("crafter")
    try:
        found = version("craftax")
    except PackageNotFoundError:
        raise MissingExtraError(f"Crafter needs craftax {oldest} or newer: {install}") from None
    numbers = tuple(int(part) for part in found.split(".")[:3] if part.isdigit())
    if numbers < OLDEST:
        raise MissingExtraError(
            f"Crafter needs craftax {oldest} or newer, found {found}: {install}"
        )
    texture_folder()


def texture_folder() -> Path:
    """The folder of Crafter's textures in the installed Craftax, PNG files of 16 x 16 pixels.

    Raises:
      MissingExtraError: if the textures are missing.
    """
    spec = importlib.util.find_spec("craftax")
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        if (path := Path(folder) / TEXTURES / "grass.png").is_file():
            return path.parent
    raise MissingExtraError(
        f"craftax has no textures ({TEXTURES}); reinstall it with {how_to_reinstall('craftax')}"
    )
