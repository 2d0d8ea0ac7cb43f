"""Policies on disk: one small file of weights and a config.

The folder of a policy holds ``weights.npz``, ``config.json`` (what the network is, the hash of
the weights, how they were made) and, beside them, whatever the release adds.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from envs.base import ArraySpec, EnvSpec
from envs.errors import DataError, UsageError
from envs.registry import World, find
from mgpo_jax.distributions import HEADS
from mgpo_jax.encoders import ENCODERS
from mgpo_jax.files import hash_file, load_arrays, read_object
from mgpo_jax.policy import LoadedPolicy, check_fits
from mgpo_jax.prompts import single_goal
from mgpo_jax.transformer import GoalTransformer, TransformerConfig

FORMAT = 2  # 1 had flat observations of size obs_dim
WEIGHTS = "weights.npz"
CONFIG = "config.json"
RELEASED = Path(__file__).parent / "pretrained"
"""Where the released policies and test tasks of the worlds lie."""


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


def released_folder(world: World) -> Path:
    """Where the released policy and the test tasks of a world lie."""
    return RELEASED / world.home


def load_policy(world: World | str, path: Path | str | None = None) -> LoadedPolicy:
    """The policy in a folder (default: the released one), checked against the world.

    Args:
      world: the world, its name, or its place as ``module:attribute``.
      path: folder of a policy.

    Raises:
      UsageError: if there is no policy at that place.
      DataError: if the files are damaged or do not fit the world.
    """
    world = find(world) if isinstance(world, str) else world
    return read_policy(Path(path) if path else released_folder(world), world.make().spec)


def read_policy(folder: Path, spec: EnvSpec | None = None) -> LoadedPolicy:
    """Read a policy from its folder.

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
    config, document = _read_config(folder)
    path = folder / WEIGHTS
    if not path.is_file() or hash_file(path) != document.get("sha256"):
        raise DataError(f"{path} is missing, truncated or differs from the hash in {CONFIG}")
    flat = load_arrays(path)
    _check_weights(path, flat, flatten_dict(_shapes(config), sep="/"))
    if spec is not None:
        check_fits(config, spec, f"the policy in {folder}")
    params = jax.tree.map(jnp.asarray, unflatten_dict(flat, sep="/"))
    return LoadedPolicy(config, params, document["made"], document["sha256"], folder)


def _read_config(folder: Path) -> tuple[TransformerConfig, dict[str, Any]]:
    """The network in the config of a policy, and the whole config."""
    path = folder / CONFIG
    document = read_object(path)
    if document.get("format") not in (1, FORMAT):
        raise DataError(
            f"{folder} has format {document.get('format')}, this version reads 1 and {FORMAT}"
        )
    try:
        network = dict(document["network"])
        document["made"]
        if document["format"] == 1:
            network["obs_shape"] = [network.pop("obs_dim")]
        lists = {name: tuple(value) for name, value in network.items() if isinstance(value, list)}
        config = TransformerConfig(**{**network, **lists})
        size = ArraySpec(tuple(config.obs_shape), config.obs_dtype).size
        np.dtype(config.obs_dtype)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path} is not the config of a policy ({error})") from None
    if config.head not in HEADS:
        raise DataError(f"{path} has the unknown head {config.head!r}")
    if config.encoder not in ENCODERS:
        raise DataError(f"{path} has the unknown encoder {config.encoder!r}")
    for name in ("obs_mean", "obs_std"):
        values = getattr(config, name)
        if len(values) not in (0, size) or not np.isfinite(values).all():
            raise DataError(f"{path}: {name} must hold {size} finite numbers, or none")
    return config, document


def _check_weights(path: Path, flat: dict[str, np.ndarray], expected: dict[str, Any]) -> None:
    """Raise ``DataError`` for the first array that is missing, foreign, misshapen or not finite."""
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


def _shapes(config: TransformerConfig) -> Any:
    """Shapes of the params, without computing them."""

    def init() -> Any:
        prompt = single_goal(jnp.zeros(config.goal_dim), config.max_prompt_length)
        discrete = config.head == "categorical"
        actions = jnp.zeros(1, jnp.int32) if discrete else jnp.zeros((1, config.action_dim))
        obs = jnp.zeros((1, *config.obs_shape), config.obs_dtype)
        return GoalTransformer(config).init(jax.random.key(0), prompt, obs, actions)

    return jax.eval_shape(init)
