"""The world of ``own_world``, adapted to in parts of one round that only process 0 asks for.

If every process divided a segment, and decided when to save, by its own settings, two of them would wait
for each other for good.
"""

from __future__ import annotations

import sys

from own_world import WORLD

from mgpo_jax import segments

__all__ = ["WORLD"]

IS_FIRST = sys.argv[sys.argv.index("--process") + 1] == "0"
segments.PART_SECONDS = 0.0 if IS_FIRST else float("inf")
segments.SAVING_SHARE = 0.0 if IS_FIRST else float("inf")
