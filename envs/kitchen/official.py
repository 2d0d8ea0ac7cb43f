"""FrankaKitchen of gymnasium-robotics, the official implementation by others."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from importlib.metadata import version
from itertools import takewhile
from typing import Any

import numpy as np

from envs.kitchen.env import NONE, SUBTASKS, Kitchen, KitchenTask
from envs.kitchen.extra import import_mujoco
from envs.kitchen.physics import NUM_ROBOT
from envs.official import Official, Played, played

NAME = "FrankaKitchen-v1"

# The noise that FrankaKitchen adds to each component of an observation by default: uniform within ratio
# times amplitude (``robot_noise_ratio`` of FrankaRobot, ``object_noise_ratio`` of KitchenEnv; amplitudes of
# franka_config.xml). Its amplitudes for the objects' positions begin one joint too early, with that of a
# finger.
ROBOT_RATIO, OBJECT_RATIO = 0.01, 0.0005
ROBOT_AMPLITUDE = 0.1  # of positions and of velocities, rad and m
POSITION_AMPLITUDES = np.repeat([0.1, 0.005, 0.0005, 0.005, 0.1, 0.005, 0.1], [1, 2, 6, 3, 3, 3, 3])
VELOCITY_AMPLITUDES = np.repeat([0.005, 0.1, 0.005, 0.1], [11, 3, 3, 3])
OBS_NOISE = np.concatenate(
    [
        np.full(2 * NUM_ROBOT, ROBOT_RATIO * ROBOT_AMPLITUDE),
        OBJECT_RATIO * POSITION_AMPLITUDES,
        OBJECT_RATIO * VELOCITY_AMPLITUDES,
    ]
)


def franka_kitchen(horizon: int, **changes: Any) -> Any:
    """Create a FrankaKitchen with ``gymnasium.make`` that is comparable with the kitchen here.

    Noise is off. All five subtasks are its goals, since the kitchen here also counts subtasks outside of a
    task. Each counts once, when it is first completed. Completing them does not end an episode; the task's
    rule and the horizon do.

    Args:
      horizon: number of steps after which an episode is truncated.
      changes: settings of FrankaKitchen to add or to override.
    """
    import_mujoco()
    gymnasium = _patched_gymnasium()
    settings = {
        "tasks_to_complete": list(SUBTASKS),
        "remove_task_when_completed": True,
        "terminate_on_tasks_completed": False,
        "robot_noise_ratio": 0.0,
        "object_noise_ratio": 0.0,
    }
    # gymnasium's checker would warn that the observations of two steps share the array of goals.
    return gymnasium.make(
        NAME, max_episode_steps=horizon, disable_env_checker=True, **{**settings, **changes}
    )


def _patched_gymnasium() -> Any:
    """gymnasium with the environments of gymnasium-robotics 1.4.2, patched for mujoco 3.17.

    ``robot_get_obs`` of gymnasium-robotics asserts that the type of a joint, a numpy integer, is in a tuple
    of mujoco's enum values. These no longer compare equal, so the assertion fails. The patched function
    returns the same positions and velocities of the robot's joints without checking types.
    """
    with contextlib.redirect_stderr(io.StringIO()):  # hides a notice about unused environments
        import gymnasium
        import gymnasium_robotics
    from gymnasium_robotics.envs.franka_kitchen import franka_env

    def robot_get_obs(
        model: Any, data: Any, joint_names: Sequence[str]
    ) -> tuple[np.ndarray, np.ndarray]:
        joints = [data.joint(name) for name in joint_names if name.startswith("robot")]
        qpos, qvel = ([getattr(joint, of) for joint in joints] for of in ("qpos", "qvel"))
        return np.concatenate(qpos), np.concatenate(qvel)

    franka_env.robot_get_obs = robot_get_obs
    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium


class FrankaEpisode:
    """An episode of FrankaKitchen on one task.

    FrankaKitchen determines which subtasks are complete and when; only the order of the task is added.

    Args:
      task: the task.
      horizon: number of steps after which the episode is truncated.
    """

    def __init__(self, task: KitchenTask, horizon: int) -> None:
        self._order = subtasks_of(task)
        self._world = franka_kitchen(horizon)

    def reset(self) -> np.ndarray:
        observed, _ = self._world.reset(seed=0)
        self._length = 0
        self._reached: list[tuple[str, int]] = []
        return observed["observation"]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        observed, _, terminated, truncated, info = self._world.step(np.asarray(action, np.float64))
        self._length += 1
        new = info["episode_task_completions"][len(self._reached) :]
        self._reached += [(name, self._length) for name in self._in_turn(new)]
        return observed["observation"], terminated or truncated or self._solved == len(self._order)

    def played(self) -> Played:
        return played(self._reached, self._solved / len(self._order), self._length)

    @property
    def _solved(self) -> int:
        return num_in_turn([name for name, _ in self._reached], self._order)

    def _in_turn(self, names: Sequence[str]) -> list[str]:
        """The subtasks completed in one step, which FrankaKitchen lists in no order; the task's next one
        first."""
        expected = self._order[self._solved : self._solved + 1]
        return sorted(names, key=lambda name: (name not in expected, SUBTASKS.index(name)))


def num_in_turn(completed: Sequence[str], order: Sequence[str]) -> int:
    """The number of subtasks that were completed in order, before any later one of the order.

    Subtasks outside of the order are ignored.
    """
    of_task = [name for name in completed if name in order]
    in_turn = takewhile(lambda pair: pair[0] == pair[1], zip(of_task, order, strict=False))
    return sum(1 for _ in in_turn)


def subtasks_of(task: KitchenTask) -> list[str]:
    """The names of the subtasks of a task, in its order."""
    return [SUBTASKS[index] for index in np.asarray(task.order) if index != NONE]


def goal_name(goal: np.ndarray) -> str:
    """The names of the subtasks of a goal; its numbers, if an optimizer has invented the goal."""
    if not np.isin(goal, (0, 1)).all():
        return " ".join(f"{number:.2f}" for number in goal)
    return " and ".join(SUBTASKS[index] for index in np.flatnonzero(goal))


def kitchen_official(env: Kitchen) -> Official:
    """The record of FrankaKitchen, with the horizon of a kitchen."""
    return Official(
        name=f"{NAME} of gymnasium-robotics {version('gymnasium-robotics')}",
        episode=lambda task: FrankaEpisode(task, env.horizon),
        goal_name=goal_name,
        task_name=lambda task: ", ".join(subtasks_of(task)),
        obs_noise=tuple(OBS_NOISE.tolist()),
    )
