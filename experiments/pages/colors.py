"""Colors of runs that can be told from the page, light or dark, and text that can be read on them.

The contrast of two colors is that of the Web Content Accessibility Guidelines (WCAG 2), from 1 to 21: lines
and other shapes need 3, text needs 4.5.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import numpy as np
from matplotlib.colors import to_hex, to_rgb

LINE_CONTRAST, TEXT_CONTRAST = 3.0, 4.5
PAPERS = {"light": "#ffffff", "dark": "#1b2226"}
"""What charts are drawn on in each color scheme: ``--paper`` in ``js/style.css``."""
INKS = ("#000000", "#ffffff")  # one of the two has a contrast of at least 4.58 to any color
TURN = 0.381966  # of the color circle, by which a color is turned that another run has

Colors = dict[str, list[str]]


def contrast(one: str, other: str) -> float:
    """The contrast of two colors, from 1 (equal) to 21 (black and white)."""
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def luminance(color: str) -> float:
    """The relative luminance of a color, from 0 (black) to 1 (white)."""
    parts = np.array(to_rgb(color))
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def run_colors(colors: Sequence[str]) -> list[Colors]:
    """The colors of runs for each color scheme: that of lines, and that of text on it.

    A color is that of the figures where it stands out from the page, else a darker or a paler one. A color
    that an earlier run has already is turned on the color circle.
    """
    found: list[Colors] = []
    taken: set[str] = set()
    for color in colors:
        turned = color
        while (of := _in_schemes(turned))["light"][0] in taken or of["dark"][0] in taken:
            turned = _turned(turned)
        taken |= {line for line, _ in of.values()}
        found.append(of)
    return found


def _in_schemes(color: str) -> Colors:
    # On dark paper, darker colors stay darker than others, so that they do not all become the same.
    needed = {"light": LINE_CONTRAST, "dark": LINE_CONTRAST + 6 * luminance(color)}
    lines = {name: _standing_out(color, paper, needed[name]) for name, paper in PAPERS.items()}
    return {name: [line, ink_on(line)] for name, line in lines.items()}


def _standing_out(color: str, paper: str, needed: float) -> str:
    """The color, mixed with as little black or white as gives it a contrast to a paper."""
    towards = np.zeros(3) if luminance(paper) > 0.5 else np.ones(3)
    for share in np.linspace(0, 1, 101):
        mixed = to_hex((1 - share) * np.array(to_rgb(color)) + share * towards)
        if contrast(mixed, paper) >= needed:
            return mixed
    raise ValueError(f"no color has a contrast of {needed} to {paper}")


def ink_on(color: str) -> str:
    """Black or white, whichever has more contrast to a color."""
    return max(INKS, key=lambda ink: contrast(ink, color))


def _turned(color: str) -> str:
    """The next color on the circle; grays get a color first."""
    hue, lightness, saturation = colorsys.rgb_to_hls(*to_rgb(color))
    return to_hex(colorsys.hls_to_rgb((hue + TURN) % 1, lightness, max(saturation, 0.4)))
