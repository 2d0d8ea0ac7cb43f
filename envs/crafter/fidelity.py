"""Compares this world with Crafter, and measures its speed: ``python -m envs.crafter.fidelity``.

This needs the Python package ``crafter``. It prints the composition of maps, the number of mobs that a
randomly walking immortal agent sees, and the steps per CPU-second of a random agent. That the rules agree
is tested by ``tests/test_crafter_official.py``.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.agents import Agent
from envs.crafter.env import Crafter, CrafterState, CrafterTask
from envs.crafter.official import import_crafter
from envs.crafter.rules import new_world
from envs.crafter.view import (
    BLOCKS,
    COLUMNS,
    MAX_COUNT,
    MOBS,
    NUM_ACTIONS,
    NUM_CELLS,
    NUM_MOBS,
    ROWS,
)
from envs.episodes import run_episode
from envs.errors import UsageError

BLOCKS_TOLD = ("grass", "water", "stone", "path", "sand", "tree", "coal", "iron", "diamond", "lava")
MOBS_TOLD = tuple(f"{name}s" for name in MOBS[1:])
"""The mobs that are counted, in the order of their codes."""
MOVES = range(1, 5)  # left, right, up, down: the same numbers in both programs
FIRST, DARKEST = slice(0, 100), slice(185, 235)  # ranges of steps; the light is lowest at step 210


@dataclass(frozen=True)
class FidelityConfig:
    """Settings of this command."""

    worlds: int = 100
    """Number of maps whose blocks are counted."""
    walks: int = 32
    """Number of walks of an immortal agent."""
    steps: int = 240
    """Number of steps of each walk; the darkest steps are the 186th to the 235th."""
    lanes: int = 64
    """Number of simultaneous episodes of a random agent whose speed is measured."""


def shares_here(num_worlds: int) -> dict[str, float]:
    """The fraction of each kind of block in the maps of this world."""
    seeds = jnp.arange(num_worlds, dtype=jnp.uint32)
    maps = np.asarray(jax.lax.map(jax.jit(lambda seed: new_world(seed).map), seeds))
    counts = np.bincount(maps.ravel(), minlength=len(BLOCKS)) / maps.size
    shares = dict(zip(BLOCKS, counts.tolist(), strict=True))
    return {name: shares[name] for name in BLOCKS_TOLD}


def shares_in_crafter(num_worlds: int) -> dict[str, float]:
    """The fraction of each kind of block in the maps of the package."""
    found: Counter[str] = Counter()
    for seed in range(num_worlds):
        env = import_crafter().Env(seed=seed)
        env.reset()
        names = env._world._mat_names
        kinds, counts = np.unique(env._world._mat_map, return_counts=True)
        for kind, count in zip(kinds.tolist(), counts.tolist(), strict=True):
            found[names[kind]] += count
    return {name: found[name] / found.total() for name in BLOCKS_TOLD}


def seen_here(num_walks: int, num_steps: int) -> Float[np.ndarray, "T mobs"]:
    """The number of mobs of each kind in view of an immortal agent after each step, averaged over walks."""
    env = Crafter(name="crafter-symbolic", horizon=num_steps + 1)

    def walk(key: PRNGKeyArray, seed: Array) -> Array:
        key_reset, key_walk = jax.random.split(key)
        state, _ = env.reset(key_reset, CrafterTask(seed))

        def step(state: CrafterState, key: PRNGKeyArray) -> tuple[CrafterState, Array]:
            action = jax.random.randint(key, (), MOVES.start, MOVES.stop)
            state, timestep = env.step(state, action)
            mobs = timestep.obs[:NUM_CELLS].astype(int) // len(BLOCKS) % NUM_MOBS
            healthy = state.world.replace(
                player_health=jnp.full_like(state.world.player_health, MAX_COUNT)
            )
            state = state._replace(world=healthy, health=healthy.player_health)
            return state, jnp.stack(
                [(mobs == code).sum() for code, _ in enumerate(MOBS_TOLD, start=1)]
            )

        return jax.lax.scan(step, state, jax.random.split(key_walk, num_steps))[1]

    keys = jax.random.split(jax.random.key(0), num_walks)
    seeds = jnp.arange(num_walks, dtype=jnp.uint32)
    return np.asarray(jax.jit(jax.vmap(walk))(keys, seeds)).mean(axis=0)


def seen_in_crafter(num_walks: int, num_steps: int) -> Float[np.ndarray, "T mobs"]:
    """The same numbers as ``seen_here``, in the package."""
    objects = import_crafter().objects
    found = np.zeros((num_walks, num_steps, len(MOBS_TOLD)))
    for seed in range(num_walks):
        env, rng = (
            import_crafter().Env(length=num_steps + 1, seed=seed),
            np.random.default_rng(seed),
        )
        env.reset()
        for time_ in range(num_steps):
            env.step(int(rng.integers(MOVES.start, MOVES.stop)))
            env._player.health = MAX_COUNT
            for index, kind in enumerate((objects.Zombie, objects.Cow, objects.Skeleton)):
                found[seed, time_, index] = sum(
                    isinstance(thing, kind) and in_view(thing.pos, env._player.pos)
                    for thing in env._world.objects
                )
    return found.mean(axis=0)


def in_view(place: Int[np.ndarray, "2"], agent: Int[np.ndarray, "2"]) -> bool:
    """Whether a place (column, row) is in view of an agent."""
    column, row = np.abs(place - agent)
    return bool(column <= COLUMNS // 2 and row <= ROWS // 2)


def random_agent() -> Agent:
    """The agent that takes uniformly random actions."""

    def proceed(key: PRNGKeyArray, memory: Any, state: Any, timestep: Any) -> tuple:
        return jax.random.randint(key, (), 0, NUM_ACTIONS), jnp.zeros((), bool), memory

    return Agent(lambda key, task, state, timestep: proceed(key, (), state, timestep), proceed)


def rate(pixels: bool, num_lanes: int) -> float:
    """Steps per CPU-second of a random agent, without compilation."""
    env = Crafter(name="crafter", horizon=500, pixels=pixels)
    run = jax.jit(
        jax.vmap(lambda key, task: length_of(run_episode(key, env, random_agent(), task)))
    )
    tasks = CrafterTask(jnp.arange(num_lanes, dtype=jnp.uint32))
    keys = jax.random.split(jax.random.key(0), (2, num_lanes))
    jax.block_until_ready(run(keys[0], tasks))
    start = time.process_time()
    num_steps = int(run(keys[1], tasks).sum())
    return num_steps / (time.process_time() - start)


def length_of(episode: Any) -> Int[Array, ""]:
    """The number of steps of an episode, computed such that it depends on every step of the record."""
    record = episode.trajectory
    # Any step may be the last, so the compiler has to keep the observations of all of them.
    return record.length + (jnp.sum(record.obs[record.length - 1].astype(jnp.float32)) < -1.0)


def report(config: FidelityConfig) -> Iterator[str]:
    """The comparison of Crafter and this world, as lines of Markdown."""
    yield "| | Crafter | here |\n| --- | --- | --- |"
    shares = shares_in_crafter(config.worlds), shares_here(config.worlds)
    for name in BLOCKS_TOLD:
        there, here = (100 * part[name] for part in shares)
        yield f"| {name}, % of the cells | {there:.1f} | {here:.1f} |"
    seen = [count(config.walks, config.steps) for count in (seen_in_crafter, seen_here)]
    for index, name in enumerate(MOBS_TOLD):
        for part, when in ((FIRST, "first 100 steps"), (DARKEST, "darkest 50")):
            there, here = (rows[part, index].mean() for rows in seen)
            yield f"| {name} in view, {when} | {there:.2f} | {here:.2f} |"
    for pixels, name in ((False, "codes"), (True, "pictures")):
        yield f"| steps in a CPU-second, {name} | | {rate(pixels, config.lanes):,.0f} |"


def main(config: FidelityConfig) -> None:
    """Print the comparison."""
    for line in report(config):
        print(line, flush=True)


if __name__ == "__main__":
    settings = tyro.cli(FidelityConfig)
    try:
        main(settings)
    except (ImportError, UsageError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
