"""Pictures of the kitchen if there is OpenGL, and a clear error if there is none."""

from __future__ import annotations

import os
import subprocess
import sys

import imageio.v3 as iio
import numpy as np
import pytest
from conftest import require_kitchen

from envs.kitchen import NoOpenGLError
from envs.kitchen.env import POSITIONS
from envs.kitchen.pictures import kitchen_frames

require_kitchen()
import mujoco  # noqa: E402

from envs.kitchen.model import full_model  # noqa: E402

DRAW = """
import sys, numpy as np
from envs.kitchen.pictures import Panel, kitchen_gif
from envs.kitchen.model import INITIAL_POSITIONS
from envs.kitchen.env import POSITIONS
obs = np.zeros((3, 59))
obs[:, POSITIONS] = INITIAL_POSITIONS
obs[2, 31] = -1.5  # microwave
still = Panel("Nothing", obs[:1], [])
kitchen_gif(sys.argv[1], "A task", [Panel("Microwave", obs, [(2, "microwave")]), still])
"""


def test_positions_of_an_observation():
    """9 of the robot, 21 of the objects."""
    assert POSITIONS.tolist() == [*range(9), *range(18, 39)]


def draw(path, library):
    """In a process of its own: the way to draw is chosen when mujoco is imported."""
    return subprocess.run(
        [sys.executable, "-c", DRAW, str(path)],
        env={**os.environ, "MUJOCO_GL": library},
        capture_output=True,
        text=True,
        check=False,
    )


def test_frames_show_what_moved(tmp_path):
    path = tmp_path / "kitchen.gif"
    tries = [draw(path, library) for library in ("egl", "osmesa") if not path.exists()]
    if not path.exists():
        pytest.skip(f"neither EGL nor OSMesa here: {tries[-1].stderr.splitlines()[-1]}")
    frames = iio.imread(path).astype(int)
    changed = np.abs(frames[-1] - frames[0]).max(axis=-1) > 50
    picture = changed[64:276]  # without the text
    left, right = np.split(picture, 2, axis=1)
    assert 0.001 < left.mean() < 0.2
    assert not right.any()  # the episode that has ended stands still
    half = left.shape[1] // 2
    assert left[:, :half].mean() > 10 * left[:, half:].mean()  # the microwave is to the left


def test_what_only_is_to_be_seen_is_drawn(monkeypatch):
    """The model that is stepped may lack it."""
    drawn = []

    def refuse(model, *args):
        drawn.append(model)
        raise RuntimeError("enough")

    monkeypatch.setattr(mujoco, "Renderer", refuse)
    with pytest.raises(NoOpenGLError):
        kitchen_frames(np.zeros((1, 59)))
    (model,) = drawn
    assert model is full_model()
    collides = (model.geom_contype > 0) | (model.geom_conaffinity > 0)
    assert collides.any()
    assert not collides.all()


def test_no_opengl(monkeypatch):
    def refuse(*args):
        raise AttributeError("an OpenGL platform library has not been loaded")

    monkeypatch.setattr(mujoco, "Renderer", refuse)
    with pytest.raises(NoOpenGLError, match=r"install EGL or OSMesa and set MUJOCO_GL=egl"):
        kitchen_frames(np.zeros((1, 59)))
