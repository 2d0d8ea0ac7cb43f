"""Pictures of the kitchen, where there is OpenGL, and a clear word where there is none."""

from __future__ import annotations

import os
import subprocess
import sys

import imageio.v3 as iio
import numpy as np
import pytest

from envs.render.kitchen import POSITIONS, kitchen_frames

mujoco = pytest.importorskip("mujoco")

DRAW = """
import sys, numpy as np
from envs.render.kitchen import kitchen_gif
from envs.kitchen.model import INITIAL_POSITIONS
from envs.render.kitchen import POSITIONS
obs = np.zeros((3, 59))
obs[:, POSITIONS] = INITIAL_POSITIONS
obs[2, 31] = -1.5  # microwave
kitchen_gif(sys.argv[1], obs)
"""


def test_positions_of_an_observation():
    """9 of the robot, 21 of the objects."""
    assert POSITIONS.tolist() == [*range(9), *range(18, 39)]


def test_frames_show_what_moved(tmp_path):
    """In a process of its own: the way to draw is chosen when mujoco is imported."""
    path = tmp_path / "kitchen.gif"
    env = {**os.environ, "MUJOCO_GL": "egl"}
    done = subprocess.run(
        [sys.executable, "-c", DRAW, str(path)],
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        pytest.skip(f"no EGL here: {done.stderr.splitlines()[-1]}")
    frames = iio.imread(path).astype(int)
    assert frames.shape[1:] == (480, 640, 3)
    changed = np.abs(frames[-1] - frames[0]).max(axis=-1) > 50
    assert 0.001 < changed.mean() < 0.2
    assert changed[:, :320].mean() > 10 * changed[:, 320:].mean()  # it stands to the left


def test_no_opengl(monkeypatch):
    def refuse(*args):
        raise RuntimeError("an OpenGL platform library has not been loaded")

    monkeypatch.setattr(mujoco, "Renderer", refuse)
    with pytest.raises(RuntimeError, match=r"install EGL or OSMesa and set MUJOCO_GL=egl"):
        kitchen_frames(np.zeros((1, 59)))
