"""Figures of GridWorld: how the search finds the hidden order, and where its prompts lead."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D

from envs.grid_world import FLIP, MOVES, NONE, NUM_OBJECTS, OBJECTS, SIDE, GridTask, GridWorld
from envs.render.grid import NO_GOALS, Walk, draw_grid, draw_objects, grid_gif, objects_of
from envs.render.palette import BAR_COLOR, INK, PALE_INK, PAPER
from experiments.figures.base import (
    STAGES,
    LoadPolicy,
    Pictures,
    Save,
    file_names,
    goals_of,
    run_policy,
)
from experiments.figures.style import styled
from experiments.results import Results
from mgpo_jax.policy import Policy
from mgpo_jax.types import Episode, Prompt, Trajectory

UNIT = 0.19  # inches from goal to goal of a prompt
ROW = 1.2  # distance of the rows, in units
RETURN_ROOM = 1.9  # units that the column of returns takes
PANEL = 2.0  # inches of one grid


def grid_pictures(env: GridWorld) -> Pictures:
    """The orders that each search found, episodes under its prompts, and a GIF of the first."""
    return Pictures(draw_run, partial(draw_all, env))


def draw_run(result: Results, which: Sequence[int]) -> Iterator[tuple[str, Save]]:
    """The figure that needs no policy."""
    yield "orders.png", orders(result, which).savefig


def draw_all(
    env: GridWorld,
    results: Mapping[str, Results],
    load: LoadPolicy,
    which: Sequence[int],
    seed: int,
) -> Iterator[tuple[str, Save]]:
    """All figures of some adaptations."""
    key = jax.random.key(seed)
    for name, result in file_names(results.values()).items():
        yield f"{name}_orders.png", orders(result, which, seed).savefig
        policy, tasks = load(result), result.tasks["order"]
        prompts = [result.best_prompt(seed, task) for task in which]
        played = [
            greedy_episode(jax.random.fold_in(key, task), env, policy, tasks[task], prompt)
            for task, prompt in zip(which, prompts, strict=True)
        ]
        yield f"{name}_episodes.png", episodes(tasks, which, prompts, played).savefig
        order, prompt = tasks[which[0]], prompts[0]
        gif = partial(
            grid_gif, order=order, walk=walk_of(played[0]), prompt=named_objects(prompt, order)
        )
        yield f"{name}_episode_task{which[0]}.gif", gif


@styled
def orders(
    result: Results, which: Sequence[int], seed: int = 0, stages: Sequence[int] = STAGES
) -> Figure:
    """For each task its true order, and below it the best prompt after some episodes.

    Only stages at which the prompt was evaluated are drawn, and the last evaluation.
    """
    evaluated = result.eval_episodes.tolist()
    stages = sorted({*stages, evaluated[-1]} & {*evaluated})
    tasks, at = result.tasks["order"], [evaluated.index(stage) for stage in stages]
    named = {
        task: [named_objects(result.best_prompt(seed, task, n), tasks[task]) for n in stages]
        for task in which
    }
    width = max(NUM_OBJECTS, *(len(objects) for rows in named.values() for objects in rows))
    columns, height = width + RETURN_ROOM, ROW * (len(stages) + 1)
    size = (UNIT * columns * len(which) + 0.9, UNIT * height + 0.65)
    figure = Figure(figsize=size, layout="compressed")
    axes = figure.subplots(1, len(which), squeeze=False)[0]
    for ax, task in zip(axes, which, strict=True):
        returns = result.eval_returns[seed, task, at]
        _draw_search(ax, objects_of(tasks[task]), named[task], returns, width)
        ax.set_title(f"task {task}", pad=2, loc="left")
        ax.set_title("return", pad=2, loc="right", color=PALE_INK)
    axes[0].set_yticks(
        ROW * np.arange(len(stages) + 1),
        ["true order", *(f"{n} episode{'' if n == 1 else 's'}" for n in stages)],
    )
    _legend(figure, {"next in the true order": _disc(PALE_INK), "out of turn": _disc(PAPER)}, 2)
    return figure


@styled
def episodes(
    tasks: np.ndarray, which: Sequence[int], prompts: Sequence[Prompt], played: Sequence[Episode]
) -> Figure:
    """An episode of each of some ``tasks [N, 7]`` under its prompt."""
    figure = Figure(figsize=(PANEL * len(which), PANEL + 0.75), layout="compressed")
    axes = figure.subplots(1, len(which), squeeze=False)[0]
    for ax, task, prompt, episode in zip(axes, which, prompts, played, strict=True):
        order, return_ = tasks[task], float(episode.return_)
        objects = objects_of(order)
        solved = np.isin(np.arange(NUM_OBJECTS), objects[: round(return_ * len(objects))])
        draw_grid(ax, order, solved, walk_of(episode), named_objects(prompt, order))
        ax.set_title(f"task {task}  (return {return_:.2f})", pad=2)
    entries = {
        "switched on in turn": _disc(PALE_INK),
        "not switched on in turn": _disc(PAPER),
        "gray: not in the task": _disc(BAR_COLOR, BAR_COLOR),
        "place in the true order": (_disc(INK, INK), _letter("1", PAPER)),
        "start": (_disc(PAPER, INK, "s"), _letter("S", INK)),
        "path, from light to dark": Line2D([], [], color=INK),
    }
    _legend(figure, entries, 3)
    return figure


def greedy_episode(
    key: jax.Array, env: GridWorld, policy: Policy, order: np.ndarray, prompt: Prompt
) -> Episode:
    """One episode of the task ``order [7]`` under a prompt."""
    played = run_policy(key, env, policy, GridTask(jnp.asarray(order)), prompt, greedy=True)
    return jax.tree.map(lambda leaf: leaf[0], played)


def walk_of(episode: Episode) -> Walk:
    """The start of one episode and the world after each of its steps."""
    trajectory: Trajectory = jax.tree.map(np.asarray, episode.trajectory)
    length = int(trajectory.length)
    seen = trajectory.obs[:length]
    is_on, positions = seen[:, :NUM_OBJECTS] > 0.5, seen[:, NUM_OBJECTS:].astype(int)
    # Observations end before the last step, which is repeated here.
    action, position = trajectory.actions[length - 1], positions[-1]
    flipped = np.all(position == np.array(OBJECTS), axis=1) & (action == FLIP)
    moved = np.clip(position + np.array(MOVES)[action], 0, SIDE - 1)
    return Walk(
        np.concatenate([positions, moved[None]]), np.concatenate([is_on, is_on[-1:] ^ flipped])
    )


def named_objects(prompt: Prompt, order: np.ndarray) -> np.ndarray:
    """The objects that the goals of a prompt name, ``[k]``, without a last goal that is g^M.

    A goal counts as what it is nearest to, as BBT moves goals; one that is not nearest to a single
    object is ``NONE``.
    """
    near = goals_of(prompt) > 0.5
    task_goal = np.isin(np.arange(NUM_OBJECTS), order)
    if np.array_equal(near[-1], task_goal):
        near = near[:-1]
    return np.where(near.sum(axis=1) == 1, near.argmax(axis=1), NONE)


def in_turn(objects: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Which of the ``objects [k]`` that a prompt names come in their turn, ``[k]`` booleans.

    Read alone, those spell the beginning of the true order ``[n]``.
    """
    place, turns = 0, []
    for thing in objects.tolist():
        turns.append(place < len(order) and thing == order[place])
        place += turns[-1]
    return np.array(turns, bool)


def _draw_search(
    ax: Axes, order: np.ndarray, rows: Sequence[np.ndarray], returns: np.ndarray, width: int
) -> None:
    """The true order, and below it the prompt of each stage with its return."""
    right = width + RETURN_ROOM - 0.6
    draw_objects(ax, order, np.ones(len(order), bool), 0.0)
    ax.axhline(0.5 * ROW, color=BAR_COLOR, linewidth=0.8)
    for row, (objects, return_) in enumerate(zip(rows, returns, strict=True), start=1):
        draw_objects(ax, objects, in_turn(objects, order), ROW * row)
        if not len(objects):
            ax.text(-0.4, ROW * row, NO_GOALS, va="center_baseline", color=PALE_INK)
        ax.text(right, ROW * row, f"{return_:.2f}", va="center_baseline", ha="right")
    ax.set(xlim=(-0.6, right), ylim=(ROW * (len(rows) + 0.5), -0.5 * ROW), xticks=[], yticks=[])
    ax.set_aspect("equal")
    ax.tick_params(length=0)
    ax.set_frame_on(False)
    ax.grid(False)


def _legend(figure: Figure, entries: Mapping[str, Any], columns: int) -> None:
    """Explain marks, or stacks of marks, below a figure."""
    figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=columns,
        handler_map={tuple: HandlerTuple(ndivide=1)},
    )  # fmt: skip


def _disc(face: str, edge: str = PALE_INK, marker: str = "o") -> Line2D:
    return Line2D(
        [], [], linestyle="", marker=marker, markersize=7, markeredgewidth=1.2,
        markerfacecolor=face, markeredgecolor=edge,
    )  # fmt: skip


def _letter(letter: str, color: str) -> Line2D:
    text = f"$\\mathbf{{{letter}}}$"
    return Line2D([], [], linestyle="", marker=text, markersize=4, markeredgewidth=0.3, color=color)
