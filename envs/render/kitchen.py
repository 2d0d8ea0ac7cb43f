"""Pictures of the kitchen, drawn by MuJoCo without a window from what was observed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure

from envs.kitchen import NoOpenGLError, import_mujoco
from envs.kitchen.world import POSITIONS
from envs.render.palette import INK, PAPER
from envs.render.video import write_gif

DPI, HEAD, ROW, BELOW = 100, 22, 13, 18  # pixels an inch; pixels of text above and below a picture
LINE = 52  # letters across a picture
FRAMES = 75  # of a GIF
GAP = 0.01  # between pictures, as a share of the width
CAMERA = {"distance": 2.2, "azimuth": 70.0, "elevation": -35.0, "lookat": (-0.2, 0.5, 2.0)}


def kitchen_frames(
    obs: Float[np.ndarray, "T 59"], height: int = 480, width: int = 640
) -> UInt8[np.ndarray, "T H W 3"]:
    """What the scene looks like at each of these observations.

    Raises:
      NoOpenGLError: where there is no OpenGL to draw with.
      MissingExtraError: if the packages of the kitchen are missing.
    """
    mujoco = import_mujoco()
    from envs.kitchen.model import load_model

    model = load_model("stock")
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    for name, value in CAMERA.items():
        setattr(camera, name, value)
    try:
        renderer = mujoco.Renderer(model, height, width)
    except (AttributeError, ImportError, RuntimeError, mujoco.FatalError) as error:
        raise NoOpenGLError(error) from None
    for costly in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        renderer.scene.flags[costly] = False
    with renderer:
        frames = np.zeros((len(obs), height, width, 3), np.uint8)
        for frame, positions in zip(frames, np.asarray(obs)[:, POSITIONS], strict=True):
            data.qpos[:] = positions
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            renderer.render(out=frame)
    return frames


class Panel(NamedTuple):
    """One episode of a GIF."""

    title: str
    obs: Float[np.ndarray, "T 59"]
    completed: Sequence[tuple[int, str]]
    """What was completed, and in which step, counted from 1."""


def kitchen_gif(
    path: Path, title: str, panels: Sequence[Panel], height: int = 216, width: int = 288
) -> None:
    """Episodes side by side, at up to ``FRAMES`` of their times; those that end earlier stand still."""
    num_steps = max(len(panel.obs) for panel in panels)
    times = np.linspace(0, num_steps - 1, min(num_steps, FRAMES)).round().astype(int)
    titles = ["\n".join(fill(line, LINE) for line in panel.title.splitlines()) for panel in panels]
    above = HEAD + ROW * max(text.count("\n") + 1 for text in titles)
    whole = above + height + BELOW
    size = len(panels) * width / DPI, whole / DPI
    figure = Figure(figsize=size, dpi=DPI, facecolor=PAPER)
    figure.text(0.5, 1 - 5 / whole, title, color=INK, fontsize=8.5, ha="center", va="top")
    drawn = []
    for number, (panel, text) in enumerate(zip(panels, titles, strict=True)):
        place = (number / len(panels), BELOW / whole, 1 / len(panels) - GAP, height / whole)
        axes = figure.add_axes(place)
        axes.set_axis_off()
        axes.set_title(text, color=INK, fontsize=7.5, pad=2)
        below = axes.text(0.5, -0.02, "", color=INK, fontsize=7.5, transform=axes.transAxes)
        below.set(ha="center", va="top")
        frames = kitchen_frames(panel.obs[np.minimum(times, len(panel.obs) - 1)], height, width)
        drawn.append((axes.imshow(frames[0]), below, frames))

    def show(index: int) -> None:
        for panel, (image, below, frames) in zip(panels, drawn, strict=True):
            image.set_data(frames[index])
            # A picture is of what a step, counted from 1, begins with.
            steps = min(times[index] + 1, len(panel.obs))
            done = [what for when, what in panel.completed if when <= steps]
            below.set_text(f"step {steps}: {', '.join(done) or '-'}")

    write_gif(path, figure, show, len(times))
