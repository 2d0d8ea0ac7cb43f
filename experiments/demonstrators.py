"""Demonstrators of a world by name, with settings that a command line changes."""

from __future__ import annotations

from collections.abc import Sequence

from envs.agents import Demonstrator
from envs.base import Environment
from envs.errors import UsageError, nearest, shown
from envs.registry import World


def find_demonstrator(world: World, env: Environment, name: str | None) -> tuple[str, Demonstrator]:
    """Find a demonstrator of a world.

    Args:
      world: the world's record.
      env: its environment.
      name: name of the demonstrator, followed by settings to change, as in ``expert,drop=0.3,shuffle=1``;
        None for the world's first demonstrator.

    Returns:
      The demonstrator's full name, and the demonstrator.

    Raises:
      UsageError: if the world has no demonstrators, none of that name, or none with these settings.
    """
    known = world.demonstrators(env)
    if not known:
        raise UsageError(
            f"{world.name} has no demonstrators, so no dataset can be collected; train on one of your own "
            "with pretrain --data FOLDER"
        )
    name, *changes = (name or next(iter(known))).split(",")
    if name not in known:
        raise nearest(name, known, "demonstrator")
    return _configured(name, known[name], changes) if changes else (name, known[name])


def _configured(
    name: str, demonstrator: Demonstrator, changes: Sequence[str]
) -> tuple[str, Demonstrator]:
    """Change settings of a demonstrator, written as ``name=number``; returns its new name, and itself."""
    if demonstrator.configured is None:
        raise UsageError(
            f"the demonstrator {name} has no settings to change; leave out {changes[0]!r}"
        )
    known, values = dict(demonstrator.settings), {}
    for change in changes:
        setting, _, text = change.partition("=")
        if setting not in known:
            raise nearest(setting, known, f"setting of the demonstrator {name}")
        if setting in values:
            raise UsageError(f"the setting {setting} of the demonstrator {name} is given twice")
        try:
            values[setting] = float(text)
        except ValueError:
            raise UsageError(
                f"the setting {setting} of the demonstrator {name} must be a number, found {shown(text)}; "
                f"write it as {setting}={known[setting]:g}"
            ) from None
    values = {setting: value for setting, value in values.items() if value != known[setting]}
    try:
        changed = demonstrator.configured(values)
    except ValueError as error:
        raise UsageError(f"demonstrator {name}: {error}") from None
    written = [f"{setting}={values[setting]:.12g}" for setting in sorted(values)]
    return ",".join([name, *written]), changed
