"""``--config FILE``: take settings from the ``config.json`` of a run, as words of a command line.

Flags that the user typed take precedence. The added words are parsed and checked like typed ones.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from envs.errors import DataError, UsageError, shown
from experiments.joining import OF_PROCESSES
from mgpo_jax.schema import Json, read_document
from mgpo_jax.settings import aliases_of, flag, flag_off, is_settings

OWN = frozenset({"config", "debug", "dry_run", "json", "out", "quiet", "resume", *OF_PROCESSES})
"""Settings that belong to a single call of a command and are not taken from a file."""
GROUPS = frozenset({"data", "train", "hyper"})
"""Nested settings in ``config.json``; each of their members has a flag."""
IMPORTED = frozenset({"env", "method", "goal"})
"""Settings that can name a module to import, as ``module:attribute``."""
OF_POLICIES = frozenset({"network", "sha256"})
"""Entries of the ``config.json`` of every policy, which no run has."""
CONFIG, MEND = "config.json", "give the config.json of a run"
CHOOSER = {"hyper": "method"}
"""Groups to skip if a setting is typed: a method's hyper-parameters if the user names a method."""


def expanded(words: Sequence[str], config_class: type) -> list[str]:
    """Append the settings of the file that ``--config`` names to a command line.

    Args:
      words: the words that were typed.
      config_class: the dataclass of the command's settings, for the aliases of its flags.

    Raises:
      UsageError: if ``--config`` has no value, or the file names code that the command line does not name.
      DataError: if the file is damaged or holds no settings.
    """
    typed = list(itertools.takewhile(lambda word: word != "--", words))
    path = _file_in(typed)
    if path is None:
        return list(words)
    names = _names(config_class)
    given = {names.get(name, name) for name in map(_name_of, typed) if name}
    values = _read(path)
    added = []
    for name, value in _settings(values, given):
        _check_setting(name, value, names.get(name, name))
        added += _words(name, value)
    return [*typed, *added, *words[len(typed) :]]


def _read(path: Path) -> dict[str, Json]:
    """The entries of the file that ``--config`` names.

    Raises:
      UsageError: if it is a folder, or the config of a policy.
      DataError: if it is missing, damaged or no JSON object.
    """
    if os.path.isdir(path):  # which, unlike Path.is_dir, also takes names that are too long
        inside = path / CONFIG
        mend = f"give {inside}" if inside.is_file() else MEND
        raise UsageError(f"--config {path} must be a file, found a folder; {mend}")
    values: dict[str, Json] = read_document(path, dict[str, Json], MEND)
    if values.keys() >= OF_POLICIES:
        raise UsageError(
            f"--config {path} must hold the settings of a run, found those of a policy; {MEND}, which is "
            "usually one folder above its policy"
        )
    return values


def _file_in(words: Sequence[str]) -> Path | None:
    for word, following in itertools.zip_longest(words, words[1:]):
        if _name_of(word) != "config":
            continue
        _, sign, value = word.partition("=")
        found = value if sign else following
        if not found or (not sign and found.startswith("--")):
            raise UsageError("--config needs a value: the config.json of a run")
        return Path(found)
    return None


def _name_of(word: str) -> str:
    """The setting that a flag sets, such as ``figures`` for ``--no-figures``; empty for other words."""
    if not word.startswith("--"):
        return ""
    name = word.partition("=")[0].removeprefix("--").replace("-", "_")
    return name.removeprefix("no_")


def _names(config_class: type) -> dict[str, str]:
    """The aliases of settings, mapped to the settings."""
    found: dict[str, str] = {}
    config: Any = config_class()
    for field in dataclasses.fields(config):
        if is_settings(getattr(config, field.name)):
            found |= _names(type(getattr(config, field.name)))
        for alias in aliases_of(config_class, field.name):
            found[_name_of(alias)] = field.name
    return found


def _settings(
    values: Mapping[str, Any], given: set[str], group: str = ""
) -> Iterator[tuple[str, Any]]:
    """The settings in the file that were not typed, including those in groups.

    A setting without a value (null) is left at its default, which is None. Only a hyper-parameter may have
    another default, so None is given for it like any other value.
    """
    for name, value in values.items():
        if name in GROUPS and isinstance(value, Mapping):
            if CHOOSER.get(name) not in given:
                yield from _settings(value, given, name)
        elif name not in OWN and name not in given and (value is not None or group == "hyper"):
            if isinstance(value, Mapping):
                raise DataError(
                    f"the setting {shown(name)} in the config file must be a single value, found an "
                    "object; remove it from the file"
                )
            yield name, value


def _check_setting(name: str, value: Any, setting: str) -> None:
    """Check a setting of the file before it becomes words of a command line.

    Args:
      name: its name in the file, which may be an alias.
      value: its value.
      setting: the name of the setting.

    Raises:
      DataError: if the name or the value could be taken for something else.
      UsageError: if it names code of the user's own.
    """
    members = value if isinstance(value, list) else [value]
    if not name.isidentifier():
        raise DataError(f"{shown(name)} in the config file is not the name of a setting; remove it")
    for member in members:
        if isinstance(value, list) and str(member).startswith("--"):
            raise DataError(
                f"the setting {shown(name)} in the config file holds {shown(member)}, which is a flag; "
                "remove it"
            )
        if setting in IMPORTED and ":" in str(member):
            raise UsageError(
                f"the config file names the code {shown(member)}, and a file never decides what is "
                f"imported; if you trust it, add {flag(setting)} with this value"
            )


def _words(name: str, value: Any) -> list[str]:
    """A setting as words of a command line."""
    if isinstance(value, bool):
        return [flag(name) if value else flag_off(name)]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [flag(name), *map(str, value)] if value else []
    return [f"{flag(name)}={value}"]
