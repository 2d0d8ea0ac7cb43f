"""GIFs of episodes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

MAX_FRAMES = 120
PALETTE_FRAMES = 10  # whose colors make the palette


def write_gif(path: Path, figure: Figure, show: Callable[[int], object], num_times: int) -> None:
    """Write what ``figure`` looks like after ``show(time)``, at up to ``MAX_FRAMES`` of the times."""
    canvas = FigureCanvasAgg(figure)
    frames = []
    for time in np.unique(np.linspace(0, num_times - 1, min(num_times, MAX_FRAMES)).round()):
        show(int(time))
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    durations = [100] * (len(frames) - 1) + [1500]  # ms; the end stays on view
    # One palette for all frames, without dithering: what stands still is stored once.
    some = frames[:: max(1, len(frames) // PALETTE_FRAMES)]
    palette = Image.fromarray(np.concatenate(some)).quantize(256)
    images = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    images[0].save(
        path, format="GIF", save_all=True, append_images=images[1:], duration=durations, loop=0
    )
