"""Settings of ``experiments.data``, for importing, exporting and checking datasets. Nothing imports jax."""

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
    """Settings of ``experiments.data`` itself, without a subcommand."""

    what: tyro.conf.Positional[str] = ""
    """The subcommand: import (convert logs to a dataset), export (write a dataset in another format), check
    (find faults in a dataset) or info (describe a dataset); each has its own --help."""


@dataclass(frozen=True, kw_only=True)
class ImportConfig(Common):
    """Settings of ``experiments.data import``."""

    source: tyro.conf.Positional[str] = ""
    """The logs: a Minari dataset (folder or id), an HDF5 file with flat arrays in D4RL's format, an npz
    file with the same arrays, or a folder with one npz or parquet file per episode."""
    out: Path | None = None
    """Output folder; must not exist yet."""
    goal: Name | None = None
    """A function, as module:function, that maps observations [T+1, ...] to achieved goals [T+1, G]; it gets
    the whole episode if its parameter is called ``episode``."""
    goal_columns: tuple[Index, ...] = ()
    """Indices of the observation components that form the achieved goal, counted from 0."""
    goal_array: Name | None = None
    """Name of the array that holds an achieved goal for every observation, such as achieved_goal."""
    obs_arrays: tuple[Name, ...] = ()
    """Names of the arrays that are concatenated to the observation (default: observations)."""
    reached: Literal["always", "changes"] = "always"
    """When a goal counts as reached: at every step (suits positions), or when it differs from the previous
    one (suits subtasks)."""
    action_low: tuple[Number, ...] = ()
    """Lower bounds of the actions, one for all components or one for each; they are scaled to -1."""
    action_high: tuple[Number, ...] = ()
    """Upper bounds of the actions, likewise; they are scaled to 1."""
    num_actions: Count | None = None
    """Number of discrete actions (default: from the source, or the largest action in it plus 1)."""
    horizon: Count | None = None
    """Steps after which an episode is truncated (default: from the source, or its longest episode)."""
    cut: bool = True
    """Whether any prefix of a trajectory demonstrates how to reach the goal achieved at its end."""
    skip_bad: bool = False
    """Skip episodes that contain NaN or infinity, or that are longer than the horizon."""
    name: Name | None = None
    """Name of the world that the logs are from, for messages (default: the name of the source)."""


@dataclass(frozen=True, kw_only=True)
class ExportConfig(Common):
    """Settings of ``experiments.data export``."""

    folder: tyro.conf.Positional[Path | None] = None
    """Folder of a dataset."""
    out: Path | None = None
    """Output npz file, or output folder of a Minari dataset; must not exist yet."""
    author: str = ""
    """Author in the metadata of a Minari dataset."""


@dataclass(frozen=True, kw_only=True)
class CheckDataConfig(Common):
    """Settings of ``experiments.data check``."""

    folder: tyro.conf.Positional[Path | None] = None
    """Folder of a dataset."""
    env: Name | None = None
    """The world that the dataset must fit (default: any)."""
    horizon: Count | None = None
    """Steps after which an episode is truncated (default: the world's, or the manifest's)."""
    most: Count = 5
    """Maximum number of findings of each kind to print; the rest are only counted."""
    json: bool = False
    """Print the findings as JSON."""


@dataclass(frozen=True, kw_only=True)
class InfoConfig(Common):
    """Settings of ``experiments.data info``."""

    folder: tyro.conf.Positional[Path | None] = None
    """Folder of a dataset."""
    json: bool = False
    """Print the description as JSON."""


SUBCOMMANDS: dict[str, Any] = {
    "import": ImportConfig,
    "export": ExportConfig,
    "check": CheckDataConfig,
    "info": InfoConfig,
}


def check_import(config: ImportConfig) -> None:
    """Raise ``UsageError`` for import settings that are missing or contradict each other."""
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
            "--action-low and --action-high must have the same number of values, found "
            f"{_shown(low) or 'none'} and {_shown(high) or 'none'}"
        )
    if any(a >= b for a, b in zip(low, high, strict=True)):
        raise UsageError("--action-low must be below --action-high in every component")


def _shown(value: Any) -> str:
    """A name or numbers as they stood on the command line."""
    if isinstance(value, tuple):
        return " ".join(map(repr, value))
    return shown(value)


def require_folder(folder: Path | None, what: str) -> Path:
    """The folder of a dataset, checked.

    Args:
      folder: the folder that the user gave, if any.
      what: the subcommand, for the usage line.

    Raises:
      UsageError: if no folder was given, or it does not exist.
    """
    if folder is None:
        raise UsageError(f"no dataset given; usage: python -m experiments.data {what} FOLDER")
    if not folder.is_dir():
        raise UsageError(f"there is no folder {folder}; give the folder of a dataset")
    return folder
