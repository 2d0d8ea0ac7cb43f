"""The figures, as functions of results and policies.

Numbered as in the paper: 6 and 7 learning curves, 2 prompts on mazes, 3 and 10 how prompt and behavior
evolve, 9 short and long prompts.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import Any, ParamSpec

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from envs.base import Environment
from envs.maze_runner import MazeRunner, MazeTask
from envs.render import INK, PROMPT_COLOR, bar_lanes, draw_maze, visit_norm, visit_scale
from experiments.results import Results
from mgpo_jax.errors import DataError
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import sample_prompt, single_goal
from mgpo_jax.rollout import rollout
from mgpo_jax.types import Episode, Prompt, Query

NUM_ROLLOUTS = 64
STAGES = (1, 10, 20, 40, 100)
PANEL = 1.9  # inches of one maze

STYLE: dict[Any, Any] = {
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 8,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#7A868C",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E6E9EB",
    "xtick.color": "#7A868C",
    "ytick.color": "#7A868C",
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.markersize": 4,
}

# Method -> (name in legends, color, line style, marker).
METHODS = {
    "ucb": ("MGPO-UCB", "#D55E00", "-", "o"),
    "bpe": ("MGPO-BPE", "#0072B2", "-", "s"),
    "explore": ("MGPO-explore", "#009E73", "-", "^"),
    "grips": ("GRIPS", "#CC79A7", "--", "D"),
    "bbt": ("BBT", "#56B4E9", "--", "v"),
}
SPARE_COLORS = ("#E69F00", "#6B6B6B", "#8C510A", "#5E3C99", "#B2182B", "#003C30")


Args = ParamSpec("Args")


def styled(draw: Callable[Args, Figure]) -> Callable[Args, Figure]:
    """Draw in ``STYLE`` without touching the settings of the process."""

    @wraps(draw)
    def wrapper(*args: Args.args, **kwargs: Args.kwargs) -> Figure:
        with mpl.rc_context(STYLE):
            return draw(*args, **kwargs)

    return wrapper


def method_styles(labels: Iterable[str]) -> dict[str, tuple[str, str, Any, str]]:
    """(legend, color, line style, marker) of each label, a method's name or "name (remark)"."""
    styles: dict[str, tuple[str, str, Any, str]] = {}
    taken: set[str] = set()
    spare = iter(SPARE_COLORS * 10)
    for label in labels:
        method, _, remark = label.partition(" ")
        name, color, line, marker = METHODS.get(method, (method, "", "-", "o"))
        color = next(spare) if color in taken or not color else color
        taken.add(color)
        styles[label] = (f"{name} {remark}".strip(), color, line, marker)
    return styles


@styled
def learning_curve(results: Mapping[str, Results], title: str | None = None) -> Figure:
    """Figures 6 and 7: return of the optimized prompt over the episodes of adaptation.

    Lines are means over tasks and seeds, bands the standard deviation over seeds.
    """
    figure = Figure(figsize=(3.6, 2.7), layout="constrained")
    ax = figure.add_subplot()
    for label, (name, color, line, marker) in method_styles(results).items():
        result = results[label]
        by_seed = result.eval_returns.mean(axis=1)
        mean, std = by_seed.mean(axis=0), by_seed.std(axis=0)
        episodes = result.eval_episodes
        ax.plot(
            episodes, mean, label=name, color=color, linestyle=line, marker=marker,
            markeredgecolor="white", markeredgewidth=0.6,
        )  # fmt: skip
        if len(by_seed) > 1:
            ax.fill_between(episodes, mean - std, mean + std, color=color, alpha=0.16, linewidth=0)
    optima = {round(float(result.optimal_returns.mean()), 6) for result in results.values()}
    for index, optimum in enumerate(sorted(optima)):
        label = "_" if index else "optimum"
        ax.axhline(optimum, color=INK, linestyle=(0, (4, 3)), linewidth=1.0, label=label, zorder=1)
    ax.set(xlabel="episodes", ylabel="return of the optimized prompt", title=title or "")
    ax.set_xlim(left=0)
    ax.margins(y=0.08)
    ax.legend(loc="best")
    return figure


@styled
def training_curve(metrics: Path) -> Figure:
    """Losses of a pre-training run and its greedy returns on the way, from ``metrics.jsonl``."""
    try:
        rows = [json.loads(line) for line in metrics.read_text().splitlines()]
        steps = [row["step"] for row in rows]
    except (OSError, ValueError, TypeError, KeyError):
        raise DataError(f"{metrics} is missing or not readable JSON lines") from None
    figure = Figure(figsize=(6.4, 2.4), layout="constrained")
    panels = (
        ("loss", {"train/loss": "training", "val/loss": "held out"}),
        ("return of the initial prompt", {"eval/initial_return": "_"}),
    )
    colors = (METHODS["bpe"][1], METHODS["ucb"][1])
    for ax, (ylabel, names) in zip(figure.subplots(1, 2), panels, strict=True):
        for (name, label), color in zip(names.items(), colors, strict=False):
            values = [row.get(name, np.nan) for row in rows]
            ax.plot(steps, values, color=color, label=label, marker="o", markersize=3)
        ax.set(xlabel="steps", ylabel=ylabel)
    figure.axes[0].legend()
    return figure


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


@partial(jax.jit, static_argnames=("env", "policy"))
def run_policy(
    key: jax.Array,
    env: Environment,
    policy: Policy,
    task: Any,
    prompt: Prompt,
    greedy: bool | jax.Array = False,
) -> Episode:
    """``NUM_ROLLOUTS`` episodes under one prompt."""
    query = Query(prompt, jnp.asarray(greedy))
    episode = jax.vmap(lambda k: rollout(k, env, policy, task, query, "lanes"), axis_name="lanes")
    return episode(jax.random.split(key, NUM_ROLLOUTS))


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


def goals_of(prompt: Prompt) -> np.ndarray:
    """The goals of one prompt, ``[k, G]``."""
    return np.asarray(prompt.goals)[np.asarray(prompt.mask)]


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
