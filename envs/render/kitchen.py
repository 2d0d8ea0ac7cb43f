"""Pictures of the kitchen, drawn by MuJoCo without a window from what was observed."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
from jaxtyping import Float, UInt8

from envs.render.video import MAX_FRAMES

NUM_ROBOT = 9
POSITIONS = np.r_[:NUM_ROBOT, 2 * NUM_ROBOT : 39]  # places of the 30 positions in an observation
CAMERA = {"distance": 2.2, "azimuth": 70.0, "elevation": -35.0, "lookat": (-0.2, 0.5, 2.0)}


def kitchen_frames(
    obs: Float[np.ndarray, "T 59"], height: int = 480, width: int = 640
) -> UInt8[np.ndarray, "T H W 3"]:
    """What the scene looks like at each of these observations.

    Raises:
      RuntimeError: where there is no OpenGL to draw with.
      ImportError: if the packages of the kitchen are missing.
    """
    from envs.kitchen import check_extra

    check_extra()
    import mujoco

    from envs.kitchen.model import load_model

    model = load_model("stock")
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    for name, value in CAMERA.items():
        setattr(camera, name, value)
    try:
        renderer = mujoco.Renderer(model, height, width)
    except (AttributeError, ImportError, RuntimeError, mujoco.FatalError) as error:
        raise RuntimeError(
            "no OpenGL to draw the kitchen with: install EGL or OSMesa and set MUJOCO_GL=egl or "
            f"MUJOCO_GL=osmesa ({error})"
        ) from None
    with renderer:
        frames = np.zeros((len(obs), height, width, 3), np.uint8)
        for frame, positions in zip(frames, np.asarray(obs)[:, POSITIONS], strict=True):
            data.qpos[:] = positions
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            renderer.render(out=frame)
    return frames


def kitchen_gif(path: Path, obs: Float[np.ndarray, "T 59"]) -> None:
    """A GIF of an episode, of up to ``MAX_FRAMES`` of its times."""
    times = np.unique(np.linspace(0, len(obs) - 1, min(len(obs), MAX_FRAMES)).round().astype(int))
    frames = kitchen_frames(obs[times])
    durations = [80] * (len(frames) - 1) + [1500]  # ms; the end stays on view
    iio.imwrite(path, frames, extension=".gif", duration=durations, loop=0)
