"""Figures of adaptations as files."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np

import envs
from envs.base import Episode
from envs.errors import UsageError
from envs.registry import World
from experiments.figures import (
    STYLE,
    Play,
    Save,
    figures_of_results,
    figures_of_run,
    learning_curve,
)
from experiments.store.policies import load_policy_of
from experiments.store.results import Results
from experiments.store.settings import file_name
from mgpo_jax.prompts import prompt_of
from mgpo_jax.rollout import Query
from mgpo_jax.runner import play


def draw_run(world: World, results: Results, folder: Path) -> None:
    """Draw into the folder of one adaptation what needs no policy."""
    write(
        folder / "learning_curve.png",
        learning_curve({results.method: results}, results.env).savefig,
    )
    if world.pictures is None:
        return
    pictures = world.pictures(envs.make(results.env))
    for name, save in figures_of_run(pictures, results, results.most_improved()):
        write(folder / name, save)


def draw_together(
    results: Mapping[str, Results], out: Path, tasks: Sequence[int], seed: int
) -> None:
    """Draw every figure of some adaptations to the same tasks of one world."""
    first = next(iter(results.values()))
    prefix = file_name(first.env)
    write(out / f"{prefix}_learning_curve.png", learning_curve(results, first.env).savefig)
    world = envs.find(first.env)
    if world.pictures is None:
        return
    pictures = world.pictures(envs.make(first.env))
    which = tasks or first.most_improved()
    for name, save in figures_of_results(pictures, results, player_of, which, seed):
        write(out / f"{prefix}_{name}", save)


def player_of(results: Results) -> Play:
    """Who plays episodes under prompts: the policy that an adaptation was made with."""
    world, env = envs.find(results.env), envs.make(results.env)
    policy = load_policy_of(results, world)

    def play_goals(key: jax.Array, task: Any, goals: np.ndarray, num: int, greedy: bool) -> Episode:
        prompt = prompt_of(goals, policy.config.max_prompt_length)
        query = Query(prompt, jnp.asarray(greedy))
        return play(key, env, policy, jax.tree.map(jnp.asarray, task), query, num)

    return play_goals


def labeled(folders: Mapping[Path, Results]) -> dict[str, Results]:
    """Results by method name, and folder where one method ran more than once."""
    methods = [result.method for result in folders.values()]
    labels = [
        method if methods.count(method) == 1 else f"{method} ({folder})"
        for method, folder in zip(methods, folders, strict=True)
    ]
    return dict(zip(labels, folders.values(), strict=True))


def by_world(
    folders: Sequence[Path], load: Callable[[Path], Results]
) -> Iterator[dict[Path, Results]]:
    """The results in some folders, world by world."""
    found: dict[str, dict[Path, Results]] = {}
    for folder in dict.fromkeys(folders):
        result = load(folder)
        found.setdefault(result.env, {})[folder] = result
    yield from found.values()


def check_together(folders: Mapping[Path, Results], tasks: Sequence[int], seed: int) -> None:
    """Raise ``UsageError`` for runs that no figure can compare, or that lack what is asked for."""
    first_folder, first = next(iter(folders.items()))
    for folder, result in folders.items():
        same = result.tasks.keys() == first.tasks.keys() and all(
            np.array_equal(array, first.tasks[name]) for name, array in result.tasks.items()
        )
        if not same:
            raise UsageError(
                f"{folder} and {first_folder} ran on different tasks; plot them one at a time"
            )
        if not 0 <= seed < len(result.returns):
            raise UsageError(f"--seed {seed}: {folder} has {len(result.returns)} seeds")
    num = first.returns.shape[1]
    if not all(0 <= index < num for index in tasks):
        raise UsageError(f"--tasks: {first.env} has the tasks 0 to {num - 1}")


def write(path: Path, save: Save) -> None:
    """Write one picture and say where it is."""
    with mpl.rc_context(STYLE):
        save(path)
    print(path, file=sys.stderr)
