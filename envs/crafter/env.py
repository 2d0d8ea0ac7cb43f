"""Crafter: 22 achievements in a world that is generated from a seed (Hafner, 2022).

Paper, appendix C.5, with Craftax-Classic in place of the Python program (``rules.py``). A task is the seed
of a world; what mobs do is a matter of chance in each episode. An achievement is worth 1 when it is
unlocked for the first time, and every point of health that is won or lost is worth 0.1. A goal is one
achievement; the task goal is all of them.

The observation is the codes of all that Crafter draws (``view.py``), or the picture that Crafter draws of
them (``tiles.py``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from craftax.craftax_classic.envs.craftax_state import EnvState
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from envs.base import ArraySpec, Discrete, Environment, EnvSpec, ObsLayout, TimeStep
from envs.crafter.rules import advance, new_world
from envs.crafter.tiles import PIXELS, agent_picture
from envs.crafter.view import (
    ACHIEVEMENTS,
    ACTIONS,
    ASLEEP,
    COLUMNS,
    COUNTS,
    LIGHT,
    MAX_COUNT,
    NUM_ACHIEVEMENTS,
    NUM_ACTIONS,
    NUM_ARROWS,
    NUM_BLOCKS,
    NUM_CELLS,
    NUM_CODES,
    NUM_COUNTS,
    NUM_FACINGS,
    NUM_MOBS,
    OBS_SIZE,
    ROWS,
    cell_codes,
    observe,
)

__all__ = [
    "ACHIEVEMENTS",
    "ACTIONS",
    "ASLEEP",
    "COLUMNS",
    "COUNTS",
    "LIGHT",
    "MAX_COUNT",
    "NUM_ACHIEVEMENTS",
    "NUM_ACTIONS",
    "NUM_BLOCKS",
    "NUM_CELLS",
    "NUM_CODES",
    "NUM_COUNTS",
    "NUM_FACINGS",
    "OBS_SIZE",
    "ROWS",
    "Crafter",
    "CrafterState",
    "CrafterTask",
    "cell_codes",
    "observe",
]

MAX_HEALTH = 9
HEALTH_REWARD = 0.1
LAYOUT = ObsLayout(
    num_cells=NUM_CELLS,
    code_sizes=(NUM_BLOCKS, NUM_MOBS, NUM_ARROWS),
    num_counts=NUM_COUNTS,
    max_count=MAX_COUNT,
)


class CrafterTask(NamedTuple):
    """Which world."""

    seed: UInt32[Array, "*batch"]


class CrafterState(NamedTuple):
    """An episode in progress."""

    world: EnvState
    """Craftax-Classic's state: map ``[64, 64]``, mobs, inventory, achievements ``[22]``, needs."""
    key: PRNGKeyArray
    """Of the chance in the steps to come."""
    steps: Int[Array, ""]
    health: Int[Array, ""]
    """After the agent's own last move, before the mobs made theirs."""
    unlocked: Bool[Array, "22"]
    """What the last step unlocked; at most one achievement."""


@dataclass(frozen=True)
class Crafter(Environment):
    """The world of Crafter.

    Attributes:
      name: what it is called.
      horizon: number of steps of an episode.
      pixels: whether an observation is the picture, ``[64, 64, 3]`` bytes, instead of its codes, ``[85]``.
    """

    name: str
    horizon: int
    pixels: bool = False

    @property
    def spec(self) -> EnvSpec:
        return EnvSpec(
            name=self.name,
            obs=ArraySpec((PIXELS, PIXELS, 3), "uint8") if self.pixels else ArraySpec((OBS_SIZE,)),
            goal_dim=NUM_ACHIEVEMENTS,
            actions=Discrete(NUM_ACTIONS),
            horizon=self.horizon,
            # Nothing is unlocked and all health is lost; or everything is, and none is lost.
            return_range=(-HEALTH_REWARD * MAX_HEALTH, float(NUM_ACHIEVEMENTS)),
            deterministic=False,
            # Every achievement is rewarded in any order, which says nothing about the order.
            reward_confirms_goals=False,
            layout=None if self.pixels else LAYOUT,
        )

    @property
    def goal_names(self) -> tuple[str, ...]:
        """The achievements."""
        return ACHIEVEMENTS

    def sample_task(self, key: PRNGKeyArray) -> CrafterTask:
        return CrafterTask(seed=jax.random.bits(key, (), jnp.uint32))

    def sample_goal(self, key: PRNGKeyArray) -> Float[Array, "G"]:
        goal = jax.random.randint(key, (), 0, NUM_ACHIEVEMENTS)
        return jax.nn.one_hot(goal, NUM_ACHIEVEMENTS)

    def task_goal(self, task: CrafterTask) -> Float[Array, "G"]:
        """All achievements, in every world."""
        del task
        return jnp.ones(NUM_ACHIEVEMENTS)

    def check_task(self, tasks: CrafterTask) -> None:
        seed = np.asarray(tasks.seed)
        if seed.ndim != 1:
            raise ValueError(f"seed must have shape [N], found {list(seed.shape)}")
        super().check_task(tasks)
        wrong = (seed < 0) | (seed > np.iinfo(np.uint32).max)
        if wrong.any():
            index = int(np.argmax(wrong))
            raise ValueError(
                f"task {index}: a seed is a whole number from 0 to {np.iinfo(np.uint32).max}, "
                f"found {seed[index]}"
            )

    def reset(self, key: PRNGKeyArray, task: CrafterTask) -> tuple[CrafterState, TimeStep]:
        """The start in the world of the task, without anything and in full health."""
        world = new_world(task.seed.astype(jnp.uint32))
        state = CrafterState(
            world=world,
            key=key,
            steps=jnp.zeros((), jnp.int32),
            health=world.player_health,
            unlocked=jnp.zeros(NUM_ACHIEVEMENTS, bool),
        )
        return state, self._timestep(state, reward=jnp.zeros(()))

    def step(self, state: CrafterState, action: Int[Array, ""]) -> tuple[CrafterState, TimeStep]:
        key, key_step = jax.random.split(state.key)
        before = state.world
        world, health = advance(key_step, before, state.health, action)
        unlocked = world.achievements & ~before.achievements
        ended = self._dead(state) | (state.steps >= self.horizon)
        after = CrafterState(world, key, state.steps + 1, health, unlocked)
        after = jax.tree.map(lambda old, new: jnp.where(ended, old, new), state, after)
        gained = world.player_health - before.player_health
        reward = jnp.sum(unlocked) + HEALTH_REWARD * gained
        return after, self._timestep(after, jnp.where(ended, 0.0, reward))

    def _dead(self, state: CrafterState) -> Bool[Array, ""]:
        return state.world.player_health <= 0

    def _timestep(self, state: CrafterState, reward: Float[Array, ""]) -> TimeStep:
        dead, obs = self._dead(state), observe(state.world)
        return TimeStep(
            obs=agent_picture(obs) if self.pixels else obs,
            achieved_goal=state.unlocked.astype(jnp.float32),
            goal_reached=jnp.any(state.unlocked),
            outcome=state.world.achievements.astype(jnp.float32),
            reward=reward,
            terminated=dead,
            truncated=(state.steps >= self.horizon) & ~dead,
        )
