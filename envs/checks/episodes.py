"""The episodes that a world is checked on, run beyond their end."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from envs.agents import Demonstrator
from envs.base import Environment, Task
from envs.checks.values import all_equal, as_numpy
from envs.episodes import run_episode
from envs.specs import EnvSpec

LANES = 6
"""Number of episodes that are run."""
AFTER_END = 4
"""Number of steps beyond the horizon."""


class Played(NamedTuple):
    """The output of L episodes, as numpy leaves ``[L, ..]`` or ``[L, T, ..]``."""

    first: Any
    """The ``TimeStep`` of the reset."""
    steps: Any
    """The ``TimeStep`` of every step."""
    unchanged: Any
    """Whether a step left the whole state unchanged."""


@dataclass(frozen=True)
class Case:
    """The episodes that the rules are checked on."""

    env: Environment
    tasks: Task
    """The tasks of the episodes, leaves ``[L, ..]``."""
    keys: Any
    actions: Any
    shown: int
    """The number of episodes that are demonstrations; they come first."""
    play: Any
    """``(keys, tasks, actions) -> Played``, compiled."""
    played: Played
    ends: np.ndarray
    """The last step of each episode, counted from 0; -1 for an episode that did not end."""

    def place(self, lane: int, step: int) -> str:
        """An episode and a step (counted from 1) as text for a message."""
        who = "the demonstrator's actions" if lane < self.shown else "random actions"
        return f"step {step + 1} of episode {lane} ({who})"


def run_case(
    env: Environment, demonstrator: Demonstrator | None, tasks: Task, seed: int
) -> tuple[Case, Played, dict[str, float]]:
    """Run the episodes twice; returns the case, the repeated episodes, and measurements."""
    horizon = env.spec.horizon
    keys = jax.random.split(jax.random.key(seed + 1), LANES)
    tasks = jax.tree.map(lambda leaf: leaf[:LANES], tasks)
    actions = jax.vmap(partial(_random_actions, env.spec, horizon + AFTER_END))(keys)
    num_shown = 0
    if demonstrator is not None:
        num_shown = LANES // 2
        tasks, actions = _demonstrated(env, demonstrator, keys[:num_shown], tasks, actions)
    # The episode loop of the project splits its key; here the world is given the same key as there.
    keys = jax.vmap(lambda key: jax.random.split(key, 3)[0])(keys)
    compiled = jax.jit(
        jax.vmap(partial(play, env)), compiler_options=dict(env.engine.compiler_options)
    )
    start = time.process_time()
    program = compiled.lower(keys, tasks, actions).compile()
    compiling = time.process_time() - start
    played = as_numpy(program(keys, tasks, actions))
    start = time.process_time()
    repeated = as_numpy(program(keys, tasks, actions))
    running = time.process_time() - start
    over = played.steps.terminated | played.steps.truncated
    ends = np.where(over.any(axis=1), over.argmax(axis=1), -1)
    live = int(np.where(ends < 0, over.shape[1], ends + 1).sum())
    facts = {
        "episodes": float(LANES),
        "steps": float(live),
        "steps_per_cpu_second": live / max(running, 1e-6),
        "compile_seconds": compiling,
    }
    case = Case(env, tasks, keys, actions, num_shown, program, played, ends)
    return case, repeated, facts


def _random_actions(spec: EnvSpec, num: int, key: PRNGKeyArray) -> Array:
    if spec.discrete:
        return jax.random.randint(key, (num,), 0, spec.action_dim)
    return jax.random.uniform(key, (num, spec.action_dim), minval=-1.0, maxval=1.0)


def _demonstrated(
    env: Environment, demonstrator: Demonstrator, keys: Any, tasks: Task, actions: Array
) -> tuple[Task, Array]:
    """Replace the first tasks and actions by those of demonstrations."""

    def demonstrate(key: PRNGKeyArray, index: Array, weights: Any) -> tuple[Task, Array, Array]:
        task = demonstrator.sample_task(key, index)
        episode = run_episode(key, env, demonstrator.agent(weights), task)
        return task, episode.trajectory.actions, episode.trajectory.length

    program = jax.jit(
        jax.vmap(demonstrate, in_axes=(0, 0, None)),
        compiler_options=dict(env.engine.compiler_options),
    )
    num, horizon = len(keys), env.spec.horizon
    own, shown_actions, lengths = program(keys, jnp.arange(num), demonstrator.weights)
    real = jnp.arange(horizon) < lengths[:, None]
    real = real.reshape(*real.shape, *(1,) * (actions.ndim - 2))
    mixed = jnp.where(real, shown_actions, actions[:num, :horizon])
    tasks = jax.tree.map(lambda a, b: jnp.concatenate([a, b[num:]]), own, tasks)
    return tasks, actions.at[:num, :horizon].set(mixed.astype(actions.dtype))


def play(env: Environment, key: PRNGKeyArray, task: Task, actions: Array) -> Played:
    """Run one episode with given actions, beyond its end."""
    state, first = env.reset(key, task)

    def step(state: Any, action: Array) -> Any:
        after, timestep = env.step(state, action)
        return after, (timestep, all_equal(state, after))

    _, (steps, unchanged) = jax.lax.scan(step, state, actions)
    # ``failed`` may be the constant False.
    filled = jnp.broadcast_to(jnp.asarray(steps.failed), steps.reward.shape)
    return Played(first, steps._replace(failed=filled), unchanged)
