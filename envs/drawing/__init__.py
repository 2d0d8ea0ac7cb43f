"""Drawing code shared by all worlds: the record of a world's pictures, marks, colors and GIFs."""

from __future__ import annotations

from envs.drawing.marks import box_width, draw_box, draw_disc, draw_leader, spread_apart
from envs.drawing.palette import INK
from envs.drawing.pictures import Pictures, Shown, Stage, observations
from envs.drawing.video import Film, axes_in_a_row, write_films, write_gif

__all__ = [
    "INK",
    "Film",
    "Pictures",
    "Shown",
    "Stage",
    "axes_in_a_row",
    "box_width",
    "draw_box",
    "draw_disc",
    "draw_leader",
    "observations",
    "spread_apart",
    "write_films",
    "write_gif",
]
