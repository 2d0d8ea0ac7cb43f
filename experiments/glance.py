"""The worlds at a glance (Figure 11): which worlds there are, a task of each, and who acts in it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

import envs
from envs.base import Environment, Episode, Task
from envs.episodes import run_episode
from envs.errors import UsageError, printable
from envs.registry import WORLDS, World
from experiments.datasets import find_demonstrator
from experiments.drawing import write
from experiments.figures import Glance, at_a_glance, later, look_of
from experiments.store.seals import check_replaceable
from experiments.store.settings import ReproduceConfig

SEED = 0


def glance_of(world: World, others: Sequence[str] = ()) -> Glance:
    """A world in one panel: its first task, with an episode of its first demonstrator where one is shown.

    Args:
      world: the world.
      others: names of worlds that look the same.

    Raises:
      UsageError: if it is not installed, or draws nothing that stands still.
    """
    env = envs.make(world.name)
    if world.pictures is None:
        raise UsageError("it draws nothing")
    key = jax.random.key(SEED)
    task = jax.jit(env.sample_task)(key)
    goal = np.asarray(env.task_goal(task))
    draw = look_of(
        world.pictures(env),
        jax.tree.map(np.asarray, task),
        goal,
        start=lambda: np.asarray(jax.jit(env.reset)(key, task)[1].obs),
        play=partial(_played, world, env, task),
    )
    if draw is None:
        raise UsageError("it draws nothing that stands still")
    also = f" Also: {', '.join(others)}." if others else ""
    return Glance(world.name, f"{_sentence(world.summary)}{also}", draw)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}." if text else ""


def _played(world: World, env: Environment, task: Task) -> Episode:
    """An episode of the world's first demonstrator, with numpy leaves."""
    _, demonstrator = find_demonstrator(world, env, None)

    def episode(key: jax.Array, task: Task, weights: Any) -> Episode:
        return run_episode(key, env, demonstrator.agent(weights), task)

    program = jax.jit(episode, compiler_options=dict(env.engine.compiler_options))
    played = program(jax.random.key(SEED), task, demonstrator.weights)
    return jax.tree.map(np.asarray, played)


def worlds_together(names: Sequence[str]) -> list[tuple[World, list[str]]]:
    """The worlds of some names, one of those that share tasks and looks, with the names of the others.

    A world that cannot be imported is left out with a line on stderr.
    """
    found: dict[str, tuple[World, list[str]]] = {}
    for name in names:
        try:
            world = envs.find(name)
        except UsageError as error:
            _say_left_out(name, error)
            continue
        if world.home in found:
            found[world.home][1].append(world.name)
        else:
            found[world.home] = (world, [])
    return list(found.values())


def _say_left_out(name: str, error: Exception) -> None:
    print(f"{printable(name)} is left out: {printable(str(error))}", file=sys.stderr)


def file_of(config: ReproduceConfig) -> Path:
    """Where the picture is written."""
    return config.out / "figure11.png"


def draw(config: ReproduceConfig) -> Path:
    """Draw the worlds at a glance, those of ``--env`` or all that are installed; returns the file.

    Raises:
      UsageError: if none of them can be drawn, or a file is there that no command wrote.
    """
    place = file_of(config)
    check_replaceable([place])
    glances = []
    for world, others in worlds_together(config.env or WORLDS.names()):
        try:
            glances.append(glance_of(world, others))
        except (UsageError, ImportError) as error:  # of packages that are missing, or of OpenGL
            _say_left_out(world.name, error)
    if not glances:
        raise UsageError("there is no figure11: none of the worlds can be drawn")
    config.out.mkdir(parents=True, exist_ok=True)
    write(place, later(at_a_glance, glances))
    return place
