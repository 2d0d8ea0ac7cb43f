"""GIFs of episodes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

MAX_FRAMES = 120


def write_gif(path: Path, figure: Figure, show: Callable[[int], object], num_times: int) -> None:
    """Write what ``figure`` looks like after ``show(time)``, at up to ``MAX_FRAMES`` of the times."""
    canvas = FigureCanvasAgg(figure)
    frames = []
    for time in np.unique(np.linspace(0, num_times - 1, min(num_times, MAX_FRAMES)).round()):
        show(int(time))
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    durations = [100] * (len(frames) - 1) + [1500]  # ms; the end stays on view
    iio.imwrite(path, np.stack(frames), extension=".gif", duration=durations, loop=0)
