"""Small gymnasium environments, as a user would write them, and worlds made of them."""

from __future__ import annotations

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete

from envs.gymnasium_world import GymnasiumWorld


class Plane(gymnasium.Env):
    """A point walks to a goal in a square; actions are steps of limited size in both directions."""

    action_space = Box(np.float32([-0.5, -0.25]), np.float32([0.5, 0.25]), dtype=np.float32)
    observation_space = Dict(
        observation=Box(-2, 2, (4,)), achieved_goal=Box(-2, 2, (2,)), desired_goal=Box(-2, 2, (2,))
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1, 1, 2)
        self.goal = self.np_random.uniform(-1, 1, 2)
        if options is not None:
            self.goal = np.asarray(options["goal"], float)
        self.wind = 0.0 if options is None else options["wind"] * self.np_random.uniform(-1, 1)
        return self.look(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.place = np.clip(self.place + action + [self.wind, 0], -2, 2)
        near = bool(np.linalg.norm(self.place - self.goal) < 0.2)
        return self.look(), float(near), near, False, {"near": near}

    def look(self):
        seen = np.concatenate([self.place, self.goal - self.place])
        return {"observation": seen, "achieved_goal": self.place, "desired_goal": self.goal}


class Broken(Plane):
    """A plane in which every step raises an error."""

    def step(self, action):
        raise RuntimeError("the motor is off")


class Switches(gymnasium.Env):
    """Three switches; pressing the right one first and then the next pays 1/2 each."""

    action_space = Discrete(3, start=5)
    observation_space = Dict(on=gymnasium.spaces.MultiBinary(3), last=Discrete(4))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.order = self.np_random.permutation(3)[:2]
        self.pressed, self.last = [], 3
        return self.look(), {}

    def step(self, action):
        self.last = int(action) - 5
        assert 0 <= self.last < 3
        right = len(self.pressed) < 2 and self.order[len(self.pressed)] == self.last
        self.pressed += [self.last] * bool(right)
        return self.look(), 0.5 * right, len(self.pressed) == 2, False, {}

    def look(self):
        on = np.isin(np.arange(3), self.pressed).astype(np.int8)
        return {"on": on, "last": self.last}


def straight(env, rng):
    """Walks straight to the goal, in steps of random size."""
    return lambda moment: (
        rng.uniform(0.3, 1)
        * np.clip(moment.obs["desired_goal"] - moment.obs["achieved_goal"], -0.5, 0.5)
    )


def presser(env, rng):
    """Presses the right switches in their order, then gives up; the episode is over by then."""
    left = [*env.unwrapped.order]
    return lambda moment: 5 + int(left.pop(0)) if left else None


def one_hot(index, num=3):
    return np.eye(num)[index] if 0 <= index < num else np.zeros(num)


PLANE = GymnasiumWorld(
    name="plane", make=Plane, return_range=(0.0, 1.0), horizon=12, scripts={"straight": straight},
    truncate_in_hindsight=True, optimum=1.0, most=32,
)  # fmt: skip
WINDY = GymnasiumWorld(
    name="windy-plane", make=Plane, return_range=(0.0, 1.0), horizon=12, deterministic=False,
    options=lambda rng: {"goal": rng.uniform(-1, 1, 2), "wind": 0.1},
)  # fmt: skip
SWITCHES = GymnasiumWorld(
    name="switches", make=Switches, return_range=(0.0, 1.0), horizon=6, scripts={"presser": presser},
    achieved=lambda moment: one_hot(moment.env.last),
    desired=lambda moment: one_hot(moment.env.order[0]) + one_hot(moment.env.order[1]),
    outcome=lambda moment: np.isin(np.arange(3), moment.env.pressed),
    reached=lambda moment: moment.reward > 0, reward_confirms_goals=True, optimum=1.0,
    goals=np.eye(3).tolist(),
)  # fmt: skip
WORLD = PLANE.world(num_test_tasks=4, presets={"fast": {"max_prompt_length": 3, "bucket": 12}})
SWITCHING = SWITCHES.world(num_test_tasks=4)
BROKEN = GymnasiumWorld(name="broken", make=Broken, return_range=(0.0, 1.0), horizon=12).world()
