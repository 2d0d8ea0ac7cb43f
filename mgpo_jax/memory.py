"""The memory of this machine, and how much of it a process took."""

from __future__ import annotations

import os
import resource
import sys


def physical_bytes() -> int:
    """The memory of this machine in bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def peak_bytes(who: int = resource.RUSAGE_SELF) -> int:
    """The largest resident memory so far in bytes, of this process or a child (``RUSAGE_CHILDREN``)."""
    unit = 1 if sys.platform == "darwin" else 1024  # what getrusage counts in
    return resource.getrusage(who).ru_maxrss * unit
