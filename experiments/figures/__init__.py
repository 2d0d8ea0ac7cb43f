"""The figures, as functions of results and of a function that runs episodes."""

from __future__ import annotations

from experiments.figures.curves import (
    learning_curve,
    learning_curves,
    performance_profiles,
    training_curve,
)
from experiments.figures.glance import Glance, at_a_glance, look_of
from experiments.figures.offered import Save, figures_of_results, figures_of_run, later
from experiments.figures.rollouts import Play, draw_longest
from experiments.figures.style import METHODS, STYLE, Look, method_styles

__all__ = [
    "METHODS",
    "STYLE",
    "Glance",
    "Look",
    "Play",
    "Save",
    "at_a_glance",
    "draw_longest",
    "figures_of_results",
    "figures_of_run",
    "later",
    "learning_curve",
    "learning_curves",
    "look_of",
    "method_styles",
    "performance_profiles",
    "training_curve",
]
