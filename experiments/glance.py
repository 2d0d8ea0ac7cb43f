"""The worlds at a glance (Figure 11): a panel for each world, with a task and its agent."""

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
from experiments.demonstrators import find_demonstrator
from experiments.drawing import write
from experiments.figures import Glance, at_a_glance, later, look_of
from experiments.store.reproduce_settings import ReproduceConfig
from experiments.store.seals import check_replaceable

SEED = 0


def glance_of(world: World, others: Sequence[str] = ()) -> Glance:
    """The panel of a world: a task, with an episode of the first demonstrator where the world draws one.

    Args:
      world: the world.
      others: names of worlds that look the same.

    Raises:
      ImportError: if packages that the world needs are missing.
      UsageError: if it draws no still pictures.
    """
    env = world.make()
    if world.pictures is None:
        raise UsageError("the world draws no pictures")
    key = jax.random.key(SEED)
    task = jax.jit(env.sample_task)(key)
    goal = np.asarray(env.task_goal(task))
    draw = look_of(
        world.pictures(env),
        jax.tree.map(np.asarray, task),
        goal,
        start=lambda: np.asarray(jax.jit(env.reset)(key, task)[1].obs),
        play=partial(_play_episode, world, env, task),
    )
    if draw is None:
        raise UsageError("the world draws no still pictures, only videos")
    also = f" Also: {', '.join(others)}." if others else ""
    return Glance(world.name, f"{_sentence(world.summary)}{also}", draw)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}." if text else ""


def _play_episode(world: World, env: Environment, task: Task) -> Episode:
    """Run an episode of the world's first demonstrator; returns it with numpy leaves."""
    _, demonstrator = find_demonstrator(world, env, None)

    def episode(key: jax.Array, task: Task, weights: Any) -> Episode:
        return run_episode(key, env, demonstrator.agent(weights), task)

    program = jax.jit(episode, compiler_options=dict(env.engine.compiler_options))
    played = program(jax.random.key(SEED), task, demonstrator.weights)
    return jax.tree.map(np.asarray, played)


def worlds_together(names: Sequence[str]) -> list[tuple[World, list[str]]]:
    """Group worlds that share their tasks and looks: the first of each group, and the names of the others.

    A world that cannot be imported is left out, with a line on stderr.
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
    print(f"skipping {printable(name)}: {printable(str(error))}", file=sys.stderr)


def file_of(config: ReproduceConfig) -> Path:
    """The file that the picture is written to."""
    return config.out / "figure11.png"


def draw(config: ReproduceConfig) -> Path:
    """Draw the worlds of ``--env``, or all that are installed; returns the file.

    Raises:
      UsageError: if none of them can be drawn, or the file exists and was not written by a command.
    """
    place = file_of(config)
    check_replaceable([place])
    glances = []
    for world, others in worlds_together(config.env or WORLDS.names()):
        try:
            glances.append(glance_of(world, others))
        except (UsageError, ImportError) as error:  # a package, or OpenGL, is missing
            _say_left_out(world.name, error)
    if not glances:
        raise UsageError("there is no figure11: none of the worlds can be drawn")
    config.out.mkdir(parents=True, exist_ok=True)
    write(place, later(at_a_glance, glances))
    return place
