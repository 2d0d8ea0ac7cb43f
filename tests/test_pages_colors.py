"""Colors of the pages, light and dark: lines and text stand out from what they are on, and runs differ."""

from __future__ import annotations

import re

import pytest

from experiments.figures.style import METHODS, SPARE_COLORS
from experiments.pages.build import SCRIPTS
from experiments.pages.colors import (
    LINE_CONTRAST,
    PAPERS,
    TEXT_CONTRAST,
    contrast,
    ink_on,
    luminance,
    run_colors,
)

ALL = [*dict.fromkeys([*(look.color for look in METHODS.values()), *SPARE_COLORS])]


def variables(scheme: str) -> dict[str, str]:
    """The colors of the style sheet in a scheme. The dark one changes those that it names."""
    style = (SCRIPTS / "style.css").read_text()
    light, dark = re.findall(r":root \{(.*?)\}", style, re.S)[:2]
    parts = [light] if scheme == "light" else [light, dark]
    return dict(re.findall(r"--(\w+): (#[0-9a-f]{6});", "".join(parts)))


def test_contrast_is_that_of_the_guidelines() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.01)
    assert contrast("#123456", "#123456") == 1


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("color", ALL)
def test_every_run_can_be_seen_on_the_page_and_read_on_its_marks(color: str, scheme: str) -> None:
    assert PAPERS[scheme] == variables(scheme)["paper"]
    (found,) = run_colors([color])
    line, ink = found[scheme]
    assert contrast(line, PAPERS[scheme]) >= LINE_CONTRAST
    assert contrast(ink, line) >= TEXT_CONTRAST
    if contrast(color, "#ffffff") >= LINE_CONTRAST:
        assert found["light"][0] == color.lower()  # as in the figures


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_runs_of_a_page_have_colors_of_their_own(scheme: str) -> None:
    """The figures have six spare colors, after which they begin again."""
    lines = [found[scheme][0] for found in run_colors([*ALL, *SPARE_COLORS, *SPARE_COLORS])]
    assert len(set(lines)) == len(lines) == len(ALL) + 2 * len(SPARE_COLORS)
    assert all(contrast(line, PAPERS[scheme]) >= LINE_CONTRAST for line in lines)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_of_the_style_sheet_can_be_read(scheme: str) -> None:
    colors = variables(scheme)
    for text, ground in (
        ("ink", "paper"), ("ink", "page"), ("faint", "paper"), ("faint", "page"),
        ("accent", "paper"), ("onAccent", "accent"), ("onDisc", "prompt"), ("onBox", "target"),
        ("onBox", "start"), ("ink", "hidden"), ("ink", "free"),
    ):  # fmt: skip
        assert contrast(colors[text], colors[ground]) >= TEXT_CONTRAST, (text, ground)
    for shape, ground in (("focus", "paper"), ("focus", "page"), ("prompt", "paper")):
        assert contrast(colors[shape], colors[ground]) >= LINE_CONTRAST, (shape, ground)


def test_ink_is_the_one_with_more_contrast() -> None:
    assert ink_on("#ffff00") == "#000000"
    assert ink_on("#00003c") == "#ffffff"
    assert luminance("#ffffff") == pytest.approx(1)
