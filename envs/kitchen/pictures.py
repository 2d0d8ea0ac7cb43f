"""Pictures of the kitchen, rendered off-screen by MuJoCo from observations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from envs.base import Task
from envs.drawing.pictures import Pictures, Shown, observations
from envs.drawing.video import Film, write_films
from envs.errors import UsageError
from envs.kitchen.env import NONE, POSITIONS, Kitchen
from envs.kitchen.extra import NoOpenGLError, import_mujoco

CAMERA = {"distance": 2.2, "azimuth": 70.0, "elevation": -35.0, "lookat": (-0.2, 0.5, 2.0)}
NAMES = ("burner", "light", "slide", "hinge", "microwave")  # of the subtasks
REST = 25  # number of steps that are shown after the last completed subtask
IN_ORDER = "\N{CHECK MARK}"  # follows subtasks whose completion was rewarded
NO_BREAK = "\N{NO-BREAK SPACE}"  # keeps a goal of several subtasks on one line


def kitchen_pictures(env: Kitchen) -> Pictures:
    """A GIF of one task, and an image of the scene, which are the same for all engines."""
    del env
    return Pictures(video=write_video, frame=kitchen_frame, another_order=True)


def write_video(path: Path, task: Task, shown: Sequence[Shown]) -> None:
    """Write a video of episodes on one task, side by side.

    Raises:
      UsageError: if there is no OpenGL for rendering.
    """
    order = [NAMES[subtask] for subtask in task.order if subtask != NONE]
    title = f"Task, in a hidden order: {', '.join(order)}  ({IN_ORDER} done in order)"
    try:
        kitchen_gif(path, title, [panel_of(each) for each in shown])
    except NoOpenGLError as error:
        raise UsageError(str(error)) from None


def kitchen_frames(
    obs: Float[np.ndarray, "T 59"], height: int = 480, width: int = 640
) -> UInt8[np.ndarray, "T H W 3"]:
    """Render the scene at each of T observations.

    Raises:
      NoOpenGLError: if there is no OpenGL for rendering.
      MissingExtraError: if the packages of the kitchen are missing.
    """
    mujoco = import_mujoco()
    from envs.kitchen.model import full_model

    model = full_model()
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


def kitchen_frame(obs: Float[np.ndarray, "59"]) -> UInt8[np.ndarray, "H W 3"]:
    """Render the scene at one observation; raises the same errors as ``kitchen_frames``."""
    return kitchen_frames(np.asarray(obs)[None])[0]


class Panel(NamedTuple):
    """One episode of a GIF."""

    title: str
    obs: Float[np.ndarray, "T 59"]
    """The observations at the start and after each step."""
    completed: Sequence[tuple[int, str]]
    """The completed subtasks, each as the number of steps and its name."""


def kitchen_gif(
    path: Path, title: str, panels: Sequence[Panel], height: int = 216, width: int = 288
) -> None:
    """Write a GIF of episodes side by side below a title; those that end earlier stop at their end."""

    def film(panel: Panel) -> Film:
        def caption(time: int) -> str:
            done = [what for when, what in panel.completed if when <= time]
            return f"step {time}: {', '.join(done) or '-'}"

        return Film(
            title=panel.title,
            num_times=len(panel.obs),
            frames=lambda times: kitchen_frames(panel.obs[times], height, width),
            caption=caption,
        )

    write_films(path, [film(panel) for panel in panels], headline=title)


def panel_of(shown: Shown) -> Panel:
    """The observations of an episode until ``REST`` steps after the last completed subtask."""
    trajectory, rewards = shown.episode.trajectory, shown.episode.rewards
    completed = []
    for time in np.flatnonzero(trajectory.goal_reached[: trajectory.length]):
        name = NAMES[trajectory.achieved_goals[time].argmax()]
        completed.append((int(time) + 1, f"{name}{IN_ORDER}" if rewards[time] > 0 else name))
    obs = observations(shown.episode)
    if completed:
        obs = obs[: completed[-1][0] + REST]
    return Panel(f"{shown.title}\n{words(shown.goals)}", obs, completed)


def words(goals: np.ndarray) -> str:
    """A prompt as text; goals that are not subtasks (some methods move goals) are shown by their
    numbers."""
    return " > ".join(_word(goal) for goal in goals)


def _word(goal: np.ndarray) -> str:
    if not np.isin(goal, (0.0, 1.0)).all():
        return f"({', '.join(f'{value:.1f}' for value in goal)})"
    named = [NAMES[index] for index in np.flatnonzero(goal)]
    return named[0] if len(named) == 1 else "{" + f",{NO_BREAK}".join(named) + "}"
