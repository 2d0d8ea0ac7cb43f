"""A world's part of HTML pages: plain data, and a JavaScript module with its rules and its drawing.

Generic code builds and lays out the pages, and runs the policy in them. For a world without such a part,
pages show what does not depend on it: curves, tables, prompts as numbers, and a time line of the goals
reached.
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
    """A world's part of HTML pages; all of it is optional.

    Everything here becomes JSON and is shown as text, never as markup.

    Attributes:
      script: a JavaScript module that exports ``world``, a ``WorldPage`` (``envs/page.d.ts``). It draws the
        world, and has its rules, by which saved actions are replayed and the policy acts in the playground.
        It imports nothing.
      facts: data about this world for the script, such as its size.
      task: ``(task) -> data`` about one task for the script; the task has numpy leaves.
      track: ``(state) -> integers [D]`` from 0 to 255, for a world that cannot be simulated by the script
        because it is random: the data that the drawing needs about each moment of an episode, such as the
        position of the agent, computed with ``jax.numpy``. Saved episodes are replayed in jax, and the
        script turns these numbers into what it draws (``moments``). Such a world has no playground.
      start: ``(obs) -> integers``, data about the first observation of an episode for the script, if
        episodes start in different states.
      describe: ``(task) -> text``, a short description of one task.
      parts: names of the components of a goal, if a goal is a set of named parts.
    """

    script: Path | None = None
    facts: Mapping[str, Json] = field(default_factory=dict)
    task: Callable[[Task], Json] | None = None
    track: Callable[[State], Array] | None = None
    start: Callable[[np.ndarray], list[int]] | None = None
    describe: Callable[[Task], str] | None = None
    parts: Sequence[str] = ()
