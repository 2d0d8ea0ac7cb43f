"""Lanes: how many episodes and adaptations run in one compiled program, on all devices at once.

Every task, seed and variant of a method is a *lane* of one compiled program. Lanes are spread over the
devices of all processes that work together and, on each, run in *groups*: the lanes of a group share one
clock, so that a group's episode ends with its slowest lane. On a CPU a group is as large as the memories of
its agents fit into the cache near a core, or as large as a step of the world needs to be worth its call.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, PRNGKeyArray

from envs.base import Environment, Task
from mgpo_jax.sharding import mesh_of_all, on_devices
from mgpo_jax.transformer import TransformerConfig

# Bytes of the agents' memories (key-value caches) in a group: what fits into the cache of a CPU's core, or
# into the memory of an accelerator.
GROUP_BYTES, GROUP_BYTES_ACCELERATOR = 3 << 20, 4 << 30


def together(env: Environment, function: Callable, in_axes: Any = 0) -> Any:
    """A compiled ``function`` over many episodes, which share one clock on one device."""
    options = dict(env.engine.compiler_options)
    return jax.jit(jax.vmap(function, in_axes=in_axes), compiler_options=options)


class Lanes(NamedTuple):
    """What each lane has of its own."""

    task: Task
    key: PRNGKeyArray
    numbers: dict[str, Array]
    """Hyper-parameters that are data."""
    stopped: Bool[Array, "*lanes"] | None = None
    """Whether the search has ended; None where none ends early."""


class Layout(NamedTuple):
    """How lanes are spread: over devices, and on each in groups that share a clock."""

    mesh: Mesh
    group: int
    num_lanes: int
    """With those that only fill up the last groups."""


@dataclass(frozen=True)
class Grid:
    """How lanes are numbered: variants, then seeds, then tasks."""

    variants: int
    seeds: int
    tasks: int

    @property
    def size(self) -> int:
        return self.variants * self.seeds * self.tasks

    def lanes(
        self,
        layout: Layout,
        tasks: Task,
        seed: int,
        numbers: dict[str, list[int | float]],
        ends_early: bool = False,
    ) -> Lanes:
        """The lanes; those beyond the last variant repeat the first ones to fill up a group.

        With ``ends_early`` each says whether it has stopped.
        """
        index = np.arange(layout.num_lanes)
        runs = self.seeds * self.tasks
        which = index // runs % self.variants
        return Lanes(
            task=jax.tree.map(lambda leaf: jnp.asarray(leaf)[index % self.tasks], tasks),
            key=jax.random.split(jax.random.key(seed), runs)[index % runs],
            numbers={name: jnp.array(values)[which] for name, values in numbers.items()},
            stopped=jnp.zeros(layout.num_lanes, bool) if ends_early else None,
        )

    def shape(self, rows: np.ndarray) -> np.ndarray:
        """Rows of lanes as ``[variants, S, N, ..]``, without the lanes that only fill up groups."""
        return rows[: self.size].reshape(self.variants, self.seeds, self.tasks, *rows.shape[1:])


def lanes_together(env: Environment, memory_bytes: int) -> int:
    """How many lanes share a clock."""
    limit = GROUP_BYTES if jax.default_backend() == "cpu" else GROUP_BYTES_ACCELERATOR
    return max(env.engine.worlds_together, limit // max(memory_bytes, 1), 1)


def lay_out(env: Environment, num_lanes: int, memory_bytes: int) -> Layout:
    """Spread at least ``num_lanes`` lanes evenly."""
    mesh = mesh_of_all()
    on_each = -(-num_lanes // mesh.devices.size)
    num_groups = -(-on_each // lanes_together(env, memory_bytes))
    group = -(-on_each // num_groups)
    return Layout(mesh, group, mesh.devices.size * num_groups * group)


def over_lanes(env: Environment, layout: Layout, function: Callable) -> Any:
    """A jitted ``function(own, shared)`` over all lanes."""

    def on_device(own: Any, shared: Any) -> Any:
        grouped = jax.tree.map(lambda leaf: leaf.reshape(-1, layout.group, *leaf.shape[1:]), own)
        done = jax.lax.map(lambda own: jax.vmap(function, in_axes=(0, None))(own, shared), grouped)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), done)

    options = dict(env.engine.compiler_options)
    return on_devices(layout.mesh, on_device, [True, False], True, compiler_options=options)


def cache_bytes(network: TransformerConfig) -> int:
    """Bytes of the key-value cache of an episode."""
    num_tokens = network.max_prompt_length + network.num_step_tokens(network.horizon)
    return 4 * 2 * network.num_layers * network.embed_dim * num_tokens
