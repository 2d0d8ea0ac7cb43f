"""Host-side pictures of the worlds."""

from __future__ import annotations

from envs.render.grid import draw_grid, draw_objects, grid_gif
from envs.render.kitchen import Panel, kitchen_frames, kitchen_gif
from envs.render.marks import spread_apart
from envs.render.maze import (
    PROMPT_COLOR,
    bar_lanes,
    draw_maze,
    maze_gif,
    picture_width,
    place_goals,
    visit_norm,
    visit_scale,
)
from envs.render.palette import INK

__all__ = [
    "INK",
    "PROMPT_COLOR",
    "Panel",
    "bar_lanes",
    "draw_grid",
    "draw_maze",
    "draw_objects",
    "grid_gif",
    "kitchen_frames",
    "kitchen_gif",
    "maze_gif",
    "picture_width",
    "place_goals",
    "spread_apart",
    "visit_norm",
    "visit_scale",
]
