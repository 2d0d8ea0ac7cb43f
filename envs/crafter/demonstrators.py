"""The demonstrators of Crafter: scripts that know the recipes and explore the map.

The paper's data came from trained policies (Achievement Distillation), which are not available. A
demonstrator draws an order of achievements for each episode and omits some of them, so that prompts differ;
``envs.crafter.planning`` chooses its actions. It knows only what has been in view in this episode, as it
was when last in view. Now and then it executes a few random actions; then the action that it would have
taken is recorded as the intended one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import NamedTuple

import jax
import jax.numpy as jnp
from craftax.craftax_classic.constants import Action, BlockType
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from envs.agents import Agent, Demonstrator
from envs.base import TimeStep
from envs.crafter.env import Crafter, CrafterState, CrafterTask
from envs.crafter.habits import Habits, Plan, make_plan
from envs.crafter.planning import act
from envs.crafter.scenes import Scene, look, scene_of, unknown_map, whole_map
from envs.crafter.searching import MOVES, contains

NUM_RANDOM = Action.DO.value + 1  # random actions wait, move or act, but never place or make


class Memory(NamedTuple):
    """The memory of a demonstrator within an episode."""

    blocks: UInt32[Array, "17 2 64"]
    """The board of each kind of block, as it was when last in view."""
    plan: Plan
    noise: Float[Array, ""]
    """Probability that a run of random actions starts at a step."""
    left: Int[Array, ""]
    """Number of random actions left in the current run."""
    intended: Int[Array, ""]
    """The latest action before it may have been replaced by a random one."""


def planner(habits: Habits) -> Agent:
    """The demonstrator with given habits. It never quits."""

    def begin(
        key: PRNGKeyArray, task: CrafterTask, state: CrafterState, timestep: TimeStep
    ) -> tuple[Array, Array, Memory]:
        del task
        key_plan, key_noise, key_act, key_map = jax.random.split(key, 4)
        knows = jax.random.uniform(key_map) < habits.whole_map
        memory = Memory(
            blocks=jnp.where(knows, whole_map(state.world), unknown_map()),
            plan=make_plan(key_plan, habits),
            noise=2 * habits.noise * jax.random.uniform(key_noise),
            left=jnp.zeros((), jnp.int32),
            intended=jnp.zeros((), jnp.int32),
        )
        return proceed(key_act, memory, state, timestep)

    def proceed(
        key: PRNGKeyArray, memory: Memory, state: CrafterState, timestep: TimeStep
    ) -> tuple[Array, Array, Memory]:
        del timestep  # it observes the scene below instead, as boards
        key_act, key_noise = jax.random.split(key)
        blocks = look(memory.blocks, state.world)
        scene = scene_of(blocks, state.world)
        intended = act(key_act, scene, memory.plan, habits)
        memory = memory._replace(blocks=blocks, intended=intended)
        action, memory = disturbed(key_noise, scene, memory, habits)
        return action, jnp.zeros((), bool), memory

    return Agent(begin=begin, proceed=proceed, intended=lambda memory: memory.intended)


def disturbed(
    key: PRNGKeyArray, scene: Scene, memory: Memory, habits: Habits
) -> tuple[Int[Array, ""], Memory]:
    """The action to execute: the intended one, or a random one during a run of random actions."""
    key_start, key_length, key_action = jax.random.split(key, 3)
    starts = jax.random.uniform(key_start) < memory.noise
    length = jax.random.randint(key_length, (), 1, habits.longest_run + 1)
    left = jnp.where(memory.left > 0, memory.left, jnp.where(starts, length, 0))
    drawn = jax.random.randint(key_action, (), 0, NUM_RANDOM)
    random = jnp.where(_deadly(scene, drawn), Action.NOOP.value, drawn)
    action = jnp.where(left > 0, random, memory.intended)
    return action, memory._replace(left=jnp.maximum(left - 1, 0))


def _deadly(scene: Scene, action: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether a move would lead into lava."""
    move = (action >= Action.LEFT.value) & (action <= Action.DOWN.value)
    cell = scene.here + jnp.asarray(MOVES)[jnp.clip(action - Action.LEFT.value, 0, 3)]
    return move & contains(scene.of(BlockType.LAVA), cell)


HABITS = {
    "expert": Habits(),
    # Does almost everything it can, as opportunities arise: the highest returns, and the least varied
    # prompts.
    "eager": Habits(drop=0.15, opportunism=1.0),
    # Keeps to its order, so that demonstrations depend most on their prompts.
    "strict": Habits(shuffle=3.0, opportunism=0.3),
    "mapped": Habits(whole_map=1.0),
}
# Knows the map in half of the episodes and explores it in the others, so that a policy can do both,
# depending on its prompt.
GUIDE = {"guide": Habits(drop=0.3, opportunism=0.6, whole_map=0.5)}


def habits_of(settings: Mapping[str, float]) -> Habits:
    """Make habits from numbers.

    Raises:
      ValueError: if a number is out of range, or is not an integer for a count.
    """
    types = {habit.name: type(habit.default) for habit in fields(Habits)}
    for name, value in settings.items():
        if types[name] is not float and value % 1 != 0:
            raise ValueError(f"{name} must be a whole number, found {value:g}")
    return Habits(**{name: types[name](value) for name, value in settings.items()})


def crafter_demonstrators(env: Crafter) -> dict[str, Demonstrator]:
    """The demonstrators by name; that of the released policy comes first."""

    def any_task(key: PRNGKeyArray, index: Int[Array, ""]) -> CrafterTask:
        del index
        return env.sample_task(key)

    def demonstrator(habits: Habits) -> Demonstrator:
        settings = {name: float(value) for name, value in asdict(habits).items()}
        return Demonstrator(
            sample_task=any_task,
            agent=lambda weights: planner(habits),
            settings=tuple(settings.items()),
            configured=lambda values: demonstrator(habits_of({**settings, **values})),
        )

    habits = {**GUIDE, **HABITS} if env.places else HABITS
    return {name: demonstrator(each) for name, each in habits.items()}
