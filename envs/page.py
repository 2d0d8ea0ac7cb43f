"""What a world brings to HTML pages: plain data, and a JavaScript module with its rules and its drawing.

Generic code makes the pages, runs the policy in them and lays them out. A world that brings nothing gets
everything that needs none of it: curves, tables, prompts as numbers, and goals reached on a time line.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array

from envs.base import State, Task

Json = Any


@dataclass(frozen=True, kw_only=True)
class Page:
    """What a world brings to HTML pages; it leaves out what it does not offer.

    Everything here becomes JSON and is shown as text, never as markup.

    Attributes:
      script: a JavaScript module that exports ``world``, a ``WorldPage`` (``envs/page.d.ts``). It has the
        rules of the world, with which saved actions are played again and the policy acts in the
        playground, and draws it. It imports nothing.
      facts: what the script has to know of this world, such as its size.
      task: what the script has to know of one task, which has numpy leaves.
      track: ``(state) -> integers [D]`` from 0 to 255, for a world whose rules cannot be in the script,
        since chance decides in it: what the drawing has to know of each moment of an episode, such as where
        the agent is, in terms of ``jax.numpy``. Saved episodes are played again in jax, and the script
        makes of these numbers what it draws (``moments``). Such a world has no playground.
      start: ``(obs) -> integers``, what the script has to know of the first observation of an episode,
        where episodes do not start alike.
      describe: one task in a few words.
      parts: names of the components of a goal, where a goal is a set of named parts.
    """

    script: Path | None = None
    facts: Mapping[str, Json] = field(default_factory=dict)
    task: Callable[[Task], Json] | None = None
    track: Callable[[State], Array] | None = None
    start: Callable[[np.ndarray], list[int]] | None = None
    describe: Callable[[Task], str] | None = None
    parts: Sequence[str] = ()
