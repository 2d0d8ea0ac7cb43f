"""Spreading work over devices and fetching results. No other module of the project does either.

A mesh with one axis is used both for pre-training, where trajectories are divided among devices, and for
adaptation, where lanes are. On a CPU the devices are the cores: ``experiments.runtime`` asks XLA for one
device per core, because small programs on one core each are more efficient than one program on all cores.

If several processes work together (``mgpo_jax.processes``), each trains on its own devices and contributes
one row to the gradient, while lanes are spread over the devices of all processes. **No collective may run
between CPU devices of one process**: it waits for its peers on a thread of the pool that they need
themselves, which can deadlock. Collectives between processes cannot, since every process has its own pool.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from envs.base import is_key, raw
from envs.errors import UsageError
from mgpo_jax import processes

AXIS = "data"


def device_mesh(num_devices: int | None = None) -> Mesh:
    """A 1-D mesh named ``data`` over the first ``num_devices`` devices of this process (default: all)."""
    devices = sorted(jax.local_devices(), key=lambda device: device.id)
    return Mesh(np.asarray(devices[:num_devices]), (AXIS,))


def mesh_of_all() -> Mesh:
    """A 1-D mesh named ``data`` over the devices of all processes that work together, in their order."""
    return device_mesh() if processes.count() == 1 else Mesh(np.asarray(_devices_of_all()), (AXIS,))


def _devices_of_all() -> list[Any]:
    """The devices of all processes, process by process.

    ``jax.devices()`` has this order on CPUs and GPUs. On TPUs it follows the places of the chips, and rows
    that are put together process by process would be those of other lanes.
    """
    return sorted(jax.devices(), key=lambda device: (device.process_index, device.id))


def devices_for(part_size: int) -> int:
    """The number of devices per process among which parts of ``part_size`` trajectories divide evenly.

    Raises:
      UsageError: if ``part_size`` is not divisible by the number of processes.
    """
    own, rest = divmod(part_size, processes.count())
    if rest:
        raise UsageError(
            f"--part-size {part_size} does not divide over {processes.count()} processes; give a multiple, "
            "and a --batch-size that is a multiple of it"
        )
    return largest_divisor(own, jax.local_device_count())


def spread(mesh: Mesh) -> NamedSharding:
    """The sharding of arrays whose leading axis is divided among the devices."""
    return NamedSharding(mesh, PartitionSpec(AXIS))


def split(mesh: Mesh, tree: Any) -> Any:
    """Put arrays on the mesh, with their leading axis divided among the devices."""
    return _put(spread(mesh), tree)


def replicate(mesh: Mesh, tree: Any) -> Any:
    """Put a copy of every array on each device."""
    return _put(NamedSharding(mesh, PartitionSpec()), tree)


def _put(layout: NamedSharding, tree: Any) -> Any:
    """Put arrays on a mesh; on a mesh of several processes, each puts the shards of its own devices."""
    if not layout.mesh.is_multi_process:
        return jax.device_put(tree, layout)

    def one(leaf: Any) -> Any:
        if is_key(leaf):
            wrapped = jax.jit(jax.random.wrap_key_data, out_shardings=layout)
            return wrapped(one(jax.random.key_data(leaf)))
        rows = np.asarray(leaf)
        return jax.make_array_from_callback(rows.shape, layout, lambda index: rows[index])

    return jax.tree.map(one, tree)


def on_devices(
    mesh: Mesh, function: Callable, divided: Sequence[bool], result_divided: bool, **options: Any
) -> Any:
    """A jitted function that runs on every device separately, without collectives.

    Args:
      mesh: the devices.
      function: the function that runs on each device.
      divided: for each argument, whether its leading axis is divided among the devices; other arguments are
        replicated.
      result_divided: whether the leading axis of the result is divided.
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
    """Copy arrays from devices to numpy arrays; random keys become their raw data.

    Arrays that are spread over several processes are gathered in all of them, so every process must call
    this.
    """
    tree = jax.tree.map(raw, tree)
    if all(getattr(leaf, "is_fully_addressable", True) for leaf in jax.tree.leaves(tree)):
        return jax.device_get(tree)
    return _gathered(tree)


def _gathered(tree: Any) -> Any:
    """``fetch`` for arrays of several processes, which are exchanged as one vector of bytes."""
    leaves, shape = jax.tree.flatten(tree)
    own = [_own_rows(leaf) for leaf in leaves]
    vector = np.concatenate([np.frombuffer(rows.tobytes(), np.uint8) for rows in own])
    found = np.asarray(rows_of_processes(jnp.asarray(vector)))
    ends = np.cumsum([0, *(rows.nbytes for rows in own)])
    whole = []
    for leaf, rows, first, last in zip(leaves, own, ends, ends[1:], strict=False):
        pieces = [
            np.frombuffer(of_process[first:last].tobytes(), rows.dtype).reshape(rows.shape)
            for of_process in found
        ]
        copied = leaf.is_fully_replicated or leaf.is_fully_addressable
        whole.append(pieces[processes.index()] if copied else np.concatenate(pieces))
    return jax.tree.unflatten(shape, whole)


def _own_rows(leaf: Array) -> np.ndarray:
    """The rows of an array on the devices of this process, in order."""
    shards = leaf.addressable_shards
    if leaf.is_fully_replicated:
        return np.asarray(shards[0].data)
    rows = sorted(shards, key=lambda shard: shard.index[0].start or 0)
    return np.concatenate([np.asarray(shard.data) for shard in rows])


def rows_of_processes(row: Array) -> Array:
    """Gather a vector of each process as rows, on the first device of each. Every process must call
    this."""
    heads = _heads()
    check_collective(heads)
    (head,) = heads.local_devices
    own = jax.device_put(row, head)[None]
    shape = (heads.devices.size, *row.shape)
    rows = jax.make_array_from_single_device_arrays(shape, spread(heads), [own])
    return _gathering(heads)(rows).addressable_data(0)


@cache
def _heads() -> Mesh:
    """The mesh of one device of each process, so that no collective runs between devices of one process."""
    first: dict[int, Any] = {}
    for device in _devices_of_all():
        first.setdefault(device.process_index, device)
    return Mesh(np.asarray([first[number] for number in sorted(first)]), (AXIS,))


@cache
def _gathering(heads: Mesh) -> Any:
    return jax.jit(lambda rows: rows, out_shardings=NamedSharding(heads, PartitionSpec()))


def gather_rows(mesh: Mesh, tree: Any) -> list[Any]:
    """Bring the rows of arrays with one row on each device to the first device.

    Plain copies are used, because a collective can deadlock on the small thread pool of a CPU.
    """
    home = mesh.devices.flat[0]
    return [
        jax.tree.map(lambda leaf, i=i: jax.device_put(leaf.addressable_shards[i].data, home), tree)
        for i in range(mesh.devices.size)
    ]


class Adding:
    """Collects rows of arrays, one from each device, which the caller then adds up in order.

    This is the one place that decides how sums of gradients are exchanged. With one process on CPUs, the
    rows are copied to the first device. With several processes on CPUs, each adds up its own rows, and a
    separate program gathers one vector from each. On accelerators XLA adds the rows of all devices of all
    processes, and a single row remains.

    Args:
      mesh: the devices of this process; the same number takes part from each other process.
    """

    def __init__(self, mesh: Mesh) -> None:
        on_cpu = _is_cpu(mesh)
        self._mesh, self._alone = mesh, processes.count() == 1
        self._copies = self._alone and (on_cpu or mesh.devices.size == 1)
        self._whole = None if on_cpu else _with_others(mesh)
        self._split_up: Any = None
        if self._whole is not None and not self._alone:
            # The first collective over these devices connects them, while all processes are here.
            blank = split(mesh, np.zeros((mesh.devices.size, 1), np.float32))
            jax.block_until_ready(sum_by_collective(mesh, self._whole, blank))

    def __call__(self, tree: Any) -> list[Any]:
        """The rows (or partial sums of them), each on the first device of this process."""
        if self._copies:
            return gather_rows(self._mesh, tree)
        if self._split_up is None:
            self._split_up = _splitting(tree)
        if self._whole is not None:
            return self._split_up(sum_by_collective(self._mesh, self._whole, tree)[None])
        return self._split_up(rows_of_processes(_added(gather_rows(self._mesh, tree))))


def _splitting(tree: Any) -> Any:
    """A jitted function that turns the rows of a matrix into pytrees like the rows of ``tree``."""
    blank = jax.tree.map(lambda leaf: np.zeros((1, *leaf.shape[1:]), leaf.dtype), tree)
    restore = ravel_pytree(blank)[1]
    return jax.jit(lambda matrix: [restore(row) for row in matrix])


@jax.jit
def _added(rows: list[Any]) -> Float[Array, "N"]:
    """The sum of rows, added in order, as one vector."""
    return ravel_pytree(jax.tree.map(lambda *of_devices: sum(of_devices), *rows))[0]


def _with_others(mesh: Mesh) -> Mesh:
    """The mesh extended by the same number of devices of each other process."""
    if processes.count() == 1:
        return mesh
    found: list[Any] = []
    for number in range(jax.process_count()):
        own = [device for device in _devices_of_all() if device.process_index == number]
        found += own[: mesh.devices.size]
    return Mesh(np.asarray(found), (AXIS,))


def sum_by_collective(mesh: Mesh, whole: Mesh, tree: Any) -> Float[Array, "N"]:
    """The sum of the rows on all devices of ``whole``, as one vector on the first device of ``mesh``.

    ``mesh`` holds those devices of ``whole`` that belong to this process.
    """
    check_collective(whole)
    vectors = _vectors(mesh)(tree)
    rows = jax.make_array_from_single_device_arrays(
        (whole.devices.size, vectors.shape[1]),
        spread(whole),
        [shard.data for shard in vectors.addressable_shards],
    )
    return _summing(whole)(rows).addressable_data(0)


def _is_cpu(mesh: Mesh) -> bool:
    """Whether the devices of a mesh are cores of CPUs."""
    return mesh.devices.flat[0].platform == "cpu"


def check_collective(mesh: Mesh) -> None:
    """Raise an error if a collective would run between CPU devices of one process, which may deadlock."""
    owners = [device.process_index for device in mesh.devices.flat]
    assert not (_is_cpu(mesh) and len(set(owners)) < len(owners)), mesh


@cache
def _vectors(mesh: Mesh) -> Any:
    """A jitted function that flattens the row of a pytree on each device into one vector."""
    return on_devices(mesh, lambda own: ravel_pytree(own)[0][None], [True], True)


@cache
def _summing(whole: Mesh) -> Any:
    def total(rows: Float[Array, "D N"]) -> Float[Array, "N"]:
        return rows.sum(axis=0)

    return jax.jit(total, out_shardings=NamedSharding(whole, PartitionSpec()))


def largest_divisor(number: int, limit: int) -> int:
    """The largest divisor of ``number`` that is at most ``limit``."""
    return max(n for n in range(1, limit + 1) if number % n == 0)
