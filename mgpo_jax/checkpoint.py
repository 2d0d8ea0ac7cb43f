"""Training checkpoints (Orbax) and released policies (one small file and a config).

A released policy is a folder with ``weights.npz``, ``config.json`` (what the network is, the hash of
the weights, how they were made) and, beside them, whatever the release adds.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from flax.traverse_util import flatten_dict, unflatten_dict

from envs.base import EnvSpec
from mgpo_jax.distributions import HEADS
from mgpo_jax.errors import DataError, UsageError, nearest
from mgpo_jax.files import hash_file, load_arrays
from mgpo_jax.pretrain import TrainState
from mgpo_jax.prompts import single_goal
from mgpo_jax.transformer import GoalTransformer, TransformerConfig

FORMAT = 1
SIZES = ("obs_dim", "goal_dim", "action_dim", "horizon")  # of a world, which its policies share
WEIGHTS = "weights.npz"
CONFIG = "config.json"


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
    leaves, _ = jax.tree_util.tree_flatten_with_path((state.params, state.opt_state))
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


def network_config(spec: EnvSpec, head: str | None = None, **sizes: Any) -> TransformerConfig:
    """The network for a world, with Table 6's sizes unless given others.

    Raises:
      UsageError: if there is no such head, or it is not one for the world's actions.
    """
    known = [name for name in HEADS if (name == "categorical") == spec.discrete]
    head = head or known[0]
    if head not in known:
        raise nearest(head, known, f"head for {spec.name}")
    return TransformerConfig(
        obs_dim=spec.obs_dim,
        goal_dim=spec.goal_dim,
        action_dim=spec.action_dim,
        horizon=spec.horizon,
        head=head,
        **sizes,
    )


def save_policy(folder: Path, config: TransformerConfig, params: Any, made: dict[str, Any]) -> None:
    """Write a released policy; ``made`` tells how (environment, command, results)."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    flat = flatten_dict(params, sep="/")
    np.savez(folder / WEIGHTS, allow_pickle=False, **{k: np.asarray(v) for k, v in flat.items()})
    document = {
        "format": FORMAT,
        "sha256": hash_file(folder / WEIGHTS),
        "network": dataclasses.asdict(config),
        "made": made,
    }
    (folder / CONFIG).write_text(json.dumps(document, indent=2) + "\n")


def load_policy_files(
    folder: Path, spec: EnvSpec | None = None
) -> tuple[TransformerConfig, Any, dict[str, Any]]:
    """Read a released policy: network config, params and how it was made.

    Args:
      folder: where ``save_policy`` wrote it.
      spec: the world it must fit.

    Raises:
      UsageError: if there is no policy at that place.
      DataError: if the files are damaged or do not fit.
    """
    folder = Path(folder)
    if not (folder / CONFIG).is_file():
        raise UsageError(
            f"no policy in {folder} ({CONFIG} is missing); give the folder of one with --policy or "
            "train one with `python -m experiments.pretrain`"
        )
    try:
        document = json.loads((folder / CONFIG).read_text())
        network = document["network"]
        lists = {name: tuple(value) for name, value in network.items() if isinstance(value, list)}
        config = TransformerConfig(**{**network, **lists})
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{folder / CONFIG} is not the config of a policy ({error})") from None
    if document.get("format") != FORMAT:
        raise DataError(
            f"{folder} has format {document.get('format')}, this version reads {FORMAT}"
        )
    if config.head not in HEADS:
        raise DataError(f"{folder / CONFIG} has the unknown head {config.head!r}")
    for name in ("obs_mean", "obs_std"):
        values = getattr(config, name)
        if len(values) not in (0, config.obs_dim) or not np.isfinite(values).all():
            raise DataError(
                f"{folder / CONFIG}: {name} must hold {config.obs_dim} finite numbers, or none"
            )
    path = folder / WEIGHTS
    if not path.is_file() or hash_file(path) != document.get("sha256"):
        raise DataError(f"{path} is missing, truncated or differs from the hash in {CONFIG}")
    flat = load_arrays(path)
    expected = flatten_dict(_shapes(config), sep="/")
    for name in sorted(expected.keys() | flat.keys()):
        if name not in flat or name not in expected:
            raise DataError(
                f"{path}: weight {name} is {'missing' if name in expected else 'foreign'}"
            )
        if flat[name].shape != expected[name].shape:
            found, want = list(flat[name].shape), list(expected[name].shape)
            raise DataError(f"{path}: weight {name} has shape {found}, the network needs {want}")
        if not np.isfinite(flat[name]).all():
            raise DataError(f"{path}: weight {name} holds NaN or infinity")
    if spec is not None:
        discrete = config.head == "categorical"
        facts = {"discrete": discrete, **{name: getattr(config, name) for name in SIZES}}
        for field, found in facts.items():
            want = getattr(spec, field)
            if found != want:
                raise DataError(
                    f"the policy in {folder} has {field} {found}, {spec.name} needs {want}: "
                    "it was trained for another world"
                )
    params = jax.tree.map(jnp.asarray, unflatten_dict(flat, sep="/"))
    return config, params, document["made"]


def _shapes(config: TransformerConfig) -> Any:
    """Shapes of the params, without computing them."""

    def init() -> Any:
        prompt = single_goal(jnp.zeros(config.goal_dim), config.max_prompt_length)
        discrete = config.head == "categorical"
        actions = jnp.zeros(1, jnp.int32) if discrete else jnp.zeros((1, config.action_dim))
        return GoalTransformer(config).init(
            jax.random.key(0), prompt, jnp.zeros((1, config.obs_dim)), actions
        )

    return jax.eval_shape(init)
