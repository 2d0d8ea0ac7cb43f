"""Settings of ``experiments.data``: what is imported from where, and what its goals are. No jax."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from annotated_types import Ge, Le

from envs.errors import UsageError, shown
from experiments.runtime import Common
from mgpo_jax.schema import Name as WorldName
from mgpo_jax.settings import Count, Index, Name, setting_fault

Number = Annotated[float, Ge(-1e18), Le(1e18)]


@dataclass(frozen=True)
class DataCommandConfig(Common):
    """Settings of ``experiments.data`` without a command."""

    what: tyro.conf.Positional[str] = ""
    """import (logs become a dataset), export (a dataset becomes logs), check (what is wrong with a dataset)
    or info (what is in it); each has --help of its own."""


@dataclass(frozen=True, kw_only=True)
class ImportConfig(Common):
    """Settings of ``experiments.data import``."""

    source: tyro.conf.Positional[str] = ""
    """A Minari dataset (its folder or its id), an HDF5 file with flat arrays as D4RL has them, an npz file
    with the same arrays, or a folder with an npz or parquet file for each episode."""
    out: Path | None = None
    """Folder to write; it must not exist."""
    goal: Name | None = None
    """The function, as module:function, that tells achieved goals [T+1, G] of observations [T+1, ...], or
    of a whole episode if its parameter is called ``episode``."""
    goal_columns: tuple[Index, ...] = ()
    """Numbers of the components of an observation that are the achieved goal, counted from 0."""
    goal_array: Name | None = None
    """Name of the array with an achieved goal for every observation, such as achieved_goal."""
    obs_arrays: tuple[Name, ...] = ()
    """Names of the arrays that are the observation, one after the other (default: observations)."""
    reached: Literal["always", "changes"] = "always"
    """When a goal counts as reached: at every step, as positions do, or where it differs from the one
    before, as subtasks do."""
    action_low: tuple[Number, ...] = ()
    """Smallest actions, one number for all components or one for each; they become -1."""
    action_high: tuple[Number, ...] = ()
    """Largest actions, likewise; they become 1."""
    num_actions: Count | None = None
    """Number of discrete actions (default: what the source says, or the largest in it plus 1)."""
    horizon: Count | None = None
    """Steps after which an episode is cut off (default: what the source says, or the longest in it)."""
    cut: bool = True
    """Whether a trajectory that is cut at any step shows how to reach another goal."""
    skip_bad: bool = False
    """Leave episodes out that hold NaN or infinity, or are longer than the horizon."""
    name: Name | None = None
    """What messages call the world that the logs are from (default: the name of the source)."""


@dataclass(frozen=True, kw_only=True)
class ExportConfig(Common):
    """Settings of ``experiments.data export``."""

    folder: tyro.conf.Positional[Path | None] = None
    """Folder of a dataset."""
    out: Path | None = None
    """An npz file, or a folder for a Minari dataset, to write; it must not exist."""
    author: str = ""
    """Who made it, for the metadata of a Minari dataset."""


@dataclass(frozen=True, kw_only=True)
class CheckDataConfig(Common):
    """Settings of ``experiments.data check``."""

    folder: tyro.conf.Positional[Path | None] = None
    """Folder of a dataset."""
    env: Name | None = None
    """The world that it must fit (default: any)."""
    horizon: Count | None = None
    """Steps after which an episode is cut off (default: that of the world, or of the manifest)."""
    most: Count = 5
    """Findings of one kind that are printed; the others are counted."""


@dataclass(frozen=True, kw_only=True)
class InfoConfig(Common):
    """Settings of ``experiments.data info``."""

    folder: tyro.conf.Positional[Path | None] = None
    """Folder of a dataset."""


SUBCOMMANDS: dict[str, Any] = {
    "import": ImportConfig,
    "export": ExportConfig,
    "check": CheckDataConfig,
    "info": InfoConfig,
}


def check_import(config: ImportConfig) -> None:
    """Raise ``UsageError`` for settings of an import that do not go together."""
    if not config.source:
        raise UsageError(
            "nothing to import; usage: python -m experiments.data import SOURCE --out FOLDER"
        )
    if config.out is None:
        raise UsageError("--out is missing; give the folder of the dataset to make")
    ways = {
        "--goal": config.goal,
        "--goal-columns": config.goal_columns,
        "--goal-array": config.goal_array,
    }
    given = [f"{flag} {_shown(value)}" for flag, value in ways.items() if value]
    if len(given) > 1:
        raise UsageError(
            f"{given[0]} and {given[1]} both say what a goal is; leave one of them out"
        )
    if config.name is not None and setting_fault(WorldName, config.name):
        raise UsageError(
            f"--name must have letters, digits, hyphens, dots and underscores, found {shown(config.name)}"
        )
    if config.goal is not None and ":" not in config.goal:
        raise UsageError(
            f"--goal must name a function as module:function, found {shown(config.goal)}; give "
            "the module, too"
        )
    if len(set(config.goal_columns)) < len(config.goal_columns):
        raise UsageError("--goal-columns names a component twice; leave one of them out")
    low, high = config.action_low, config.action_high
    if len(low) != len(high):
        raise UsageError(
            f"--action-low and --action-high must have as many numbers, found {_shown(low) or 'none'} and "
            f"{_shown(high) or 'none'}"
        )
    if any(a >= b for a, b in zip(low, high, strict=True)):
        raise UsageError("--action-low must be below --action-high in every component")


def _shown(value: Any) -> str:
    """A name, or numbers, as they were given."""
    if isinstance(value, tuple):
        return " ".join(map(repr, value))
    return shown(value)


def require_folder(folder: Path | None, what: str) -> Path:
    """The folder of a dataset that a command was given.

    Raises:
      UsageError: if it was given none, or there is none.
    """
    if folder is None:
        raise UsageError(f"no dataset given; usage: python -m experiments.data {what} FOLDER")
    if not folder.is_dir():
        raise UsageError(f"there is no folder {folder}; give the folder of a dataset")
    return folder
