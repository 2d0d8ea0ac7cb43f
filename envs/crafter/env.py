"""Crafter: 22 achievements in a world that is generated from a seed (Hafner, 2022).

Source: paper, appendix C.4, with Craftax-Classic in place of the Python program (``rules.py``). A task is
the seed of a world; the mobs behave randomly in each episode. The reward is 1 when an achievement is
unlocked for the first time, and plus or minus 0.1 for every point of health gained or lost. A goal is one
achievement; the task goal is all of them.

The observation consists of the codes of everything that Crafter draws (``view.py``). Crafter's picture
(``tiles.py``) is a function of these codes. A policy that sees the picture is therefore one whose encoder
computes it from the codes (``encoding.py``); with ``pixels`` the picture itself is the observation.

With places, a goal also includes where its achievement was unlocked, and the agent observes its own
position, both relative to the start. The map of a task is the same in all of its episodes, so a prompt of
such goals tells where things are. This is not part of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from craftax.craftax_classic.constants import Achievement
from craftax.craftax_classic.envs.craftax_state import EnvState
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from envs.base import Environment, TimeStep
from envs.crafter.habits import TIERS
from envs.crafter.rules import SIDE, advance, new_world
from envs.crafter.tiles import PIXELS, agent_picture
from envs.crafter.view import (
    ACHIEVEMENTS,
    LAYOUT,
    MAX_COUNT,
    NUM_ACHIEVEMENTS,
    NUM_ACTIONS,
    OBS_SIZE,
    observe,
)
from envs.errors import UsageError
from envs.specs import ArraySpec, Discrete, Engine, EnvSpec

HEALTH_REWARD = 0.1
PLACE_UNIT = 8.0  # cells
NUM_PLACE = 3  # components of a goal's place: whether it is known, rows and columns from the start
# A step of one world costs a CPU about as much as a step of several, and with one world XLA copies the
# policy's whole key-value cache at every step.
WORLDS_TOGETHER = 16
MAX_SEGMENTS = 4
"""With eight segments the first command compiles for half as long again, and a search was no faster."""


class CrafterTask(NamedTuple):
    """A task: the world that the installed craftax generates from ``seed``, an integer below 2**32."""

    seed: UInt32[Array, "*batch"]


class CrafterState(NamedTuple):
    """An episode in progress."""

    world: EnvState
    """The state of Craftax-Classic: map ``[64, 64]``, mobs, inventory, achievements ``[22]``, needs."""
    key: PRNGKeyArray
    """Random key of the following steps."""
    steps: Int[Array, ""]
    health: Int[Array, ""]
    """The agent's health after its own last move, before the mobs moved."""
    unlocked: Bool[Array, "22"]
    """Which achievement, if any, the last step unlocked; at most one."""


@dataclass(frozen=True)
class Crafter(Environment):
    """The world of Crafter.

    Attributes:
      name: its name in messages and file names.
      horizon: number of steps of an episode.
      pixels: whether an observation is the picture, ``[64, 64, 3]`` bytes, instead of its codes, ``[85]``.
      places: whether goals have places. A goal then consists of an achievement, of whether its place is
        known (1) or not (0), and of the rows and columns from the start to the agent's position when it was
        unlocked, in units of 8 cells. An observation ends with the rows and columns from the start to the
        agent, in the same units.
    """

    name: str
    horizon: int
    pixels: bool = False
    places: bool = False

    def __post_init__(self) -> None:
        if self.pixels and self.places:
            raise UsageError(
                "pixels and places cannot be combined: a picture does not show where on the map the agent "
                "is; choose one of them"
            )

    @property
    def spec(self) -> EnvSpec:
        num_numbers = OBS_SIZE + 2 * self.places
        return EnvSpec(
            name=self.name,
            obs=ArraySpec((PIXELS, PIXELS, 3), "uint8")
            if self.pixels
            else ArraySpec((num_numbers,)),
            goal_dim=NUM_ACHIEVEMENTS + NUM_PLACE * self.places,
            actions=Discrete(NUM_ACTIONS),
            horizon=self.horizon,
            # Nothing is unlocked and all health is lost; or everything is unlocked and no health is lost.
            return_range=(-HEALTH_REWARD * MAX_COUNT, float(NUM_ACHIEVEMENTS)),
            deterministic=False,
            # Achievements are rewarded in any order, so rewards tell nothing about an order.
            reward_confirms_goals=False,
            layout=None if self.pixels else LAYOUT,
        )

    @property
    def engine(self) -> Engine:
        return Engine(worlds_together=WORLDS_TOGETHER, max_segments=MAX_SEGMENTS)

    @property
    def goal_names(self) -> tuple[str, ...]:
        """The achievements."""
        return ACHIEVEMENTS

    def sample_task(self, key: PRNGKeyArray) -> CrafterTask:
        return CrafterTask(seed=jax.random.bits(key, (), jnp.uint32))

    def sample_goal(self, key: PRNGKeyArray) -> Float[Array, "G"]:
        """A random achievement without a known place."""
        goal = jax.random.randint(key, (), 0, NUM_ACHIEVEMENTS)
        return self._without_place(jax.nn.one_hot(goal, NUM_ACHIEVEMENTS))

    @property
    def goal_set(self) -> np.ndarray:
        """One goal for each achievement, without a known place."""
        places = NUM_PLACE * self.places
        return np.pad(np.eye(NUM_ACHIEVEMENTS, dtype=np.float32), ((0, 0), (0, places)))

    def expert_goal(self, state: CrafterState, num_steps: int) -> Float[Array, "G"]:
        """The locked achievement that usually comes first, without a known place."""
        del num_steps
        place = jnp.asarray([TIERS[achievement] for achievement in Achievement])
        first = jnp.argmin(jnp.where(state.world.achievements, jnp.inf, place))
        return self._without_place(jax.nn.one_hot(first, NUM_ACHIEVEMENTS))

    def task_goal(self, task: CrafterTask) -> Float[Array, "G"]:
        """All achievements, in every world."""
        del task
        return self._without_place(jnp.ones(NUM_ACHIEVEMENTS))

    def _without_place(self, achievements: Float[Array, "22"]) -> Float[Array, "G"]:
        return jnp.pad(achievements, (0, NUM_PLACE * self.places))

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
        """Begin in the world of the task, with an empty inventory and full health."""
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
        goal, reached = state.unlocked.astype(jnp.float32), jnp.any(state.unlocked)
        if self.places:
            place = (state.world.player_position - SIDE // 2) / PLACE_UNIT
            obs = jnp.concatenate([obs, place])
            goal = jnp.concatenate([goal, jnp.where(reached, jnp.insert(place, 0, 1.0), 0.0)])
        return TimeStep(
            obs=agent_picture(obs) if self.pixels else obs,
            achieved_goal=goal,
            goal_reached=reached,
            outcome=self._without_place(state.world.achievements.astype(jnp.float32)),
            reward=reward,
            terminated=dead,
            truncated=(state.steps >= self.horizon) & ~dead,
        )
