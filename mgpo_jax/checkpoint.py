"""Training checkpoints (Orbax): everything that a run needs to resume as if it had never stopped.

A checkpoint holds its own hash and the identity of its run, so that a run is never resumed from a damaged
checkpoint, or from that of another run. Processes that train together have the same state. All of them save
it together, and process 0 reads it and sends it to the others, so that a run can be resumed with another
number of processes.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from envs.errors import DataError
from mgpo_jax import processes
from mgpo_jax.files import hash_arrays
from mgpo_jax.sharding import fetch
from mgpo_jax.training import TrainState

_HASH, _IDENTITY, _ROWS, _STEP = "sha256", "run", "rows", "step"  # entries besides the state
DAMAGED = "-damaged"  # suffix of the folder to which damaged checkpoints are moved


class Snapshot(NamedTuple):
    """The contents of a checkpoint."""

    state: TrainState
    measured: list[dict[str, float]] | None
    """The rows of metrics so far; None for a checkpoint of an older version, which did not keep them."""
    pending: list[dict[str, float]]
    """The metrics of the steps since the last row."""


@contextmanager
def checkpoints(folder: Path, keep: int = 2) -> Iterator[ocp.CheckpointManager]:
    """An Orbax checkpoint manager, which saves synchronously.

    If several processes work together, each of them must open one and call ``save_state`` for the same
    steps. Orbax then lets process 0 write what all of them have, and lets none go on before the checkpoint
    is complete. It uses the barriers of ``jax.distributed``, which involve no devices. The folder of the
    other processes may be that of process 0, or there may be none.

    A checkpoint becomes visible only when it is complete: a process that is killed while it saves leaves
    the earlier checkpoints intact.

    Raises:
      DataError: if a file is in the place of the folder.
    """
    folder = Path(folder).absolute()
    if folder.exists() and not folder.is_dir():
        raise DataError(
            f"{folder} is not a folder; remove it to start the training from its first step"
        )
    if processes.is_first():
        folder.mkdir(parents=True, exist_ok=True)
    options = ocp.CheckpointManagerOptions(
        max_to_keep=keep,
        create=False,
        enable_async_checkpointing=False,
        multiprocessing_options=_who_saves(),
    )
    with _quiet("absl", "asyncio"):
        manager = ocp.CheckpointManager(folder, options=options)
        try:
            yield manager
        finally:
            manager.close()


def _who_saves() -> ocp.options.MultiprocessingOptions:
    """The processes that save together, by the numbers that jax gives them.

    They are named one by one even if they are all of them, since Orbax would otherwise wait for them by a
    collective over all of their devices.
    """
    own = jax.process_index()
    if processes.count() == 1:  # also if it works apart from others
        return ocp.options.MultiprocessingOptions(
            primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
        )
    return ocp.options.MultiprocessingOptions(
        primary_host=0,
        active_processes=set(range(jax.process_count())),
        barrier_sync_key_prefix="together",
    )


@contextmanager
def _quiet(*names: str) -> Iterator[None]:
    """Silence loggers whose warnings only repeat what is also raised, and reported here in one line."""
    loggers = [logging.getLogger(name) for name in names]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def save_state(manager: ocp.CheckpointManager, snapshot: Snapshot, identity: str = "") -> None:
    """Save a snapshot under its step, in all processes that work together.

    Args:
      manager: the checkpoint manager, as each process has opened it.
      snapshot: the state, which all processes have, and the metrics, which only those of process 0 need.
      identity: identifies the run (64 hexadecimal digits).

    Raises:
      DataError: if this process sees checkpoints of the same or later steps in a folder of its own.
    """
    step, newest = snapshot.state.step, manager.latest_step()
    if newest is not None and newest >= step:
        raise DataError(
            f"{manager.directory} already has a checkpoint of step {newest}, so that none can be saved for "
            f"step {step}; remove the folder, unless it is the one that process 0 has resumed from"
        )
    rows = {"measured": snapshot.measured, "pending": snapshot.pending}
    saved = {
        **_named_leaves(snapshot.state),
        _ROWS: np.frombuffer(json.dumps(rows).encode(), np.uint8),
        _IDENTITY: np.frombuffer(bytes.fromhex(identity or "00"), np.uint8),
    }
    saved[_HASH] = np.frombuffer(bytes.fromhex(hash_arrays(saved)), np.uint8)
    manager.save(step, args=ocp.args.StandardSave(saved))


def _named_leaves(state: TrainState) -> dict[str, np.ndarray]:
    """The leaves by path, so that the format on disk does not depend on the types of optax's states."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(fetch((state.params, state.opt_state)))
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def restore_state(
    manager: ocp.CheckpointManager, blank: TrainState, identity: str | Collection[str] = ""
) -> Snapshot | None:
    """The newest intact checkpoint, or None if there is none. Of several processes only one may call this.

    Damaged checkpoints are moved aside, and a line on stderr says so.

    Args:
      manager: the checkpoint manager.
      blank: a state of the same network, for its structure and shapes.
      identity: the identity of the run, or all identities that it may have; empty if any is accepted.

    Raises:
      DataError: if the checkpoint is of another run or another network.
    """
    root = Path(manager.directory)
    for step in sorted(manager.all_steps(), reverse=True):
        where = root / str(step)
        try:
            found = {k: np.asarray(v) for k, v in _read(manager, step).items()}
            _check_hash(found)
        except Exception as error:  # Orbax raises many kinds for a damaged file
            if isinstance(error, MemoryError) or _is_machine_error(error):
                raise  # the file may be sound
            _set_aside(where, root.with_name(root.name + DAMAGED))
            manager.reload()  # otherwise it refuses to save steps before the removed one
            continue
        known = [identity] if isinstance(identity, str) else identity
        if identity and _IDENTITY in found and found[_IDENTITY].tobytes().hex() not in known:
            raise DataError(
                f"checkpoint {where} is of a run with other settings or data; remove {root} to train "
                "from the first step"
            )
        return _snapshot(found, blank, step, where)
    return None


def state_of_first(state: TrainState | None, blank: TrainState) -> TrainState:
    """Broadcast the state of process 0 to all processes.

    Args:
      state: the state of process 0; ignored in the other processes.
      blank: a state of the same network, for its structure and shapes.
    """
    if processes.count() == 1:
        assert state is not None
        return state

    def find() -> dict[str, np.ndarray]:
        assert state is not None
        return {**_named_leaves(state), _STEP: np.array(state.step)}

    found = processes.arrays_from_first(find)
    assert found is not None
    step = int(found.pop(_STEP))
    params, opt_state = _restored(found, blank)
    return TrainState(params, opt_state, step)


def hash_state(state: TrainState) -> str:
    """SHA-256 of the parameters and of the optimizer's state."""
    return hash_arrays(_named_leaves(state))


def _restored(found: dict[str, np.ndarray], blank: TrainState) -> Any:
    """The parameters and the optimizer's state from leaves by path."""
    leaves = [jnp.asarray(found[name]) for name in _named_leaves(blank)]
    return jax.tree.unflatten(jax.tree.structure((blank.params, blank.opt_state)), leaves)


def _read(manager: ocp.CheckpointManager, step: int) -> Any:
    return manager.restore(step, args=ocp.args.StandardRestore())


def _check_hash(found: dict[str, np.ndarray]) -> None:
    """Raise ``ValueError`` if the arrays differ from those saved; checkpoints of old versions have no
    hash."""
    saved = found.pop(_HASH, None)
    if saved is not None and saved.tobytes().hex() != hash_arrays(found):
        raise ValueError("hash")


def _is_machine_error(error: Exception) -> bool:
    """Whether reading failed because of the machine, rather than because of the contents of the files."""
    return isinstance(error, OSError) and not isinstance(error, FileNotFoundError | EOFError)


def _set_aside(checkpoint: Path, damaged: Path) -> None:
    damaged.mkdir(exist_ok=True)
    names = chain([checkpoint.name], (f"{checkpoint.name}-{number}" for number in count(2)))
    place = next(damaged / name for name in names if not (damaged / name).exists())
    checkpoint.rename(place)
    print(f"checkpoint {checkpoint} is damaged; it was moved to {place}", file=sys.stderr)


def _snapshot(found: dict[str, np.ndarray], blank: TrainState, step: int, where: Path) -> Snapshot:
    """Rebuild a snapshot from the arrays of a checkpoint."""
    rows: dict[str, Any] = {"measured": None, "pending": []}
    if _ROWS in found:
        rows = json.loads(found.pop(_ROWS).tobytes())
    found.pop(_IDENTITY, None)
    wanted = _named_leaves(blank)
    if {k: v.shape for k, v in found.items()} != {k: v.shape for k, v in wanted.items()}:
        raise DataError(f"checkpoint {where} is of another network; start a new run with --out")
    params, opt_state = _restored(found, blank)
    return Snapshot(TrainState(params, opt_state, step), rows["measured"], rows["pending"])
