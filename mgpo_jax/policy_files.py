"""Policies on disk: one small file of parameters and a config.

The folder of a policy holds ``weights.npz`` (the parameters), ``config.json`` (the network's config, the
hash of the parameters, and how they were trained), ``goals.npz`` (a sample of the goals in the training
data) and further files that a release adds.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from pydantic import BaseModel

from envs.errors import DataError, UsageError
from envs.registry import World, find
from envs.specs import EnvSpec
from mgpo_jax.archives import array_names, read_arrays
from mgpo_jax.array_fields import ArrayField
from mgpo_jax.claims import claimed, cleaned_on_exit
from mgpo_jax.files import (
    PLACE,
    TEMPORARY,
    flush_folder,
    hash_file,
    new_folder,
    partial_name,
    write_arrays,
    write_json,
)
from mgpo_jax.kinds import KINDS, MULTI_GOAL, kind_of
from mgpo_jax.network_configs import NetworkConfig, TransformerConfig, network_fault
from mgpo_jax.policy import LoadedPolicy, check_fits
from mgpo_jax.released import released_folder
from mgpo_jax.schema import STRICT, Json, Name, Sha256, checked_entry, read_document
from mgpo_jax.seen_goals import MOST_KEPT, SeenGoals
from mgpo_jax.settings import Index

FORMAT = 2  # version 1 had flat observations of size obs_dim
WEIGHTS = "weights.npz"
CONFIG = "config.json"
GOALS = "goals.npz"  # a sample of the goals in the training data
BEFORE = "before"  # name of the old policy's folder while the new one takes its place
MEND = "give the folder of another policy, or train it again"


def save_policy(
    folder: Path,
    config: NetworkConfig,
    params: Any,
    made: dict[str, Any],
    seen_goals: SeenGoals | None = None,
) -> None:
    """Write a policy to a folder.

    A policy that is there is replaced, and other files in the folder are kept. The replacement is atomic:
    however the process ends, the folder holds either the old policy or the new one.

    Args:
      folder: the folder of the policy.
      config: the network's config.
      params: its parameters.
      made: how it was trained (environment, command, results).
      seen_goals: the goals in its training data.

    Raises:
      DataError: if a parameter is not finite.
    """
    folder = Path(folder)
    arrays = {name: np.asarray(leaf) for name, leaf in flatten_dict(params, sep="/").items()}
    files = _Files(arrays, seen_goals)
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise DataError(
                f"the policy was not saved to {folder}: the weight {name} holds NaN or infinity"
            )
    document = {"format": FORMAT, "network": dataclasses.asdict(config), "made": made}
    if (kind := kind_of(config).name) != MULTI_GOAL:
        document["kind"] = kind
    _finish_exchange(folder)
    if folder.is_dir():
        _exchange(folder.resolve(), files, document)
    else:
        with new_folder(folder) as place:
            _write_policy(place, files, document)


class _Files(NamedTuple):
    """The contents of a policy's npz files."""

    weights: Mapping[str, np.ndarray]
    seen_goals: SeenGoals | None


def _exchange(folder: Path, files: _Files, document: Mapping[str, Any]) -> None:
    """Write a policy next to an existing folder, copy that folder's other files, and exchange the two."""
    partial = partial_name(folder)
    with claimed(partial):
        place, before = partial / PLACE, partial / BEFORE
        clear = functools.partial(shutil.rmtree, place, ignore_errors=True)
        clear()
        try:
            with cleaned_on_exit(clear):
                other_files = shutil.ignore_patterns(WEIGHTS, CONFIG, GOALS, f"{TEMPORARY}*")
                shutil.copytree(folder, place, symlinks=True, ignore=other_files)
                _write_policy(place, files, document)
            os.rename(folder, before)
            os.rename(place, folder)
        except BaseException:
            _put_back(before, folder)
            clear()
            raise
        flush_folder(folder.parent)
        shutil.rmtree(before)


def _finish_exchange(folder: Path) -> None:
    """Put the old policy back, or remove it, after a process was killed while it exchanged two folders."""
    folder = folder.resolve()
    before = partial_name(folder) / BEFORE
    if before.is_dir():
        with claimed(partial_name(folder)):
            _put_back(before, folder)
            shutil.rmtree(before, ignore_errors=True)


def _put_back(before: Path, folder: Path) -> None:
    """Rename a folder that was moved away back to its old name, unless the new one has taken that."""
    if before.is_dir() and not os.path.lexists(folder):
        os.rename(before, folder)


def _write_policy(folder: Path, files: _Files, document: Mapping[str, Any]) -> None:
    write_arrays(folder / WEIGHTS, files.weights, compressed=False)
    if files.seen_goals is not None:
        write_seen_goals(folder, files.seen_goals)
    write_json(folder / CONFIG, {**document, "sha256": hash_file(folder / WEIGHTS)})


def load_policy(
    world: World | str | None = None, path: Path | str | None = None, kind: str = MULTI_GOAL
) -> LoadedPolicy:
    """Load the policy in a folder (default: the released one) and check it against its world.

    Args:
      world: the world, its name, or its place as ``module:attribute``; None for a policy that was trained
        on data of an unregistered world, which is checked only by itself.
      path: the folder of the policy; required if there is no world.
      kind: the kind of network that it must be (default: the multi-goal policy).

    Raises:
      UsageError: if there is no policy at that place, or one of another kind.
      DataError: if the files are damaged or do not fit the world.
    """
    world = find(world) if isinstance(world, str) else world
    if world is None and not path:
        raise UsageError("name a world, or give the folder of a policy as path")
    folder = Path(path) if path else released_folder(_not_none(world), kind)
    policy = read_policy(folder, None if world is None else world.make().spec, kind)
    found = kind_of(policy.config).name
    if found != kind:
        raise UsageError(
            f"the network in {folder} is of the kind {found}, one of the kind {kind} is needed; train it "
            f"with `python -m experiments.pretrain --env {world.name if world else 'WORLD'}"
            f"{method_flag(kind)}`"
        )
    return policy


def _not_none(world: World | None) -> World:
    """The world, which the caller has checked to be given."""
    assert world is not None
    return world


def method_flag(kind: str) -> str:
    """The flag of ``pretrain`` that trains a kind of network; empty for the multi-goal policy."""
    return "" if kind == MULTI_GOAL else f" --method {kind}"


def read_policy(folder: Path, spec: EnvSpec | None = None, kind: str = MULTI_GOAL) -> LoadedPolicy:
    """Read a policy from its folder.

    Args:
      folder: the folder that ``save_policy`` wrote.
      spec: the specification of the world that it must fit.
      kind: the kind of network that is wanted, for the message if there is none.

    Raises:
      UsageError: if there is no policy at that place.
      DataError: if the files are damaged or do not fit.
    """
    folder = Path(folder)
    if not (folder / CONFIG).is_file():
        raise UsageError(
            f"no policy in {folder} ({CONFIG} is missing); give the folder of one with --policy or "
            f"train one with `python -m experiments.pretrain{method_flag(kind)}`"
        )
    document = _read_config(folder)
    network, path = document.network, folder / WEIGHTS
    if not path.is_file() or hash_file(path) != document.sha256:
        raise DataError(
            f"{path} is missing, truncated or differs from the hash in {CONFIG}; {MEND}"
        )
    if isinstance(network, TransformerConfig):
        _check_blocks(path, network)
    fields = {
        name: ArrayField(like.shape, str(like.dtype))
        for name, like in flatten_dict(_shapes(network), sep="/").items()
    }
    flat = read_arrays(path, fields, mend=MEND, only=True)
    if spec is not None:
        check_fits(network, spec, f"the policy in {folder}")
    params = jax.tree.map(jnp.asarray, unflatten_dict(flat, sep="/"))
    seen = read_seen_goals(folder)
    if seen is not None and seen.goals.shape[1] != network.goal_dim:
        raise DataError(
            f"{folder / GOALS} has goals of {seen.goals.shape[1]} numbers, the policy beside it takes "
            f"{network.goal_dim}; remove the file, or {MEND}"
        )
    return LoadedPolicy(network, params, document.made, document.sha256, folder, seen)


def hash_in_config(folder: Path) -> str | None:
    """The hash of the parameters according to a policy's config; None if there is no config.

    Raises:
      DataError: if the config is damaged.
    """
    return _read_config(Path(folder)).sha256 if (Path(folder) / CONFIG).is_file() else None


def write_seen_goals(folder: Path, seen: SeenGoals) -> None:
    """Write the goals that a policy was trained on into its folder."""
    arrays = {"goals": seen.goals, "reach": np.asarray(seen.reach, np.float32)}
    write_arrays(Path(folder) / GOALS, arrays)


def read_seen_goals(folder: Path) -> SeenGoals | None:
    """The goals that the policy in a folder was trained on; None if they were not kept.

    Raises:
      DataError: if the file is damaged.
    """
    path = Path(folder) / GOALS
    if not path.is_file():
        return None
    fields = {
        "goals": ArrayField(("K", "G"), "float32"),
        "reach": ArrayField((), "float32", low=0),
    }
    arrays = read_arrays(path, fields, {"K": range(1, MOST_KEPT + 1)}, f"remove it, or {MEND}")
    return SeenGoals(arrays["goals"], float(arrays["reach"]))


class _Document(BaseModel):
    """The ``config.json`` of a policy."""

    model_config = STRICT

    format: int
    sha256: Sha256
    network: dict[str, Json]
    made: dict[str, Json]
    kind: Name = MULTI_GOAL


SIZES = ("embed_dim", "num_layers", "num_heads", "max_prompt_length")  # never left to a default


class _Made(BaseModel):
    """The known entries of ``made``; further ones are allowed."""

    model_config = {**STRICT, "extra": "ignore"}

    env: Name | None = None
    config: dict[str, Json] | None = None
    steps: Index | None = None
    init_sha256: Sha256 | None = None


class _Config(NamedTuple):
    network: NetworkConfig
    made: dict[str, Any]
    sha256: str


def _read_config(folder: Path) -> _Config:
    """Read the config of a policy and check it."""
    path = folder / CONFIG
    document: _Document = read_document(path, _Document, MEND)
    if document.format not in (1, FORMAT):
        raise DataError(
            f"{path} has format {document.format}, this version reads 1 and {FORMAT}; {MEND}"
        )
    network = document.network
    if document.format == 1 and "obs_dim" in network:
        network = {**network, "obs_shape": [network["obs_dim"]]}
        del network["obs_dim"]
    learned = KINDS.known(document.kind, path).load()
    sizes = [name for name in SIZES if name in {f.name for f in dataclasses.fields(learned.config)}]
    if missing := [name for name in sizes if name not in network]:
        raise DataError(f"{path} lacks network.{missing[0]}; {MEND}")
    config = checked_entry(network, learned.config, path, "network", MEND)
    checked_entry(document.made, _Made, path, "made", MEND)
    if said := network_fault(config) or learned.fault(config):
        raise DataError(f"{path}: network.{said}; {MEND}")
    return _Config(config, document.made, document.sha256)


def _check_blocks(path: Path, config: TransformerConfig) -> None:
    """Raise ``DataError`` if the weights have another number of blocks, before a network is built."""
    names = (re.match(r"params/blocks_(\d+)/", name) for name in array_names(path, MEND))
    found = len({match[1] for match in names if match})
    if found != config.num_layers:
        raise DataError(
            f"{path} has the weights of {found} blocks, {CONFIG} has num_layers {config.num_layers}; {MEND}"
        )


def _shapes(config: NetworkConfig) -> Any:
    """The shapes of the parameters, without computing any."""
    init = kind_of(config).load().init
    return jax.eval_shape(lambda: init(jax.random.key(0), config))
