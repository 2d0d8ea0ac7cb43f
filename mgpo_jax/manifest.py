"""The ``manifest.json`` of a dataset, and the facts about a dataset before it is read. Imports no jax.

There are two formats on disk. Data collected from a demonstrator are packed in ``trajectories.npz``,
compressed, unless they are large. Large and imported data have an uncompressed file ``NAME.npy`` for each
array, which is mapped into memory instead of read, so that such a dataset may be larger than the memory.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le, MaxLen
from pydantic import BaseModel

from envs.errors import DataError
from mgpo_jax.archives import array_headers, read_arrays
from mgpo_jax.array_fields import ArrayField, ArrayHeader
from mgpo_jax.mapped import mapped_arrays, mapped_headers
from mgpo_jax.schema import (
    STRICT,
    DemonstratorName,
    Json,
    Name,
    Sha256,
    checked_entry,
    read_document,
)
from mgpo_jax.settings import Count, Index, Seed

PACKED, MAPPED = 2, 3
"""The current format versions. Version 1 had neither rewards nor last observations, and called achieved
goals "goals"."""
FORMATS = (1, PACKED, MAPPED)
ARRAYS = "trajectories.npz"
MANIFEST = "manifest.json"

Size = Annotated[int, Ge(1), Le(1_000_000)]
Bound = Annotated[float, Ge(-1e18), Le(1e18)]


class SpecEntry(BaseModel):
    """The manifest's description of the world that logged data are from, if that world is not
    registered."""

    model_config = STRICT

    name: Name
    horizon: Size
    """Number of steps after which an episode is cut off."""
    num_actions: Size | None = None
    """Number of discrete actions; null if actions are continuous."""
    truncate_in_hindsight: bool = True
    """Whether a trajectory cut at any step demonstrates how to reach another goal."""
    action_low: Annotated[list[Bound], MaxLen(10_000)] = []
    """The original value of -1 in each component of an action; empty if actions were not rescaled."""
    action_high: Annotated[list[Bound], MaxLen(10_000)] = []
    """The original value of 1 in each component; empty if actions were not rescaled."""


class EndCount(BaseModel):
    """How many episodes of one length ended in one way."""

    model_config = STRICT

    steps: Size
    """Number of actions of each of these episodes in the logs."""
    episodes: Count
    first: Index
    """Index of the first trajectory among them."""


class DroppedEnds(BaseModel):
    """How episodes ended in logs of others, if their last actions were dropped by the import."""

    model_config = STRICT

    terminated: list[EndCount] = []
    truncated: list[EndCount] = []
    both: list[EndCount] = []
    neither: list[EndCount] = []


class Manifest(BaseModel):
    """The known entries of ``manifest.json``; further ones are allowed."""

    model_config = {**STRICT, "extra": "ignore"}

    format: int
    sha256: Sha256
    num_trajectories: Count = 0
    num_steps: Count = 0
    """Number of steps of all trajectories; 0 if the manifest does not say."""
    files: Annotated[dict[Name, Sha256], MaxLen(32)] = {}
    """The hash of each array's file, by the name of the array; only in mapped datasets."""
    spec: SpecEntry | None = None
    dropped_ends: DroppedEnds | None = None
    env: Name | None = None
    policy: DemonstratorName | None = None
    settings: dict[str, Json] = {}
    seed: Seed | None = None
    versions: dict[str, str] = {}
    tried_again: Index = 0
    failed_episodes: Index = 0
    dropped_test_tasks: Index = 0
    length: dict[str, Json] = {}
    at_horizon: Annotated[float, Ge(0), Le(1)] = 0
    hindsight_return: dict[str, Json] = {}
    variants: dict[str, Index] = {}
    """Number of trajectories of each variant of the world, by name, in the order of the variants'
    indices."""


def mend_for(folder: Path) -> str:
    """How to mend a damaged dataset, the end of a message."""
    mapped = (Path(folder) / "actions.npy").exists()
    return f"remove {folder} and {'collect or import' if mapped else 'collect'} it again"


def read_manifest(folder: Path, mend: str = "") -> tuple[dict[str, Any], Manifest]:
    """The manifest of a dataset, as the whole document and as the record of its known entries.

    Raises:
      DataError: if the manifest is missing, damaged or of another format.
    """
    path, mend = Path(folder) / MANIFEST, mend or mend_for(folder)
    if not path.is_file():
        raise DataError(f"no dataset in {folder}{_what_is_there(Path(folder))}")
    document = read_document(path, dict[str, Json], mend)
    manifest: Manifest = checked_entry(document, Manifest, path, "", mend)
    if manifest.format not in FORMATS:
        known = ", ".join(map(str, FORMATS[:-1]))
        raise DataError(
            f"{path} has format {manifest.format}, this version reads {known} and {FORMATS[-1]}; {mend}"
        )
    if manifest.format == MAPPED and hash_of_files(manifest.files) != manifest.sha256:
        raise DataError(f"{path}: sha256 is not that of its list of files; {mend}")
    return document, manifest


def _what_is_there(folder: Path) -> str:
    """What is in the place of a dataset, and what to do about it, as the end of a message.

    What lies there may be logs that exist only once, so the message never says just to remove them.
    """
    missing = f" ({MANIFEST} is missing)"
    how = f"import logs with `mgpo data import {folder} --out FOLDER`, and give that FOLDER"
    if not folder.exists():
        return ": there is no such folder; give the folder of a dataset, as `mgpo data import` makes it"
    if not folder.is_dir():
        return f": it is a file, and a dataset is a folder; {how}"
    mapped = all(
        (folder / f"{name}.npy").is_file() for name in ("actions", "lengths", "achieved_goals")
    )
    if (folder / ARRAYS).is_file() or mapped:
        return f"{missing}; if it is a damaged dataset, {mend_for(folder)}; if not, {how}"
    return f"{missing}, so it was not imported; {how}"


def hash_of_files(files: Mapping[str, str]) -> str:
    """The hash of a mapped dataset: SHA-256 of the lines ``HASH  NAME.npy`` in the order of the names."""
    lines = "".join(f"{files[name]}  {name}.npy\n" for name in sorted(files))
    return hashlib.sha256(lines.encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Facts about a dataset that training needs before it reads the data.

    Attributes:
      folder: the folder of the dataset.
      num_trajectories: N, the number of trajectories.
      num_steps: number of steps of all trajectories.
      longest: number of steps of the longest trajectory.
      obs_shape: shape of an observation.
      obs_dtype: dtype of an observation.
      goal_dim: size G of a goal.
      num_actions: number of discrete actions; None if actions are continuous.
      action_dim: ``num_actions``, or the size A of a continuous action.
      spec: the manifest's description of the world; if there is none, one derived from the arrays.
      env: the world that the data were collected in, if any.
    """

    folder: Path
    num_trajectories: int
    num_steps: int
    longest: int
    obs_shape: tuple[int, ...]
    obs_dtype: str
    goal_dim: int
    num_actions: int | None
    action_dim: int
    spec: SpecEntry
    env: str | None

    @property
    def mean_length(self) -> float:
        """Mean number of steps of a trajectory."""
        return self.num_steps / self.num_trajectories

    @property
    def obs_size(self) -> int:
        """Number of components of an observation."""
        return int(np.prod(self.obs_shape, dtype=np.int64))


def read_facts(folder: Path) -> Facts:
    """The facts about a dataset, without reading its observations.

    Raises:
      DataError: if the dataset is missing, or the files that are read are damaged.
    """
    folder = Path(folder)
    mend = mend_for(folder)
    document, manifest = read_manifest(folder)
    del document
    mapped = manifest.format == MAPPED
    headers = mapped_headers(folder, manifest.files, mend) if mapped else {}
    headers = headers or array_headers(folder / ARRAYS, mend)
    goals = headers.get("achieved_goals") or headers.get("goals")
    fields = {"lengths": ArrayField(("trajectory",), "int32", low=1)}
    sound = "obs" in headers and goals is not None and "actions" in headers
    if not sound or len(headers["obs"].shape) < 1 or len(goals.shape if goals else ()) != 2:
        raise DataError(f"{folder} lacks obs, actions or goals; {mend}")
    assert goals is not None
    actions = headers["actions"]
    discrete = actions.dtype.kind in "iu"
    known = manifest.spec.num_actions if manifest.spec else None
    if discrete and known is None:
        fields["actions"] = ArrayField(("step",), "int32", low=0)
    if mapped:
        arrays = mapped_arrays(folder, fields, {}, mend)
    else:
        arrays = read_arrays(folder / ARRAYS, fields, mend=mend)
    lengths = arrays["lengths"]
    if discrete and known is None:
        known = 1 + int(arrays["actions"].max(initial=0))
    longest = int(lengths.max(initial=1))
    spec = manifest.spec or SpecEntry(
        name=manifest.env or "data", horizon=longest, num_actions=known if discrete else None
    )
    return Facts(
        folder=folder,
        num_trajectories=len(lengths),
        num_steps=int(lengths.sum(dtype=np.int64)),
        longest=longest,
        obs_shape=headers["obs"].shape[1:],
        obs_dtype=str(headers["obs"].dtype),
        goal_dim=goals.shape[1],
        num_actions=known if discrete else None,
        action_dim=known if discrete and known else _size(actions),
        spec=spec,
        env=manifest.env,
    )


def _size(actions: ArrayHeader) -> int:
    return actions.shape[1] if len(actions.shape) == 2 else 1
