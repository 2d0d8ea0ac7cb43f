"""The style that all figures share, and the colors of the methods."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from itertools import cycle
from typing import Any, NamedTuple, ParamSpec

import matplotlib as mpl
from matplotlib.figure import Figure

from envs.drawing import INK
from envs.errors import DataError, printable
from experiments.store.tables import shortened
from mgpo_jax.methods import METHODS as KNOWN_METHODS

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
    "text.usetex": False,
}


class Look(NamedTuple):
    """How a method is drawn in figures."""

    name: str
    """Its name in legends."""
    color: str
    line: str
    marker: str


def title_of(method: str) -> str:
    """The title of a method in legends; an unknown method's title is its name.

    The name may come from a file, so nothing is imported for it.
    """
    try:
        return KNOWN_METHODS.known(method, "the results", "--method").title or method
    except DataError:
        return method


def plain(text: str, longest: int = 60) -> str:
    """Text from a file made safe for a picture: on one line, shortened, and never a formula."""
    return shortened(printable(text), longest).replace("$", r"\$")


METHODS = {
    name: Look(title_of(name), *look)
    for name, look in {
        "ucb": ("#D55E00", "-", "o"),
        "bpe": ("#0072B2", "-", "s"),
        "explore": ("#009E73", "-", "^"),
        "grips": ("#CC79A7", "--", "D"),
        "bbt": ("#56B4E9", "--", "v"),
        "plan": ("#E69F00", "-", "X"),
        "gcbc": ("#6B6B6B", ":", "P"),
        "ppo": ("#8C510A", "-.", "v"),
        "ppo-careful": ("#C49A6C", "-.", "^"),
        "reinforce": ("#B2182B", "-.", "D"),
        "reinforce-careful": ("#E08A8A", "-.", "s"),
        "spirl": ("#5E3C99", "--", "o"),
        "spirl-prior": ("#B2ABD2", ":", "o"),
        "ptgm": ("#003C30", "--", "X"),
        "ptgm-goal": ("#35978F", "--", "P"),
        "ptgm-ppo": ("#66C2A4", "--", "^"),
        "ptgm-random": ("#A6BDBB", ":", "X"),
        "ptgm-prior": ("#7FA8A3", ":", "s"),
        "ptgm-oracle": ("#01665E", ":", "D"),
    }.items()
}
# For methods without a look of their own: all colors with solid lines, then all with dashed ones.
SPARE_COLORS = ("#8A8A00", "#A65628", "#7570B3", "#E7298A", "#1B7837", "#4D4D4D")
SPARE_STYLES = [
    (color, line, marker)
    for line in ("-", "--")
    for color, marker in zip(SPARE_COLORS, "os^DvX", strict=True)
]

Args = ParamSpec("Args")


def styled(draw: Callable[Args, Figure]) -> Callable[Args, Figure]:
    """Make a function draw in ``STYLE`` without changing matplotlib's global settings."""

    @wraps(draw)
    def wrapper(*args: Args.args, **kwargs: Args.kwargs) -> Figure:
        with mpl.rc_context(STYLE):
            return draw(*args, **kwargs)

    return wrapper


def method_styles(labels: Iterable[str]) -> dict[str, Look]:
    """The look of each label, which is the name of a method or "name (remark)"."""
    looks: dict[str, Look] = {}
    taken: set[str] = set()
    spare = cycle(SPARE_STYLES)
    for label in labels:
        method, _, remark = label.partition(" ")
        look = METHODS.get(method) or Look(title_of(method), "", "", "")
        if look.color in taken or not look.color:
            look = Look(look.name, *next(spare))
        taken.add(look.color)
        looks[label] = look._replace(name=plain(f"{look.name} {remark}".strip()))
    return looks
