"""Where the work of the commands begins: the fuzz suite stops them there, after every check.

A command that gets so far has accepted its input. When code moves, only this table has to follow.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock


class WorkBegan(BaseException):
    """Raised in place of the work; no handler of errors takes it for one."""


def begin(*args: Any, **kwargs: Any) -> Any:
    raise WorkBegan


class Evaluation:
    """In place of the greedy evaluation of a training, which would take long to compile."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    def __call__(self, params: Any) -> dict[str, float]:
        return {"eval/initial_return": -1.0, "eval/initial_regret": 0.5}


EVALUATION = ("experiments.training", "ReturnsOnTheWay", Evaluation)
PLACES: tuple[tuple[str, str, Any], ...] = (
    ("experiments.runtime", "configure", lambda: None),
    ("experiments.datasets", "program_of", begin),
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
"""Module, name in it, and what stands there instead."""


@contextmanager
def replaced(*places: tuple[str, str, Any]) -> Iterator[None]:
    """Put something else in some places while the block runs; see ``PLACES``."""
    with ExitStack() as stack:
        for module, name, instead in places:
            importlib.import_module(module)
            stack.enter_context(mock.patch(f"{module}.{name}", instead))
        yield
