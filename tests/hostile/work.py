"""Where the work of each command begins, after all checks; the fuzz suite stops commands there.

A command that gets there has accepted its input. When code moves, only this table must follow.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock


class WorkBegan(BaseException):
    """Raised in place of the work; not an ``Exception``, so that no error handler catches it."""


def begin(*args: Any, **kwargs: Any) -> Any:
    raise WorkBegan


class Evaluation:
    """Replaces the evaluation during a training, which would take long to compile."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    def __call__(self, params: Any) -> dict[str, float]:
        return {"eval/initial_return": -1.0, "eval/initial_regret": 0.5}


EVALUATION = ("experiments.watching", "ReturnsOnTheWay", Evaluation)
PLACES: tuple[tuple[str, str, Any], ...] = (
    ("experiments.runtime", "configure", lambda: None),
    ("experiments.demonstrations", "program_of", begin),
    EVALUATION,
    ("mgpo_jax.training", "Trainer.step", begin),
    ("mgpo_jax.runner", "lay_out", begin),
    ("experiments.evaluation", "evaluate_fully", begin),
    ("experiments.checking", "officials_of", lambda cases: ()),  # mazes have no official program
    ("experiments.checking", "compare", begin),
    ("experiments.drawing", "write", begin),
    ("experiments.drawing", "draw_run", begin),
    ("experiments.pages.report", "_knowledge", begin),
    ("experiments.pages.playground", "half_weights", begin),
    ("experiments.exporting", "facts_of", begin),
    ("experiments.measurements", "measurements", begin),
)
"""Modules, names in them, and what to put there instead."""


@contextmanager
def replaced(*places: tuple[str, str, Any]) -> Iterator[None]:
    """Replace names in modules while the block runs; see ``PLACES``."""
    with ExitStack() as stack:
        for module, name, instead in places:
            importlib.import_module(module)
            stack.enter_context(mock.patch(f"{module}.{name}", instead))
        yield
