"""Spreading work over devices and fetching results: nothing else in the project does either.

One mesh with one axis serves pre-training, where trajectories are divided, and adaptation, where tasks
and seeds are. On a CPU the devices are the cores (``experiments.runtime`` asks XLA for one device a core,
because small programs on one core each waste less than one program on all).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "data"


def device_mesh(num_devices: int | None = None) -> Mesh:
    """A 1-D mesh named ``data`` over the first ``num_devices`` devices (default: all)."""
    devices = jax.devices()[:num_devices]
    return Mesh(np.asarray(devices), (AXIS,))


def spread(mesh: Mesh) -> NamedSharding:
    """The layout of arrays whose leading axis is divided among the devices."""
    return NamedSharding(mesh, PartitionSpec(AXIS))


def split(mesh: Mesh, tree: Any) -> Any:
    """Put arrays on the mesh, their leading axis divided among the devices."""
    return jax.device_put(tree, spread(mesh))


def replicate(mesh: Mesh, tree: Any) -> Any:
    """Put a copy of every array on each device."""
    return jax.device_put(tree, NamedSharding(mesh, PartitionSpec()))


def on_devices(
    mesh: Mesh, function: Callable, divided: Sequence[bool], result_divided: bool, **options: Any
) -> Any:
    """A jitted function that runs on every device by itself, without collectives.

    Args:
      mesh: the devices.
      function: what runs on each of them.
      divided: for each argument, whether its leading axis is divided among the devices; the others are
        the same on all of them.
      result_divided: the same for the result.
      **options: options of ``jax.jit``.
    """
    spec = {True: PartitionSpec(AXIS), False: PartitionSpec()}
    mapped = jax.shard_map(
        function,
        mesh=mesh,
        in_specs=tuple(spec[is_divided] for is_divided in divided),
        out_specs=spec[result_divided],
        check_vma=False,
    )
    return jax.jit(mapped, **options)


def fetch(tree: Any) -> Any:
    """Arrays of devices as numpy arrays; random keys become their raw data."""

    def raw(leaf: Any) -> Any:
        return jax.random.key_data(leaf) if is_key(leaf) else leaf

    return jax.device_get(jax.tree.map(raw, tree))


def is_key(leaf: Any) -> bool:
    """Whether an array holds random keys."""
    return isinstance(leaf, jax.Array) and jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def gather_rows(mesh: Mesh, tree: Any) -> list[Any]:
    """The rows of arrays that have one row on each device, brought to the first device.

    They travel by plain copies: a collective can deadlock on the small thread pool of a CPU.
    """
    home = mesh.devices.flat[0]
    return [
        jax.tree.map(lambda leaf, i=i: jax.device_put(leaf.addressable_shards[i].data, home), tree)
        for i in range(mesh.devices.size)
    ]


def largest_divisor(number: int, limit: int) -> int:
    """The largest number of devices up to ``limit`` that divides a batch of ``number``."""
    return max(n for n in range(1, limit + 1) if number % n == 0)
