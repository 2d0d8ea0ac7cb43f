"""What all figures share: how they look, and the colors of the methods."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from itertools import cycle
from typing import Any, ParamSpec

import matplotlib as mpl
from matplotlib.figure import Figure

from envs.render import INK

STYLE: dict[Any, Any] = {
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 8,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#7A868C",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E6E9EB",
    "xtick.color": "#7A868C",
    "ytick.color": "#7A868C",
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.markersize": 4,
}

# Method -> (name in legends, color, line style, marker).
METHODS = {
    "ucb": ("MGPO-UCB", "#D55E00", "-", "o"),
    "bpe": ("MGPO-BPE", "#0072B2", "-", "s"),
    "explore": ("MGPO-explore", "#009E73", "-", "^"),
    "grips": ("GRIPS", "#CC79A7", "--", "D"),
    "bbt": ("BBT", "#56B4E9", "--", "v"),
}
# For labels that are no methods: all colors with solid lines, then all with dashed ones.
SPARE_COLORS = ("#E69F00", "#6B6B6B", "#8C510A", "#5E3C99", "#B2182B", "#003C30", "#35978F")
SPARE_STYLES = [
    (color, line, marker)
    for line in ("-", "--")
    for color, marker in zip(SPARE_COLORS, "os^DvPX", strict=True)
]

Args = ParamSpec("Args")


def styled(draw: Callable[Args, Figure]) -> Callable[Args, Figure]:
    """Draw in ``STYLE`` without touching the settings of the process."""

    @wraps(draw)
    def wrapper(*args: Args.args, **kwargs: Args.kwargs) -> Figure:
        with mpl.rc_context(STYLE):
            return draw(*args, **kwargs)

    return wrapper


def method_styles(labels: Iterable[str]) -> dict[str, tuple[str, str, Any, str]]:
    """(legend, color, line style, marker) of each label, a method's name or "name (remark)"."""
    styles: dict[str, tuple[str, str, Any, str]] = {}
    taken: set[str] = set()
    spare = cycle(SPARE_STYLES)
    for label in labels:
        method, _, remark = label.partition(" ")
        name, color, line, marker = METHODS.get(method, (method, "", "", ""))
        if color in taken or not color:
            color, line, marker = next(spare)
        taken.add(color)
        styles[label] = (f"{name} {remark}".strip(), color, line, marker)
    return styles
