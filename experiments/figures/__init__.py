"""The figures of every world, as functions of results and of whoever plays episodes."""

from __future__ import annotations

from experiments.figures.curves import learning_curve, learning_curves, training_curve
from experiments.figures.rollouts import Play, Save, figures_of_results, figures_of_run, later
from experiments.figures.style import METHODS, STYLE, Look, method_styles

__all__ = [
    "METHODS",
    "STYLE",
    "Look",
    "Play",
    "Save",
    "figures_of_results",
    "figures_of_run",
    "later",
    "learning_curve",
    "learning_curves",
    "method_styles",
    "training_curve",
]
