"""A video of the kitchen: a task under the prompt (g^M) and under the optimized one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from envs.kitchen import NONE, Kitchen, KitchenTask, NoOpenGLError
from envs.render import Panel, kitchen_gif
from experiments.figures.base import LoadPolicy, Pictures, Save, file_names, goals_of
from experiments.results import Results
from experiments.runtime import jit_with
from mgpo_jax.adapt import evaluate
from mgpo_jax.errors import UsageError
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import single_goal
from mgpo_jax.types import Episode, Prompt

NAMES = ("burner", "light", "slide", "hinge", "microwave")  # of the subtasks
REST = 25  # steps that are shown after the last completed subtask


def kitchen_pictures(env: Kitchen) -> Pictures:
    """A GIF of the first task for each adaptation."""
    return Pictures(lambda *_: iter(()), partial(draw_all, env))


def draw_all(
    env: Kitchen,
    results: Mapping[str, Results],
    load: LoadPolicy,
    which: Sequence[int],
    seed: int,
) -> Iterator[tuple[str, Save]]:
    """All figures of some adaptations."""
    for name, result in file_names(results.values()).items():
        save = partial(before_and_after, env, load(result), result, which[0], seed)
        yield f"{name}_episode_task{which[0]}.gif", save


def before_and_after(
    env: Kitchen, policy: Policy, result: Results, index: int, seed: int, path: Path
) -> None:
    """Greedy episodes under the initial and under the optimized prompt, side by side."""
    task = KitchenTask(jnp.asarray(result.tasks["order"][index]))
    prompts = {
        "Initial prompt": single_goal(env.task_goal(task), policy.num_slots),
        "Optimized prompt": result.best_prompt(seed, index),
    }
    episode = jit_with(env)(lambda prompt: evaluate(jax.random.key(0), env, policy, task, prompt))
    panels = [panel(name, prompt, episode(prompt)) for name, prompt in prompts.items()]
    order = [NAMES[subtask] for subtask in result.tasks["order"][index] if subtask != NONE]
    try:
        kitchen_gif(path, f"Task, in an order that is not told: {', '.join(order)}", panels)
    except NoOpenGLError as error:
        raise UsageError(str(error)) from None


def panel(name: str, prompt: Prompt, episode: Episode) -> Panel:
    """An episode as what it looked like, until soon after the last subtask was completed."""
    trajectory = jax.tree.map(np.asarray, episode.trajectory)
    times = np.flatnonzero(trajectory.goal_reached[: trajectory.length])
    completed = [(int(time) + 1, NAMES[trajectory.goals[time].argmax()]) for time in times]
    end = min(trajectory.length, times[-1] + REST) if completed else trajectory.length
    title = f"{name}, return {float(episode.return_):.2f}\n{words(prompt)}"
    return Panel(title, trajectory.obs[:end], completed)


def words(prompt: Prompt) -> str:
    """A prompt in words; goals that are no subtasks (BBT) by their numbers."""
    return " > ".join(_word(goal) for goal in goals_of(prompt))


def _word(goal: np.ndarray) -> str:
    if not np.isin(goal, (0.0, 1.0)).all():
        return f"({', '.join(f'{value:.1f}' for value in goal)})"
    named = [NAMES[index] for index in np.flatnonzero(goal)]
    return named[0] if len(named) == 1 else "{" + ", ".join(named) + "}"
