"""Packages that belong to an extra of this one, imported when they are needed."""

from __future__ import annotations

import importlib
from typing import Any

from envs.errors import UsageError
from envs.installing import how_to_install


def import_extra(module: str, extra: str) -> Any:
    """Import a module that belongs to an extra of this package.

    Raises:
      UsageError: if it is not installed, with the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise UsageError(f"{module} is not installed; run `{how_to_install(extra)}`") from None
