"""Lanes: many episodes and adaptations in one compiled program, on all devices at once.

Every combination of a task, a seed and a variant of a method is a *lane* of one compiled program. Lanes are
spread over the devices of all processes that work together. On each device they run in *groups*: the lanes
of a group step together, so that a group's episode takes as long as its longest lane. A group on a CPU is
as large as the cache of a core allows, given the memories (key-value caches) of its agents, and at least as
large as the world needs to make the call into its engine worthwhile (``Engine.worlds_together``).
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
from mgpo_jax.network_configs import TransformerConfig
from mgpo_jax.sharding import mesh_of_all, on_devices

# Largest total size of the agents' memories (key-value caches) in a group, in bytes: what fits into the
# cache of a CPU core, or into the memory of an accelerator.
GROUP_BYTES, GROUP_BYTES_ACCELERATOR = 3 << 20, 4 << 30


def together(env: Environment, function: Callable, in_axes: Any = 0) -> Any:
    """A jitted ``function`` mapped over many episodes, which step together on one device."""
    options = dict(env.engine.compiler_options)
    return jax.jit(jax.vmap(function, in_axes=in_axes), compiler_options=options)


class Lanes(NamedTuple):
    """The inputs that differ between lanes; every array has a leading axis of lanes."""

    task: Task
    key: PRNGKeyArray
    numbers: dict[str, Array]
    """Numeric hyper-parameters by name, which are traced."""
    stopped: Bool[Array, "*lanes"] | None = None
    """Whether the search of a lane has ended; None if no search can end early."""


class Layout(NamedTuple):
    """How lanes are spread over devices and, on each device, divided into groups that step together."""

    mesh: Mesh
    group: int
    """Number of lanes in a group."""
    num_lanes: int
    """Number of lanes, including those that only pad the last groups."""


@dataclass(frozen=True)
class Grid:
    """The numbering of lanes: by variant, then seed, then task (row-major)."""

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
        """The inputs of all lanes; the lanes that pad the last group repeat the first ones.

        Args:
          layout: how the lanes are spread.
          tasks: N tasks, stacked.
          seed: random seed of the run; lanes of the same task and seed number share their key.
          numbers: numeric hyper-parameters by name, a value for each variant.
          ends_early: whether searches can end early (``Lanes.stopped``).
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

    def padded(self, layout: Layout) -> np.ndarray:
        """The lane of the grid whose inputs each lane of the layout has."""
        return np.arange(layout.num_lanes) % self.size

    def place(self, lane: int) -> tuple[int, int]:
        """The seed number and the task of a lane."""
        return divmod(int(lane) % (self.seeds * self.tasks), self.tasks)

    def shape(self, rows: np.ndarray) -> np.ndarray:
        """Reshape rows of lanes to ``[variants, S, N, ..]``, without the lanes that only pad groups."""
        return rows[: self.size].reshape(self.variants, self.seeds, self.tasks, *rows.shape[1:])


def lanes_together(env: Environment, memory_bytes: int) -> int:
    """The largest number of lanes in a group, given the bytes of one agent's memory."""
    limit = GROUP_BYTES if jax.default_backend() == "cpu" else GROUP_BYTES_ACCELERATOR
    return max(env.engine.worlds_together, limit // max(memory_bytes, 1), 1)


def lay_out(env: Environment, num_lanes: int, memory_bytes: int) -> Layout:
    """Spread lanes evenly over all devices and groups, with padding where they do not divide evenly."""
    mesh = mesh_of_all()
    on_each = -(-num_lanes // mesh.devices.size)
    num_groups = -(-on_each // lanes_together(env, memory_bytes))
    group = -(-on_each // num_groups)
    return Layout(mesh, group, mesh.devices.size * num_groups * group)


def over_lanes(env: Environment, layout: Layout, function: Callable) -> Any:
    """A jitted ``function(own, shared)`` mapped over all lanes.

    ``own`` is a pytree with a leading axis of lanes, ``shared`` is the same for all of them.
    """

    def on_device(own: Any, shared: Any) -> Any:
        grouped = jax.tree.map(lambda leaf: leaf.reshape(-1, layout.group, *leaf.shape[1:]), own)
        done = jax.lax.map(lambda own: jax.vmap(function, in_axes=(0, None))(own, shared), grouped)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), done)

    options = dict(env.engine.compiler_options)
    return on_devices(layout.mesh, on_device, [True, False], True, compiler_options=options)


def cache_bytes(network: TransformerConfig) -> int:
    """Bytes of the float32 key-value cache of a full-length episode."""
    num_tokens = network.max_prompt_length + network.num_step_tokens(network.horizon)
    return 4 * 2 * network.num_layers * network.embed_dim * num_tokens
