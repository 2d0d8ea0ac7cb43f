"""Spreading work over devices: trajectories in pre-training, tasks and seeds in adaptation.

One mesh with one axis serves both. On a CPU the devices are the cores (``experiments.runtime`` asks
XLA for one device a core: small programs on one core each waste less than one program on all).
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "data"


def device_mesh(num_devices: int | None = None) -> Mesh:
    """A 1-D mesh named ``data`` over the first ``num_devices`` devices (default: all)."""
    devices = jax.devices()[:num_devices]
    return Mesh(np.asarray(devices), (AXIS,))


def split(mesh: Mesh, tree: Any) -> Any:
    """Put arrays on the mesh, their leading axis divided among the devices."""
    return jax.device_put(tree, NamedSharding(mesh, PartitionSpec(AXIS)))


def replicate(mesh: Mesh, tree: Any) -> Any:
    """Put a copy of every array on each device."""
    return jax.device_put(tree, NamedSharding(mesh, PartitionSpec()))


def largest_divisor(number: int, limit: int) -> int:
    """The largest number of devices up to ``limit`` that divides a batch of ``number``."""
    return max(n for n in range(1, limit + 1) if number % n == 0)
