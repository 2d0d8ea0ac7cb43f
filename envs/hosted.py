"""A gymnasium environment as a world: pure functions that step environments on the host by a callback.

The state of an episode holds how it began, its identity, its actions and the number of its steps, so that
any step can be repeated at any time (see ``envs/live.py``). Under ``vmap`` all episodes are stepped in one
call.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import buffer_callback
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt

from envs.agents import Agent, Demonstrator
from envs.base import Environment, TimeStep
from envs.errors import NotAvailableError
from envs.gymnasium_world import GymnasiumWorld, Shapes
from envs.live import Pool, Reading, Start
from envs.specs import Engine, EnvSpec

MAX_SEED = 2**31 - 1


class HostedTask(NamedTuple):
    """A task: the arguments of its resets, and the goal in the first observation."""

    seed: Int[Array, "*batch"]
    goal: Float[Array, "*batch G"]
    options: dict[str, Array]


class HostedState(NamedTuple):
    """An episode in progress."""

    task: HostedTask
    seed: Int[Array, ""]
    """Random seed of its reset."""
    identity: UInt[Array, "2"]
    """Hash of everything that has happened in it."""
    actions: Array
    """``[T]`` or ``[T, A]``: the actions taken so far, padded with zeros."""
    steps: Int[Array, ""]
    told: TimeStep
    """The time step of the last step, with reward 0."""


@dataclass(frozen=True)
class Hosted(Environment):
    """A world around the environments of a gymnasium factory."""

    described: GymnasiumWorld

    @property
    def spec(self) -> EnvSpec:
        return spec_of(self.described)

    @property
    def engine(self) -> Engine:
        return Engine(worlds_together=self.described.together)

    def sample_task(self, key: PRNGKeyArray) -> HostedTask:
        seed = jax.random.randint(key, (), 0, MAX_SEED)
        shapes = self.described.shapes
        wanted = (
            jax.ShapeDtypeStruct((shapes.goal,), jnp.float32),
            {name: _struct(leaf) for name, leaf in shapes.options.items()},
        )
        return HostedTask(seed, *on_host(_draw_tasks, self.described, wanted)(seed))

    def task_goal(self, task: HostedTask) -> Float[Array, "G"]:
        return task.goal

    def fingerprint(self, task: HostedTask) -> Int[Array, "F"]:
        """Seed and options if the seed is part of the task; otherwise options and goal."""
        if not self.described.deterministic:
            return super().fingerprint((task.options, task.goal))
        return super().fingerprint((task.seed, task.options))

    def optimal_return(self, task: HostedTask) -> Float[Array, ""]:
        best = self.described.optimum
        return jnp.full((), jnp.nan if best is None else best)

    @property
    def goal_set(self) -> np.ndarray:
        if not self.described.goals:
            return super().goal_set
        return np.asarray(self.described.goals, np.float32)

    def sample_goal(self, key: PRNGKeyArray) -> Float[Array, "G"]:
        if not self.described.goals:
            raise NotAvailableError(
                f"{self.spec.name} draws no goals at random (its description has no goals)"
            )
        return jax.random.choice(key, jnp.asarray(self.goal_set))

    def reset(self, key: PRNGKeyArray, task: HostedTask) -> tuple[HostedState, TimeStep]:
        drawn = jax.random.randint(key, (), 0, MAX_SEED)
        seed = task.seed if self.described.deterministic else drawn
        timestep, identity = self._call_host(_begin_all, seed, task.options)
        zero = self.spec.zero_action()
        actions = jnp.zeros((self.spec.horizon, *zero.shape), zero.dtype)
        return HostedState(task, seed, identity, actions, jnp.int32(0), timestep), timestep

    def step(self, state: HostedState, action: Array) -> tuple[HostedState, TimeStep]:
        over = state.told.terminated | state.told.truncated
        action = jnp.asarray(action).astype(state.actions.dtype)
        timestep, identity = self._call_host(
            _advance_all,
            state.seed,
            state.task.options,
            state.identity,
            state.actions,
            state.steps,
            action,
            ~over,
        )
        steps = state.steps + 1
        at_horizon = (steps >= self.spec.horizon) & ~timestep.terminated
        timestep = timestep._replace(truncated=timestep.truncated | at_horizon)
        actions = jax.lax.dynamic_update_index_in_dim(state.actions, action, state.steps, 0)
        quiet = timestep._replace(reward=jnp.zeros(()))
        after = HostedState(state.task, state.seed, identity, actions, steps, quiet)
        after = jax.tree.map(lambda old, new: jnp.where(over, old, new), state, after)
        return after, after.told._replace(reward=jnp.where(over, 0.0, timestep.reward))

    def _call_host(self, function: Callable, *args: Any) -> tuple[TimeStep, UInt[Array, "2"]]:
        """Call a function on the host that returns a time step and the identity of the episode."""
        spec = self.spec
        goal = jax.ShapeDtypeStruct((spec.goal_dim,), jnp.float32)
        parts: Any = (
            jax.ShapeDtypeStruct(spec.obs.shape, spec.obs.dtype),
            goal,
            goal,
            jax.ShapeDtypeStruct((), jnp.float32),
            jax.ShapeDtypeStruct((4,), jnp.uint8),
        )
        wanted = Reading(*parts)
        identity = jax.ShapeDtypeStruct((2,), jnp.uint32)
        reading, identity = on_host(function, self.described, (wanted, identity))(*args)
        reached, terminated, truncated, failed = reading.flags > 0
        timestep = TimeStep(
            obs=reading.obs,
            achieved_goal=reading.achieved_goal,
            goal_reached=reached,
            outcome=reading.outcome,
            reward=reading.reward,
            terminated=terminated | failed,
            truncated=truncated & ~terminated & ~failed,
            failed=failed,
        )
        return timestep, identity


def _struct(leaf: np.ndarray) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)


@cache
def spec_of(described: GymnasiumWorld) -> EnvSpec:
    """The spec of a described world, for which one environment is created and reset."""
    shapes: Shapes = described.shapes
    return EnvSpec(
        name=described.name,
        obs=shapes.obs,
        goal_dim=shapes.goal,
        actions=shapes.actions,
        horizon=shapes.horizon,
        return_range=described.return_range,
        truncate_in_hindsight=described.truncate_in_hindsight,
        deterministic=described.deterministic,
        reward_confirms_goals=described.reward_confirms_goals,
        goals_are_states=described.goals_are_states,
    )


def on_host(function: Callable, described: GymnasiumWorld, wanted: Any) -> Callable:
    """Turn a numpy function for B episodes into a jax function for one episode, which ``vmap`` batches.

    ``function(pool, described, *args)`` takes arrays ``[B, ..]`` and returns arrays of the shapes in
    ``wanted`` with that leading axis.
    """
    first_rank = len(jax.tree.leaves(wanted)[0].shape)

    def flat(args: Any, batch: tuple[int, ...]) -> Any:
        def rows(leaf: Any) -> np.ndarray:
            array = np.asarray(leaf)
            return array.reshape(-1, *array.shape[len(batch) :])

        return jax.tree.map(rows, args)

    def write(context: Any, out: Any, *args: Any) -> None:
        del context
        outs = jax.tree.leaves(out)
        views = [np.asarray(buffer) for buffer in outs]
        batch = views[0].shape[: views[0].ndim - first_rank]
        found = jax.tree.leaves(function(described.pool, described, *flat(args, batch)))
        for view, array in zip(views, found, strict=True):
            view[...] = array.reshape(view.shape)

    def compute(*args: Any) -> Any:
        first = np.asarray(jax.tree.leaves(args)[0])
        batch = first.shape  # the first argument is a scalar for each episode
        found = function(described.pool, described, *flat(args, batch))
        leaves = [array.reshape(*batch, *array.shape[1:]) for array in jax.tree.leaves(found)]
        return jax.tree.unflatten(jax.tree.structure(wanted), leaves)

    def call(*args: Any) -> Any:
        if jax.default_backend() == "cpu":  # see ``envs/kitchen/native.py`` for the reason
            return buffer_callback(write, wanted, vmap_method="broadcast_all")(*args)
        return jax.pure_callback(compute, wanted, *args, vmap_method="broadcast_all")

    return call


def _starts(seeds: np.ndarray, options: dict[str, np.ndarray]) -> list[Start]:
    leaves = [np.ascontiguousarray(leaf) for leaf in jax.tree.leaves(options)]
    return [Start(int(seed), tuple(leaf[i] for leaf in leaves)) for i, seed in enumerate(seeds)]


def _draw_tasks(
    pool: Pool, described: GymnasiumWorld, seeds: np.ndarray
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The goals and options of tasks with given seeds."""

    def draw(index: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        seed = int(seeds[index])
        options = described.drawn_options(seed)
        start = Start(seed, tuple(jax.tree.leaves(options)))
        _, goal, _ = pool.begin(start, described.goal_of)
        return goal, options

    drawn = pool.map(draw, len(seeds))
    return jax.tree.map(lambda *rows: np.stack(rows), *drawn)


def _rows(found: list[tuple[bytes, Reading]]) -> tuple[Reading, np.ndarray]:
    readings = Reading(*(np.stack(parts) for parts in zip(*(r for _, r in found), strict=True)))
    identities = np.frombuffer(b"".join(one for one, _ in found), np.uint32).reshape(-1, 2)
    return readings, identities


def _begin_all(
    pool: Pool, described: GymnasiumWorld, seeds: np.ndarray, options: dict[str, np.ndarray]
) -> tuple[Reading, np.ndarray]:
    """Begin B episodes."""
    starts = _starts(seeds, options)

    def begin(index: int) -> tuple[bytes, Reading]:
        identity, _, reading = pool.begin(starts[index])
        return identity, reading

    return _rows(pool.map(begin, len(starts)))


def _advance_all(
    pool: Pool,
    described: GymnasiumWorld,
    seeds: np.ndarray,
    options: dict[str, np.ndarray],
    identities: np.ndarray,
    actions: np.ndarray,
    steps: np.ndarray,
    action: np.ndarray,
    active: np.ndarray,
) -> tuple[Reading, np.ndarray]:
    """Step those of B episodes that are active; the results for the others are meaningless."""
    starts = _starts(seeds, options)
    blank = bytes(8), described.shapes.blank
    found: list[tuple[bytes, Reading]] = [blank] * len(starts)
    places: dict[bytes, list[int]] = {}  # equal episodes with equal actions share one step
    for index in np.flatnonzero(active).tolist():
        where = identities[index].tobytes() + action[index].tobytes()
        places.setdefault(where, []).append(index)
    groups = list(places.values())

    def advance(number: int) -> tuple[bytes, Reading]:
        index = groups[number][0]
        before = actions[index, : int(steps[index])]
        return pool.advance(
            starts[index], identities[index].tobytes(), before, np.asarray(action[index])
        )

    for group, result in zip(groups, pool.map(advance, len(groups)), strict=True):
        for index in group:
            found[index] = result
    return _rows(found)


def script(described: GymnasiumWorld, name: str) -> Demonstrator:
    """The demonstrator that takes every action from a script of the description."""
    env = Hosted(described)
    zero = env.spec.zero_action()

    def ask(
        pool: Pool,
        described: GymnasiumWorld,
        seeds: np.ndarray,
        options: dict[str, np.ndarray],
        identities: np.ndarray,
        actions: np.ndarray,
        steps: np.ndarray,
        own: np.ndarray,
        active: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        starts = _starts(seeds, options)

        def answer(index: int) -> tuple[np.ndarray, np.ndarray]:
            nothing = np.zeros(zero.shape, zero.dtype)
            if not active[index]:
                return nothing, np.array(False)
            before = actions[index, : int(steps[index])]
            identity = identities[index].tobytes()
            action = pool.ask(starts[index], identity, before, name, int(own[index]))
            if action is None:
                return nothing, np.array(True)
            return described.to_program(action).astype(zero.dtype), np.array(False)

        answers = pool.map(answer, len(starts))
        return tuple(np.stack(parts) for parts in zip(*answers, strict=True))  # type: ignore[return-value]

    wanted = (jax.ShapeDtypeStruct(zero.shape, zero.dtype), jax.ShapeDtypeStruct((), jnp.bool_))

    def proceed(
        key: PRNGKeyArray, own: Int[Array, ""], state: HostedState, timestep: TimeStep
    ) -> tuple[Array, Bool[Array, ""], Int[Array, ""]]:
        del key
        over = timestep.terminated | timestep.truncated
        action, quits = on_host(ask, described, wanted)(
            state.seed,
            state.task.options,
            state.identity,
            state.actions,
            state.steps,
            own,
            ~over,
        )
        return action, quits, own

    def begin(key: PRNGKeyArray, task: HostedTask, state: HostedState, timestep: TimeStep) -> Any:
        del task
        return proceed(key, jax.random.randint(key, (), 0, MAX_SEED), state, timestep)

    return Demonstrator(
        sample_task=lambda key, index: env.sample_task(key),
        agent=lambda weights: Agent(begin, proceed),
    )
