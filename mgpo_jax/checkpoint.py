"""Training checkpoints (Orbax)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from envs.errors import DataError
from mgpo_jax.sharding import fetch
from mgpo_jax.training import TrainState


@contextmanager
def checkpoints(folder: Path, keep: int = 2) -> Iterator[ocp.CheckpointManager]:
    """An Orbax manager whose pending saves are finished on the way out.

    A save becomes visible only when it is complete: a process killed in the middle of one leaves the
    checkpoints before it.
    """
    options = ocp.CheckpointManagerOptions(max_to_keep=keep, create=True)
    manager = ocp.CheckpointManager(Path(folder).absolute(), options=options)
    try:
        yield manager
    finally:
        manager.wait_until_finished()
        manager.close()


def save_state(manager: ocp.CheckpointManager, state: TrainState) -> None:
    """Save a training state under its step (in the background)."""
    manager.save(state.step, args=ocp.args.StandardSave(_named_leaves(state)))


def _named_leaves(state: TrainState) -> dict[str, np.ndarray]:
    """Leaves by path: what is on disk does not depend on the types of optax's records."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(fetch((state.params, state.opt_state)))
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def restore_state(manager: ocp.CheckpointManager, blank: TrainState) -> TrainState | None:
    """The newest complete training state, or None if there is none.

    Raises:
      DataError: if it cannot be read or does not fit ``blank``.
    """
    step = manager.latest_step()
    if step is None:
        return None
    where = Path(manager.directory) / str(step)
    try:
        found = manager.restore(step, args=ocp.args.StandardRestore())
    except Exception as error:  # Orbax raises many kinds
        reason = str(error).splitlines()[0]
        raise DataError(
            f"checkpoint {where} is damaged ({reason}); remove it to go on from the one before"
        ) from error
    wanted = _named_leaves(blank)
    if {k: v.shape for k, v in found.items()} != {k: v.shape for k, v in wanted.items()}:
        raise DataError(f"checkpoint {where} is of another network; start a new run with --out")
    leaves = [jnp.asarray(found[name]) for name in wanted]
    tree = jax.tree.structure((blank.params, blank.opt_state))
    params, opt_state = jax.tree.unflatten(tree, leaves)
    return TrainState(params, opt_state, step)
