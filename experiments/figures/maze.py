"""Figures of mazes, numbered as in the paper.

2 prompts on mazes, 3 and 10 how prompt and behavior evolve, 9 short and long prompts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from envs.base import Environment
from envs.maze_runner import MazeRunner, MazeTask
from envs.render import PROMPT_COLOR, bar_lanes, draw_maze, maze_gif, visit_norm, visit_scale
from experiments.figures.base import (
    STAGES,
    LoadPolicy,
    Pictures,
    Save,
    file_names,
    goals_of,
    run_policy,
)
from experiments.figures.style import method_styles, styled
from experiments.results import Results
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import sample_prompt, single_goal
from mgpo_jax.types import Episode, Prompt

PANEL = 1.9  # inches of one maze


def maze_pictures(env: MazeRunner) -> Pictures:
    """Figures 2, 3, 9 and 10, and a GIF of the first task under the optimized prompt."""
    return Pictures(draw_run, partial(draw_all, env))


def draw_run(result: Results, which: Sequence[int]) -> Iterator[tuple[str, Save]]:
    """The figure that needs no policy."""
    results = {result.config["bandit"]: result}
    yield "prompts.png", prompts_on_mazes(results, result.tasks, which).savefig


def draw_all(
    env: MazeRunner,
    results: Mapping[str, Results],
    load: LoadPolicy,
    which: Sequence[int],
    seed: int,
) -> Iterator[tuple[str, Save]]:
    """All figures of some adaptations."""
    tasks = next(iter(results.values())).tasks
    yield "prompts.png", prompts_on_mazes(results, tasks, which, seed).savefig

    chosen = {name: array[list(which)] for name, array in tasks.items()}
    key = jax.random.key(seed)
    for number, (name, result) in enumerate(file_names(results.values()).items()):
        policy = load(result)
        if number == 0:
            yield "short_and_long.png", short_and_long(env, policy, chosen, key).savefig
        for task in which:
            figure = evolution(env, policy, result, task, seed, key=key)
            yield f"{name}_evolution_task{task}.png", figure.savefig
        yield (
            f"{name}_episode_task{which[0]}.gif",
            episode(env, policy, result, which[0], seed, key),
        )


def episode(
    env: MazeRunner, policy: Policy, results: Results, task: int, seed: int, key: jax.Array
) -> Save:
    """A GIF of one greedy episode under the optimized prompt."""
    maze, goal = results.tasks["maze"][task], results.tasks["goal"][task]
    prompt = results.best_prompt(seed, task)
    episodes = run_policy(key, env, policy, task_at(results.tasks, task), prompt, greedy=True)
    walk = positions_of(episodes, len(maze))[0]
    return lambda path: maze_gif(path, maze, start_of(maze), goal, walk, goals_of(prompt))


@styled
def prompts_on_mazes(
    results: Mapping[str, Results],
    tasks: Mapping[str, np.ndarray],
    which: Sequence[int] = (0, 1, 2, 3),
    seed: int = 0,
) -> Figure:
    """Figure 2: the final prompt of each method, in its color, on a few tasks."""
    styles = method_styles(results)
    figure, axes = _maze_grid(1, len(which))
    prompts = [
        {
            color: goals_of(results[label].best_prompt(seed, index))
            for label, (_, color, *_) in styles.items()
        }
        for index in which
    ]
    _draw_tasks(axes[0], tasks, which, prompts, [None] * len(which))
    handles = [
        Line2D([], [], color=color, marker="o", linestyle="", markersize=6, label=name)
        for name, color, *_ in styles.values()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


@styled
def evolution(
    env: Environment,
    policy: Policy,
    results: Results,
    task: int,
    seed: int = 0,
    stages: Sequence[int] = STAGES,
    key: jax.Array | None = None,
) -> Figure:
    """Figures 3 and 10: the best prompt after some episodes, and where it leads the policy."""
    key = jax.random.key(0) if key is None else key
    stages = [stage for stage in stages if stage <= results.returns.shape[2]]
    prompts = [results.best_prompt(seed, task, stage) for stage in stages]
    runs = [run_policy(key, env, policy, task_at(results.tasks, task), p) for p in prompts]
    visits = [visit_counts(episodes, results.tasks["maze"][task]) for episodes in runs]

    figure, axes = _maze_grid(1, len(stages), colorbar=True)
    norm = visit_norm(*visits)
    goals = [{PROMPT_COLOR: goals_of(prompt)} for prompt in prompts]
    _draw_tasks(axes[0], results.tasks, [task] * len(stages), goals, visits, norm)
    for ax, stage, episodes in zip(axes[0], stages, runs, strict=True):
        ax.set_title(_title(stage, "episode", episodes))
    _visit_bar(figure, axes, norm)
    return figure


@styled
def short_and_long(
    env: Environment,
    policy: Policy,
    tasks: Mapping[str, np.ndarray],
    key: jax.Array | None = None,
) -> Figure:
    """Figure 9: behavior under the task goal alone, and under the longest prompts.

    Long prompts are drawn from the best of the trajectories above them.
    """
    num_tasks = len(tasks["maze"])
    keys = jax.random.split(jax.random.key(0) if key is None else key, (num_tasks, 3))
    pairs: list[tuple[Prompt, Episode]] = []  # short and long of each task in turn
    for index, (key_short, key_draw, key_long) in enumerate(keys):
        task = task_at(tasks, index)
        goal = env.task_goal(task)
        short = single_goal(goal, policy.num_slots)
        exploring = run_policy(key_short, env, policy, task, short)
        long = longest_prompt(key_draw, exploring, goal, policy.num_slots)
        exploiting = run_policy(key_long, env, policy, task, long)
        pairs += [(short, exploring), (long, exploiting)]

    figure, axes = _maze_grid(2, num_tasks, colorbar=True)
    flat, which = list(axes.T.flat), [index for index in range(num_tasks) for _ in range(2)]
    visits = [
        visit_counts(episodes, tasks["maze"][index])
        for index, (_, episodes) in zip(which, pairs, strict=True)
    ]
    norm = visit_norm(*visits)
    goals = [{PROMPT_COLOR: goals_of(prompt)} for prompt, _ in pairs]
    _draw_tasks(flat, tasks, which, goals, visits, norm)
    for ax, (prompt, episodes) in zip(flat, pairs, strict=True):
        ax.set_title(_title(int(prompt.mask.sum()), "goal", episodes))
    _visit_bar(figure, axes, norm)
    return figure


def positions_of(episode: Episode, side: int) -> list[np.ndarray]:
    """The cells after each step, ``[length, 2]`` for each of a batch of maze episodes."""
    cells = np.rint(np.asarray(episode.trajectory.goals) * side).astype(int)
    lengths = np.asarray(episode.trajectory.length)
    return [walk[:length] for walk, length in zip(cells, lengths, strict=True)]


def visit_counts(episode: Episode, maze: np.ndarray) -> np.ndarray:
    """Mean visits of each cell in one of a batch of maze episodes, the start included."""
    walks = positions_of(episode, len(maze))
    cells = np.concatenate([*walks, np.tile(start_of(maze), (len(walks), 1))])
    counts = np.zeros(maze.shape)
    np.add.at(counts, tuple(cells.T), 1.0)
    return counts / len(walks)


def start_of(maze: np.ndarray) -> tuple[int, int]:
    return MazeRunner(name="plot", side=len(maze), horizon=1).start


def task_at(tasks: Mapping[str, np.ndarray], index: int) -> MazeTask:
    return MazeTask(jnp.asarray(tasks["maze"][index]), jnp.asarray(tasks["goal"][index]))


def longest_prompt(
    key: jax.Array, episodes: Episode, goal: jax.Array, num_slots: int, num_draws: int = 64
) -> Prompt:
    """A prompt with as many goals as fit, drawn from the best of some episodes."""
    at = int(episodes.return_.argmax())
    best = jax.tree.map(lambda leaf: leaf[at], episodes.trajectory)
    draw = jax.vmap(lambda k: sample_prompt(k, best, goal, num_slots))
    drawn = draw(jax.random.split(key, num_draws))
    longest = int(drawn.mask.sum(axis=1).argmax())
    return jax.tree.map(lambda leaf: leaf[longest], drawn)


def _maze_grid(rows: int, columns: int, colorbar: bool = False) -> tuple[Figure, np.ndarray]:
    size = (PANEL * columns + (0.6 if colorbar else 0.0), (PANEL + 0.2) * rows)
    figure = Figure(figsize=size, layout="compressed")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _draw_tasks(
    axes: Sequence[Any],
    tasks: Mapping[str, np.ndarray],
    which: Sequence[int],
    prompts: Sequence[Mapping[str, np.ndarray]],
    visits: Sequence[np.ndarray | None],
    norm: PowerNorm | None = None,
) -> None:
    """Draw one task on each of some axes, all with a bar of the same width."""
    side = tasks["maze"].shape[1]
    lanes = max(bar_lanes(side, by_color.values()) for by_color in prompts)
    for ax, index, by_color, counts in zip(axes, which, prompts, visits, strict=True):
        maze, goal = tasks["maze"][index], tasks["goal"][index]
        draw_maze(ax, maze, start_of(maze), goal, by_color, visits=counts, norm=norm, lanes=lanes)


def _title(count: int, what: str, episodes: Episode) -> str:
    mean = f"{float(episodes.return_.mean()):.2f}".replace("-", "\N{MINUS SIGN}")
    return f"{count} {what}{'' if count == 1 else 's'}  (return {mean})"


def _visit_bar(figure: Figure, axes: np.ndarray, norm: PowerNorm) -> None:
    bar = figure.colorbar(
        visit_scale(norm), ax=axes, label="visits in an episode", fraction=0.03, pad=0.01, aspect=25
    )
    bar.outline.set_visible(False)
