"""FrankaKitchen of gymnasium-robotics, with rewards for subtasks completed in a hidden order.

The released policy of our kitchen can act in it, since its observations have the same 59 numbers.
"""

from __future__ import annotations

import gymnasium
import numpy as np

from envs.gymnasium_world import GymnasiumWorld
from envs.kitchen.env import NONE, SUBTASKS
from envs.kitchen.official import franka_kitchen, num_in_turn

HORIZON = 500  # as the released policy was trained with


class Ordered(gymnasium.Wrapper):
    """FrankaKitchen with a reward of 1/n for each of the task's n subtasks completed in its turn."""

    def reset(self, *, seed=None, options=None):
        obs, info = self.env.reset(seed=seed)
        self.order = [SUBTASKS[index] for index in options["order"] if index != NONE]
        self.done, self.solved, self.new = [], 0, []
        return obs, info

    def step(self, action):
        obs, _, terminated, truncated, info = self.env.step(action)
        self.new = info["episode_task_completions"][len(self.done) :]
        self.done += self.new
        before, self.solved = self.solved, num_in_turn(self.done, self.order)
        reward = (self.solved - before) / len(self.order)
        return obs, reward, terminated or self.solved == len(self.order), truncated, info


def marked(names):
    """The named subtasks as a boolean vector over all subtasks."""
    return np.isin(SUBTASKS, list(names))


def draw_order(rng):
    """Draw three of the five subtasks in random order."""
    return {"order": np.append(rng.permutation(len(SUBTASKS))[:3], [NONE, NONE])}


WORLD = GymnasiumWorld(
    name="franka-kitchen",
    make=lambda: Ordered(franka_kitchen(HORIZON)),
    return_range=(0.0, 1.0),
    horizon=HORIZON,
    options=draw_order,
    observe=lambda moment: moment.obs["observation"],
    achieved=lambda moment: marked(moment.env.new),
    desired=lambda moment: marked(moment.env.order),
    outcome=lambda moment: marked(moment.env.done),
    reached=lambda moment: bool(moment.env.new),
    most=16,
    threads=None,
    reward_confirms_goals=True,
).world(summary="FrankaKitchen with a hidden order", num_test_tasks=6)
