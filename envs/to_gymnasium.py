"""The worlds as gymnasium environments.

They are registered when this module is imported. Gymnasium does so if the name of the module precedes the
name of the environment:

    gymnasium.make("envs.to_gymnasium:mgpo_jax/maze15-v0")

After ``import envs.to_gymnasium``, the name ``mgpo_jax/maze15-v0`` is enough. Since version 1.0, gymnasium
has no entry points by which an installed package could announce its environments.

An observation is a dict of ``observation``, ``achieved_goal`` and ``desired_goal``, as in the ``GoalEnv``
of gymnasium-robotics. The desired goal is the task goal, which does not reveal everything about the task.
There is no ``compute_reward``, since the reward of a world depends on more than two goals.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

import envs.registry
from envs.base import Environment, Task, TimeStep
from envs.errors import UsageError
from envs.registry import World
from envs.specs import ArraySpec

NAMESPACE, VERSION = "mgpo_jax", 0
KEYS = 2**32


class WorldEnv(gymnasium.Env):
    """A world of this project as a gymnasium environment.

    ``reset(seed=..)`` draws a task and the random key of the episode. ``reset(options={"task": task})``
    begins an episode on a given task, and ``options={"same_task": True}`` one on the last task. ``info``
    holds ``goal_reached`` (whether the achieved goal counts as reached), ``outcome`` (the task goal that
    this episode would accomplish in hindsight) and ``failed`` (whether the simulation failed).

    Args:
      world: the world, as its name, place, record or environment.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (the form that gymnasium requires)

    def __init__(self, world: str | World | Environment) -> None:
        if isinstance(world, Environment):
            self.world = world
        else:
            self.world = envs.registry.make(world) if isinstance(world, str) else world.make()
        spec = self.world.spec
        goals = spaces.Box(-np.inf, np.inf, (spec.goal_dim,), np.float32)
        self.observation_space = spaces.Dict(
            observation=_box(spec.obs), achieved_goal=goals, desired_goal=goals
        )
        self.action_space = (
            spaces.Discrete(spec.action_dim)
            if spec.discrete
            else spaces.Box(-1.0, 1.0, (spec.action_dim,), np.float32)
        )
        self._programs = _programs(self.world)
        self.task: Task | None = None
        """The task of the current episode."""

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=seed)
        key_task, key = jax.random.split(jax.random.key(int(self.np_random.integers(KEYS))))
        draw, goal_of, reset, _ = self._programs
        self.task = self._chosen(options or {})
        if self.task is None:
            self.task = draw(key_task)
        self._goal = np.asarray(goal_of(self.task), np.float32)
        self._state, timestep = reset(key, self.task)
        return self._observed(timestep), _info(timestep)

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        zero = self.world.spec.zero_action()
        self._state, timestep = self._programs[3](self._state, jnp.asarray(action, zero.dtype))
        flags = bool(timestep.terminated), bool(timestep.truncated)
        return self._observed(timestep), float(timestep.reward), *flags, _info(timestep)

    def _chosen(self, options: Mapping[str, Any]) -> Task | None:
        """The task that the options of a reset specify; None to draw one."""
        if unknown := set(options) - {"task", "same_task"}:
            raise UsageError(
                f"options of reset are task and same_task, found {', '.join(sorted(unknown))}"
            )
        if options.get("same_task"):
            if self.task is None:
                raise UsageError("there is no last task yet; call reset without same_task first")
            return self.task
        if "task" not in options:
            return None
        task = options["task"]
        self.world.check_task(jax.tree.map(lambda leaf: np.asarray(leaf)[None], task))
        return jax.tree.map(jnp.asarray, task)

    def _observed(self, timestep: TimeStep) -> dict[str, np.ndarray]:
        return {
            "observation": np.array(timestep.obs),
            "achieved_goal": np.array(timestep.achieved_goal),
            "desired_goal": self._goal.copy(),
        }


def _box(obs: ArraySpec) -> spaces.Box:
    """The space of all observations with a shape and dtype."""
    dtype: Any = np.dtype(obs.dtype)
    if obs.is_float:
        return spaces.Box(-np.inf, np.inf, obs.shape, dtype)
    return spaces.Box(np.iinfo(dtype).min, np.iinfo(dtype).max, obs.shape, dtype)


def _info(timestep: TimeStep) -> dict[str, Any]:
    return {
        "goal_reached": bool(timestep.goal_reached),
        "outcome": np.array(timestep.outcome),
        "failed": bool(timestep.failed),
    }


@cache
def _programs(env: Environment) -> tuple[Any, Any, Any, Any]:
    """The jitted functions ``sample_task``, ``task_goal``, ``reset`` and ``step``, shared by equal
    worlds."""
    compiled = jax.jit(compiler_options=dict(env.engine.compiler_options))
    return (
        compiled(env.sample_task),
        compiled(env.task_goal),
        compiled(env.reset),
        compiled(env.step),
    )


def register(*names: str) -> None:
    """Register worlds, given by name or place, with gymnasium as ``mgpo_jax/NAME-v0``."""
    for name in names:
        own = envs.registry.find(name).name
        identity = f"{NAMESPACE}/{own}-v{VERSION}"
        if identity not in gymnasium.registry:
            gymnasium.register(
                identity, entry_point="envs.to_gymnasium:WorldEnv", kwargs={"world": name}
            )


register(*(world.name for world in envs.registry.WORLDS.usable()))
