"""MultiRoom of Minigrid in the dark: four rooms in a chain, with closed doors between them."""

from __future__ import annotations

from collections import deque

import gymnasium
import minigrid
import numpy as np

from envs.gymnasium_world import GymnasiumWorld
from envs.live import Moment

gymnasium.register_envs(minigrid)
LEFT, RIGHT, FORWARD, TOGGLE = 0, 1, 2, 5
WALL, DOOR, GOAL, CLOSED = 2, 4, 8, 1  # codes of Minigrid
SIZE = 24.0  # width and height of the grid, in cells


def make():
    """Keeps the useful actions: Minigrid can also pick up and drop things, but these rooms have none."""
    env = gymnasium.make("MiniGrid-MultiRoom-N4-S5-v1", max_episode_steps=60)
    return gymnasium.wrappers.TransformAction(
        env, lambda action: (LEFT, RIGHT, FORWARD, TOGGLE)[action], gymnasium.spaces.Discrete(4)
    )


def place(cell):
    return np.asarray(cell, np.float32) / SIZE


def observe(moment: Moment):
    """The cell ahead (of Minigrid's view of 7 x 7 cells), the agent's direction and its position."""
    kind, _, state = moment.obs["image"][3, 5]
    seen = [kind == WALL, kind == GOAL, kind == DOOR, kind == DOOR and state == CLOSED]
    direction = np.eye(4)[moment.obs["direction"]]
    own = place(moment.env.unwrapped.agent_pos)
    return np.concatenate([seen, direction, own]).astype(np.float32)


def planner(env, rng):
    """Follows a shortest path to the goal and opens the doors on it; one action in five is random."""
    grid = env.unwrapped.grid

    def passable(cell):
        thing = grid.get(*cell)
        return thing is None or thing.type in ("door", "goal")

    def next_cell(start, goal):
        ways, queue = {goal: goal}, deque([goal])
        while queue:
            cell = queue.popleft()
            for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
                near = (cell[0] + dx, cell[1] + dy)
                if near not in ways and passable(near):
                    ways[near] = cell
                    queue.append(near)
        return ways[start]

    def act(moment):
        own = env.unwrapped
        if rng.random() < 0.2:
            return int(rng.integers(4))
        here = tuple(int(x) for x in own.agent_pos)
        there = next_cell(here, tuple(int(x) for x in own.goal_pos))
        wanted = ((1, 0), (0, 1), (-1, 0), (0, -1)).index((there[0] - here[0], there[1] - here[1]))
        turn = (wanted - own.agent_dir) % 4
        if turn:
            return 0 if turn == 3 else 1
        thing = grid.get(*there)
        return 3 if thing is not None and thing.type == "door" and not thing.is_open else 2

    return act


WORLD = GymnasiumWorld(
    name="doors",
    make=make,
    return_range=(0.0, 1.0),
    horizon=60,
    observe=observe,
    achieved=lambda moment: place(moment.env.unwrapped.agent_pos),
    desired=lambda moment: place(moment.env.unwrapped.goal_pos),
    scripts={"planner": planner},
    truncate_in_hindsight=True,
).world(
    summary="four rooms of Minigrid, closed doors between them",
    presets={
        "fast": {
            "trajectories": 2_000, "steps": 1_000, "embed_dim": 64, "num_layers": 2, "num_heads": 2,
            "tokens_per_step": 1, "max_prompt_length": 5, "bucket": 20, "eval_tasks": 16,
            "eval_every": 500, "warmup_steps": 100,
        }
    },
    num_test_tasks=20,
)  # fmt: skip
