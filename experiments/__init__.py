"""Command lines, what lies on disk, and figures."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def _prefer_this_project() -> None:
    """Search the current folder last, so that nothing in it shadows our packages.

    ``python -m`` puts the current folder first.
    """
    root = str(Path(__file__).parent.parent)
    here = os.getcwd()
    if root != here and sys.path and sys.path[0] in ("", here):
        sys.path[0] = root
        sys.path.append(here)


_prefer_this_project()
