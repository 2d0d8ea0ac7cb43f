"""Draw figures of adaptations and write them to files."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np

import envs
from envs.base import Episode
from envs.errors import UsageError, printable
from envs.registry import Judgement, World
from experiments.figures import (
    STYLE,
    Play,
    Save,
    figures_of_results,
    figures_of_run,
    later,
    learning_curve,
)
from experiments.store.policies import load_policy_of
from experiments.store.results import Results
from experiments.store.seals import is_foreign, write_sealed
from experiments.store.settings import file_name
from experiments.store.statistics import same_tasks
from mgpo_jax.judging import play
from mgpo_jax.optimizers.methods import judged_query
from mgpo_jax.prompts import prompt_of

EXPLORING = Judgement(mode="sample")
"""With exploratory actions of the policy's own distribution, for figures of where episodes go."""
Picture = tuple[str, Save]
"""A file name, and a function that writes the file."""


def draw_run(world: World, results: Results, folder: Path) -> None:
    """Draw the figures of one adaptation that need no policy into its folder.

    A file that was changed, or was not written by a command, is kept, with a line on stderr.
    """
    curve = later(learning_curve, {results.method: results}, _title_of(world))
    drawn = [("learning_curve.png", curve)]
    if world.pictures is not None:
        pictures = world.pictures(envs.make(results.env))
        drawn += figures_of_run(pictures, results, results.most_improved())
    for name, save in drawn:
        if not is_kept(folder / name):
            write(folder / name, save)


def _title_of(world: World) -> str:
    """The name of a world and what it is."""
    return f"{world.name}: {world.summary}" if world.summary else world.name


def is_kept(path: Path) -> bool:
    """Whether a file must stay, since it was changed or not written by a command; reports it on stderr."""
    if not is_foreign(path):
        return False
    print(
        f"{printable(str(path))} is kept: it was changed, or not written by this command; move it away to "
        "draw it anew",
        file=sys.stderr,
    )
    return True


def pictures_together(
    results: Mapping[str, Results], tasks: Sequence[int], seed: int, policy: Path | None = None
) -> list[Picture]:
    """The figures of some adaptations to the same tasks of one world, not drawn yet.

    Everything that drawing needs is loaded when this returns: the world, its pictures, and the policies.

    Args:
      results: adaptations by their labels in legends.
      tasks: indices of the tasks to draw (empty: those that the first adaptation improved most).
      seed: index of the seed to draw.
      policy: folder of the policy of all adaptations (default: the one that the results name).
    """
    first = next(iter(results.values()))
    world = envs.find(first.env)
    drawn = [("learning_curve.png", later(learning_curve, results, _title_of(world)))]
    if world.pictures is not None:
        pictures = world.pictures(envs.make(first.env))
        for result in results.values():
            result.task_set  # noqa: B018 (loads and checks the tasks before anything is written)
        which = tasks or first.most_improved()
        players = partial(player_of, policy_folder=policy)
        drawn += figures_of_results(pictures, results, players, which, seed)
    return [(f"{file_name(first.env)}_{name}", save) for name, save in drawn]


def player_of(results: Results, policy_folder: Path | None = None) -> Play:
    """A function that runs episodes under prompts, with the policy that an adaptation was made with.

    Episodes that show how good a prompt is are played in the way in which returns are measured. In a world
    whose policies are judged by sampled actions, a greedy episode would not be what the tables tell of.

    Args:
      results: an adaptation.
      policy_folder: folder of its policy (default: the one that the results name).

    Raises:
      DataError: if the policy is not found, or is not the one that the prompts were found with.
    """
    world, env = envs.find(results.env), results.environment
    policy = load_policy_of(results, world, policy_folder)

    def play_goals(key: jax.Array, task: Any, goals: np.ndarray, num: int, judged: bool) -> Episode:
        prompt = prompt_of(goals, policy.config.max_prompt_length)
        query = judged_query(prompt, world.judged if judged else EXPLORING)
        return play(key, env, policy, jax.tree.map(jnp.asarray, task), query, num)

    return play_goals


def labeled(folders: Mapping[Path, Results]) -> dict[str, Results]:
    """Results by label: the method's name, with the folder if several results are of the same method."""
    methods = [result.method for result in folders.values()]
    labels = [
        method if methods.count(method) == 1 else f"{method} ({folder})"
        for method, folder in zip(methods, folders, strict=True)
    ]
    return dict(zip(labels, folders.values(), strict=True))


def by_world(
    folders: Sequence[Path], load: Callable[[Path], Results]
) -> Iterator[dict[Path, Results]]:
    """Load results and group them by world."""
    found: dict[str, dict[Path, Results]] = {}
    for folder in dict.fromkeys(folders):
        result = load(folder)
        found.setdefault(result.env, {})[folder] = result
    yield from found.values()


def check_together(folders: Mapping[Path, Results], tasks: Sequence[int], seed: int) -> None:
    """Raise ``UsageError`` for runs on different tasks, or without the requested task or seed."""
    first_folder, first = next(iter(folders.items()))
    for folder, result in folders.items():
        if not same_tasks(result, first):
            raise UsageError(
                f"{folder} and {first_folder} ran on different tasks; plot them one at a time"
            )
        if not 0 <= seed < len(result.returns):
            raise UsageError(
                f"--seed {seed} must be from 0 to {len(result.returns) - 1}, the seeds in {folder}; "
                "choose another"
            )
    num = first.returns.shape[1]
    for index in tasks:
        if not 0 <= index < num:
            raise UsageError(
                f"--tasks {index} must be from 0 to {num - 1}, the tasks of {first_folder}; choose others"
            )


def write(path: Path, save: Save) -> None:
    """Write a picture atomically, and print its path on stderr."""
    with mpl.rc_context(STYLE), warnings.catch_warnings():
        # Characters that the font lacks are drawn as boxes.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        write_sealed(path, save)
    print(printable(str(path)), file=sys.stderr)
