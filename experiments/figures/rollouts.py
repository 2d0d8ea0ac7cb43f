"""Figures of prompts and of episodes under them, for any world that offers ``Pictures``.

They follow the paper's figures: prompts (2), how prompt and behavior evolve (3 and 10), why the order of a
prompt matters (5), and short and long prompts (9). ``figures.offered`` says which of them there are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from envs.base import Episode, Goals, Task
from envs.drawing import Film, Pictures, Shown, Stage, observations, write_films
from experiments.figures.style import method_styles, styled
from mgpo_jax.prompts import Prompt, goals_of, sample_prompt

if TYPE_CHECKING:
    from experiments.store.results import Results

NUM_ROLLOUTS = 64
NUM_DRAWS = 64  # prompts drawn, of which the longest is taken
STAGES = (1, 10, 20, 40, 100)  # episodes after which a search is drawn
SNAPSHOTS = (1, 10, 40, 100)  # episodes after which the behavior is drawn
EARLY_STAGES = (1, 4, 8, 16)  # episodes after which the known part of a world is drawn
BAR_ROOM = 0.6  # width of a color bar, in inches
LEGEND_WIDTH = 5.0  # minimum width of a figure with a legend below it, in inches
TITLE_ROOM = 0.3  # height of a title that only the first row of panels has in full, in inches
LABEL_ROOM = (0.9, 0.65)  # inches: width of row labels, and height of title and legend, of a search
FRAME_HEIGHT = 200  # height that small frames are enlarged to, in pixels

Play = Callable[[jax.Array, Task, np.ndarray, int, bool], Episode]
"""``(key, task, goals [k, G], num, judged) -> Episode``: runs ``num`` episodes on a task under a prompt;
numpy leaves ``[num, ..]``. With ``judged``, the policy acts as the world judges policies
(``World.judged``), otherwise with exploratory actions."""


@styled
def prompts(
    pictures: Pictures, results: Mapping[str, Results], which: Sequence[int], seed: int = 0
) -> Figure:
    """Figure 2: the final prompt of each method on a few tasks, in the method's color."""
    looks = method_styles(results)
    tasks = _tasks_of(next(iter(results.values())), which)
    by_color = [
        {look.color: _best_goals(results[label], seed, index) for label, look in looks.items()}
        for index in which
    ]
    figure, axes = _panels(pictures, 1, len(which), at_least=LEGEND_WIDTH)
    pictures.prompts(axes, tasks, by_color)
    handles = [
        Line2D([], [], color=look.color, marker="o", linestyle="", markersize=6, label=look.name)
        for look in looks.values()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


@styled
def search(
    pictures: Pictures,
    result: Results,
    which: Sequence[int],
    seed: int = 0,
    stages: Sequence[int] = STAGES,
) -> Figure:
    """The best prompt after some numbers of episodes, as rows, with a panel for each task.

    Only stages at which the prompt was evaluated are drawn, and the last evaluation.
    """
    evaluated = result.eval_episodes.tolist()
    stages = sorted({*stages, evaluated[-1]} & {*evaluated})
    searches = [
        [
            Stage(
                label=_count(stage, "episode"),
                goals=_best_goals(result, seed, task, stage),
                return_=float(result.eval_returns[seed, task, evaluated.index(stage)]),
            )
            for stage in stages
        ]
        for task in which
    ]
    longest = max(len(stage.goals) for rows in searches for stage in rows)
    width, height = pictures.row(longest)
    size = width * len(which) + LABEL_ROOM[0], height * (len(stages) + 1) + LABEL_ROOM[1]
    figure = Figure(figsize=size, layout="compressed")
    axes = list(figure.subplots(1, len(which), squeeze=False).flat)
    pictures.search(axes, _tasks_of(result, which), searches)
    for ax, task in zip(axes, which, strict=True):
        ax.set_title(f"task {task}", pad=2, loc="left")
    return figure


@styled
def evolution(
    pictures: Pictures,
    result: Results,
    play: Play,
    task: int,
    seed: int,
    key: jax.Array,
    stages: Sequence[int] = SNAPSHOTS,
) -> Figure:
    """Figures 3 and 10: the best prompt after some numbers of episodes, and where it leads the policy."""
    shown = []
    for stage in stages:
        if stage <= result.returns.shape[2]:
            goals = _best_goals(result, seed, task, stage)
            played = play(key, result.task(task), goals, NUM_ROLLOUTS, False)
            shown.append(Shown(_title(_count(stage, "episode"), played), goals, played))
    figure, axes = _panels(pictures, 1, len(shown), BAR_ROOM)
    _draw_visits(pictures, figure, axes, [result.task(task)] * len(shown), shown)
    return figure


@styled
def known(
    pictures: Pictures,
    result: Results,
    play: Play,
    task: int,
    seed: int,
    key: jax.Array,
    stages: Sequence[int] = EARLY_STAGES,
) -> Figure:
    """What a search has seen after some numbers of episodes, and an episode under the best prompt.

    That episode is played as the world judges policies.
    """
    shown, reached = [], []
    for stage in stages:
        if stage <= result.returns.shape[2]:
            goals = _best_goals(result, seed, task, stage)
            played = _play_once(play, key, result.task(task), goals)
            shown.append(Shown(_title(_count(stage, "episode"), played), goals, played))
            seen = [result.reached_in(seed, task, episode)[1] for episode in range(stage)]
            reached.append(np.concatenate(seen))
    figure, axes = _panels(pictures, 1, len(shown), BAR_ROOM)
    scale = pictures.known(axes, [result.task(task)] * len(shown), shown, reached)
    _finish(figure, axes, shown, scale, "visits so far")
    return figure


@styled
def short_and_long(
    pictures: Pictures, result: Results, play: Play, which: Sequence[int], key: jax.Array
) -> Figure:
    """Figure 9: behavior under the task goal alone (top row), and under long prompts (bottom row).

    A long prompt is drawn from the best of the trajectories in the panel above it.
    """
    above, below = [], []
    for index, keys in zip(which, jax.random.split(key, (len(which), 3)), strict=True):
        task, goal = result.task(index), result.task_goals[index]
        explored = play(keys[0], task, goal[None], NUM_ROLLOUTS, False)
        above.append(Shown(_title(_count(1, "goal"), explored), goal[None], explored))
        goals = longest_prompt(keys[1], explored, goal, _num_slots(result))
        played = play(keys[2], task, goals, NUM_ROLLOUTS, False)
        below.append(Shown(_title(_count(len(goals), "goal"), played), goals, played))
    figure, axes = _panels(pictures, 2, len(which), BAR_ROOM)
    _draw_visits(pictures, figure, axes, 2 * _tasks_of(result, which), above + below)
    return figure


@styled
def episodes(
    pictures: Pictures,
    result: Results,
    play: Play,
    which: Sequence[int],
    seed: int,
    key: jax.Array,
) -> Figure:
    """An episode on each task under its optimized prompt, played as the world judges policies."""
    tasks, shown = _tasks_of(result, which), []
    for index, task in zip(which, tasks, strict=True):
        goals = _best_goals(result, seed, index)
        played = _play_once(play, jax.random.fold_in(key, index), task, goals)
        shown.append(Shown(_title(f"task {index}", played), goals, played))
    figure, axes = _panels(pictures, 1, len(which), at_least=LEGEND_WIDTH)
    pictures.episodes(axes, tasks, shown)
    for ax, each in zip(axes, shown, strict=True):
        ax.set_title(each.title, pad=2)
    return figure


@styled
def methods(
    pictures: Pictures,
    results: Mapping[str, Results],
    players: Mapping[str, Play],
    which: Sequence[int],
    seed: int,
    key: jax.Array,
) -> Figure:
    """An episode of each method, as rows, on a few tasks, under its optimized prompt.

    They are played as the world judges policies.
    """
    figure, axes = _panels(pictures, len(results), len(which), at_least=LEGEND_WIDTH)
    figure.set_figheight(figure.get_figheight() - TITLE_ROOM * (len(results) - 1))
    first = next(iter(results.values()))
    shown = []
    for label, result in results.items():
        for index in which:
            goals = _best_goals(result, seed, index)
            folded = jax.random.fold_in(key, index)
            played = _play_once(players[label], folded, result.task(index), goals)
            shown.append(Shown(f"return {_mean_return(played)}", goals, played))
    pictures.episodes(axes, len(results) * _tasks_of(first, which), shown)
    heads = [_head(first, index) for index in which]
    for number, (ax, each) in enumerate(zip(axes, shown, strict=True)):
        above = f"{heads[number]}\n" if number < len(heads) else ""
        ax.set_title(above + each.title, pad=2)
    for ax, look in zip(axes[:: len(which)], method_styles(results).values(), strict=True):
        ax.set_ylabel(look.name, labelpad=2)
    return figure


def _head(result: Results, index: int) -> str:
    """The name of a task, with its optimum if that is known."""
    optimum = float(result.optimal_returns[index])
    return f"task {index}" + (f" (optimum {_signed(optimum)})" if np.isfinite(optimum) else "")


def video(
    pictures: Pictures,
    result: Results,
    play: Play,
    index: int,
    seed: int,
    key: jax.Array,
    path: Path,
) -> None:
    """Figure 5: a GIF of episodes under the initial and the optimized prompt, side by side.

    They are played as the world judges policies. If the world asks for it, a third episode shows the
    optimized goals in another order.
    """
    task, optimized = result.task(index), _best_goals(result, seed, index)
    named = {"Initial prompt": result.task_goals[index][None], "Optimized prompt": optimized}
    reordered = in_another_order(optimized) if pictures.another_order else None
    if reordered is not None:
        named["The same goals in another order"] = reordered
    shown = []
    for name, goals in named.items():
        played = _play_once(play, jax.random.fold_in(key, index), task, goals)
        title = f"{name}, return {_mean_return(played)}"
        shown.append(Shown(title, goals, played))
    if pictures.video:
        pictures.video(path, task, shown)
    elif pictures.frame:
        write_films(path, [_film(pictures.frame, each) for each in shown])


def in_another_order(goals: np.ndarray) -> np.ndarray | None:
    """A prompt ``[k, G]`` with all goals but the final one reversed.

    If reversing changes nothing, as in A B A, the goals are rotated by one instead. If there is no other
    order, because all of them are equal or there are fewer than two, returns None.
    """
    before, final = goals[:-1], goals[-1:]
    for other in (before[::-1], np.roll(before, -1, axis=0)):
        if not np.array_equal(other, before):
            return np.concatenate([other, final])
    return None


def longest_prompt(
    key: jax.Array, episodes: Episode, goal: np.ndarray, max_goals: int
) -> np.ndarray:
    """Draw prompts from the best of a batch of episodes; returns the longest of them, ``[k, G]``."""
    best = int(np.argmax(episodes.return_))
    reached = jax.tree.map(lambda leaf: jnp.asarray(leaf[best]), episodes.trajectory.goals)
    draw = jax.jit(draw_longest, static_argnames="num_slots")
    return goals_of(draw(key, reached, jnp.asarray(goal), max_goals, num_slots=max_goals))


def draw_longest(
    key: PRNGKeyArray,
    reached: Goals,
    goal: Float[Array, "G"],
    max_goals: int | Int[Array, ""],
    num_slots: int,
) -> Prompt:
    """Draw prompts of at most ``max_goals`` goals; returns the longest of them.

    It nearly always has ``max_goals`` goals, if the trajectory reached that many.
    """
    keys = jax.random.split(key, NUM_DRAWS)
    drawn = jax.vmap(lambda k: sample_prompt(k, reached, goal, num_slots, max_goals))(keys)
    longest = jnp.argmax(drawn.mask.sum(axis=1))
    return jax.tree.map(lambda leaf: leaf[longest], drawn)


def _num_slots(result: Results) -> int:
    """The maximum number of goals in a prompt of an adaptation."""
    return result.best["prompt.goals"].shape[-2]


def _best_goals(result: Results, seed: int, task: int, episodes: int | None = None) -> np.ndarray:
    goals = result.best_goals(seed, task, episodes)
    assert goals is not None  # figures of methods without prompts are left out
    return goals


def _tasks_of(result: Results, which: Sequence[int]) -> list[Task]:
    return [result.task(index) for index in which]


def _play_once(play: Play, key: jax.Array, task: Task, goals: np.ndarray) -> Episode:
    return jax.tree.map(lambda leaf: leaf[0], play(key, task, goals, 1, True))


def _panels(
    pictures: Pictures, rows: int, columns: int, more: float = 0.0, at_least: float = 0.0
) -> tuple[Figure, list[Axes]]:
    """A figure with a grid of panels, ``more`` extra inches of width, and a width of ``at_least``."""
    width, height = pictures.panel
    size = max(width * columns + more, at_least), height * rows
    figure = Figure(figsize=size, layout="compressed")
    return figure, list(figure.subplots(rows, columns, squeeze=False).flat)


def _draw_visits(
    pictures: Pictures,
    figure: Figure,
    axes: Sequence[Axes],
    tasks: Sequence[Task],
    shown: Sequence[Shown],
) -> None:
    """Draw the visits of episodes, with titles and a color bar."""
    _finish(figure, axes, shown, pictures.visits(axes, tasks, shown), "visits in an episode")


def _finish(
    figure: Figure, axes: Sequence[Axes], shown: Sequence[Shown], scale: Any, label: str
) -> None:
    """Add titles and a color bar."""
    for ax, each in zip(axes, shown, strict=True):
        ax.set_title(each.title)
    if scale is not None:
        bar = figure.colorbar(scale, ax=axes, label=label, fraction=0.03, pad=0.01, aspect=25)
        bar.outline.set_visible(False)


def _film(frame: Callable[[np.ndarray], np.ndarray], shown: Shown) -> Film:
    """The film of an episode in a world that draws single observations."""
    seen = observations(shown.episode)
    scale = -(-FRAME_HEIGHT // len(frame(seen[0])))

    def frames(times: np.ndarray) -> np.ndarray:
        drawn = np.stack([np.asarray(frame(seen[time])) for time in times])
        return drawn.repeat(scale, axis=1).repeat(scale, axis=2)

    return Film(shown.title, len(seen), frames, lambda time: f"step {time}")


def _title(what: str, episodes: Episode) -> str:
    return f"{what}  (return {_mean_return(episodes)})"


def _mean_return(episodes: Episode) -> str:
    """The mean return of one or more episodes, for titles."""
    return _signed(float(np.mean(episodes.return_)))


def _signed(value: float) -> str:
    return f"{value:.2f}".replace("-", "\N{MINUS SIGN}")


def _count(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
