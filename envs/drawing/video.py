"""GIFs of episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import fill
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from envs.drawing.palette import INK, PAPER

DPI = 100
MAX_FRAMES = 120
PALETTE_FRAMES = 10  # number of frames from whose colors the palette is made

MAX_FILM_FRAMES = 75
HEAD, LINE, BELOW = 22, 13, 18  # heights in pixels of a headline, a line of a title, and a caption
LETTER = 5.5  # average width in pixels of a letter in a title
MIN_LETTERS = 12  # letters that fit into a line of a title, however narrow its picture
GAP = 0.01  # between films, as a fraction of the width
SPACE = 0.12  # inches between axes in a row


def write_gif(path: Path, figure: Figure, show: Callable[[int], object], num_times: int) -> None:
    """Write a GIF of ``figure`` after ``show(time)``, for up to ``MAX_FRAMES`` of the times."""
    canvas = FigureCanvasAgg(figure)
    frames = []
    for time in np.unique(np.linspace(0, num_times - 1, min(num_times, MAX_FRAMES)).round()):
        show(int(time))
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    durations = [100] * (len(frames) - 1) + [1500]  # ms; the last frame is shown longer
    # One palette for all frames and no dithering, so that parts which do not change are stored once.
    some = frames[:: max(1, len(frames) // PALETTE_FRAMES)]
    palette = Image.fromarray(np.concatenate(some)).quantize(256)
    images = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    images[0].save(
        path, format="GIF", save_all=True, append_images=images[1:], duration=durations, loop=0
    )


def axes_in_a_row(titles: Sequence[str], width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure of axes side by side below their titles, each of a given size in inches."""
    above = (_room_for(titles) + 5) / DPI
    whole = len(titles) * (width + SPACE) - SPACE, height + above
    figure = Figure(figsize=whole, dpi=DPI, facecolor=PAPER)
    axes = []
    for number, title in enumerate(titles):
        left = number * (width + SPACE) / whole[0]
        axes.append(figure.add_axes((left, 0.0, width / whole[0], height / whole[1])))
        place = left + 0.5 * width / whole[0], 1 - 0.5 * above / whole[1]
        figure.text(*place, title, color=INK, fontsize=8, ha="center", va="center")
    return figure, axes


class Film(NamedTuple):
    """One episode of a video, as images."""

    title: str
    num_times: int
    frames: Callable[[np.ndarray], np.ndarray]
    """``(times [n]) -> [n, H, W, 3]`` bytes."""
    caption: Callable[[int], str]
    """``(time) -> text`` below the picture."""


def write_films(path: Path, films: Sequence[Film], headline: str = "") -> None:
    """Write films side by side, with up to ``MAX_FILM_FRAMES`` frames; one that ends earlier stops at its
    end."""
    num_times = max(film.num_times for film in films)
    times = np.linspace(0, num_times - 1, min(num_times, MAX_FILM_FRAMES)).round().astype(int)
    times_of = [np.minimum(times, film.num_times - 1) for film in films]
    frames_of = [film.frames(when) for film, when in zip(films, times_of, strict=True)]
    height, width = frames_of[0].shape[1:3]
    letters = max(MIN_LETTERS, int(width / LETTER))
    titles = ["\n".join(fill(line, letters) for line in film.title.splitlines()) for film in films]
    whole = (HEAD if headline else 0) + _room_for(titles) + height + BELOW
    figure = Figure(figsize=(len(films) * width / DPI, whole / DPI), dpi=DPI, facecolor=PAPER)
    figure.text(0.5, 1 - 5 / whole, headline, color=INK, fontsize=8.5, ha="center", va="top")
    pictures, captions = [], []
    for number, (title, frames) in enumerate(zip(titles, frames_of, strict=True)):
        place = (number / len(films), BELOW / whole, 1 / len(films) - GAP, height / whole)
        ax = figure.add_axes(place)
        ax.set_axis_off()
        ax.set_title(title, color=INK, fontsize=7.5, pad=2)
        caption = ax.text(0.5, -0.02, "", color=INK, fontsize=7.5, transform=ax.transAxes)
        caption.set(ha="center", va="top")
        pictures.append(ax.imshow(frames[0]))
        captions.append(caption)

    def show(index: int) -> None:
        for number, film in enumerate(films):
            pictures[number].set_data(frames_of[number][index])
            captions[number].set_text(film.caption(int(times_of[number][index])))

    write_gif(path, figure, show, len(times))


def _room_for(titles: Sequence[str]) -> int:
    """The height in pixels of the longest title."""
    return LINE * max(title.count("\n") + 1 for title in titles)
