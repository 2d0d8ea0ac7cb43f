"""Draw figures from adaptation results: ``python -m experiments.plot RUN_DIR [RUN_DIR ...]``."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import jax
import matplotlib as mpl
import numpy as np
import tyro
from matplotlib.figure import Figure

from envs.render import maze_gif
from experiments.figures import (
    STYLE,
    evolution,
    goals_of,
    learning_curve,
    positions_of,
    prompts_on_mazes,
    run_policy,
    short_and_long,
    start_of,
    task_at,
)
from experiments.results import Results, load_results
from experiments.runtime import Common, run
from mgpo_jax.errors import UsageError


@dataclass(frozen=True)
class PlotConfig(Common):
    """Settings of ``experiments.plot``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of adaptations; those of one world share its figures."""
    out: Path = Path("figures")
    """Folder to write."""
    tasks: tuple[int, ...] = ()
    """Tasks to draw on mazes, counted from 0 (default: the four that the first run improved most)."""
    seed: int = 0
    """Which seed of the adaptations to draw on mazes, counted from 0."""


def main(config: PlotConfig) -> None:
    """Draw every figure that the results of some adaptations allow."""
    if not config.runs:
        raise UsageError("no result folder given; usage: python -m experiments.plot RUN_DIR ...")
    by_env: dict[str, dict[Path, Results]] = {}
    for folder in dict.fromkeys(config.runs):
        result = load_results(folder)
        by_env.setdefault(result.config["env"], {})[folder] = result
    for folders in by_env.values():
        _check_together(config, folders)

    config.out.mkdir(parents=True, exist_ok=True)
    for env_name, folders in by_env.items():
        results = label_runs(folders)
        _save(learning_curve(results, env_name), config.out / f"{env_name}_learning_curve.png")
        if "maze" in next(iter(results.values())).tasks:
            _draw_mazes(config, env_name, results)


def draw_run(folder: Path) -> None:
    """Draw into the folder of one adaptation what needs no policy."""
    result = load_results(folder)
    results = {result.config["bandit"]: result}
    _save(learning_curve(results, result.config["env"]), folder / "learning_curve.png")
    if "maze" in result.tasks:
        which = result.most_improved()
        _save(prompts_on_mazes(results, result.tasks, which), folder / "prompts.png")


def label_runs(folders: Mapping[Path, Results]) -> dict[str, Results]:
    """Results by method name, and folder where one method ran more than once."""
    methods = [result.config["bandit"] for result in folders.values()]
    labels = [
        method if methods.count(method) == 1 else f"{method} ({folder})"
        for method, folder in zip(methods, folders, strict=True)
    ]
    return dict(zip(labels, folders.values(), strict=True))


def _check_together(config: PlotConfig, folders: Mapping[Path, Results]) -> None:
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
        if not 0 <= config.seed < len(result.returns):
            raise UsageError(f"--seed {config.seed}: {folder} has {len(result.returns)} seeds")


def _draw_mazes(config: PlotConfig, env_name: str, results: Mapping[str, Results]) -> None:
    """Figures 2, 3, 9 and 10, and a GIF of the first task under the optimized prompt."""
    from experiments.policies import load_policy

    out, seed = config.out, config.seed
    first = next(iter(results.values()))
    tasks, which = first.tasks, list(config.tasks) or first.most_improved()
    if not all(0 <= index < len(tasks["maze"]) for index in which):
        raise UsageError(f"--tasks: {env_name} has the tasks 0 to {len(tasks['maze']) - 1}")
    _save(prompts_on_mazes(results, tasks, which, seed), out / f"{env_name}_prompts.png")

    chosen = {name: array[which] for name, array in tasks.items()}
    key = jax.random.key(seed)
    drawn: set[str] = set()
    for number, result in enumerate(results.values()):
        path = result.config.get("policy")
        env, policy = load_policy(env_name, path and Path(path))
        method = result.config["bandit"]
        name = f"{env_name}_{method}" + (f"_{number}" if method in drawn else "")
        if not drawn:
            _save(short_and_long(env, policy, chosen, key), out / f"{env_name}_short_and_long.png")
        drawn.add(method)
        for task in which:
            figure = evolution(env, policy, result, task, seed, key=key)
            _save(figure, out / f"{name}_evolution_task{task}.png")

        task, maze = which[0], tasks["maze"][which[0]]
        prompt = result.best_prompt(seed, task)
        episode = run_policy(key, env, policy, task_at(tasks, task), prompt, greedy=True)
        walk = positions_of(episode, len(maze))[0]
        gif = out / f"{name}_episode_task{task}.gif"
        maze_gif(gif, maze, start_of(maze), tasks["goal"][task], walk, goals_of(prompt))
        print(gif, file=sys.stderr)


def _save(figure: Figure, path: Path) -> None:
    with mpl.rc_context(STYLE):
        figure.savefig(path)
    print(path, file=sys.stderr)


if __name__ == "__main__":
    run(PlotConfig, main)
