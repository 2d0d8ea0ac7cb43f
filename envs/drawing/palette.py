"""The colors of all pictures: the color-blind-safe palette of Okabe and Ito, and grays."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import to_rgb

ORANGE, SKY, GREEN, YELLOW = "#E69F00", "#56B4E9", "#009E73", "#F0E442"
BLUE, VERMILION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"

INK = "#1F292E"
PALE_INK = "#7A868C"
PAPER = "#FFFFFF"
FREE_COLOR = "#FAFAFC"
WALL_COLOR = "#3D4A52"
LINE_COLOR = "#E1E5E8"
BAR_COLOR = "#C9CED2"


def ink_on(color: str) -> str:
    """Black or white, whichever has more contrast to a color."""
    luminance = np.dot(to_rgb(color), (0.299, 0.587, 0.114))
    return INK if luminance > 0.6 else PAPER
