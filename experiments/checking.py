"""Compare what a policy reaches under optimized prompts in a world and in its official implementation.

Two episodes agree if they reach the same goals in the same order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np

import envs
from envs.official import Official, Own, Played, play
from experiments.evaluation import Case, find_official
from experiments.store.layout import ARRAYS
from mgpo_jax.acting import Actor
from mgpo_jax.files import hash_file
from mgpo_jax.progress import Progress
from mgpo_jax.tasks import task_at

SAME_RETURN = 1e-5  # returns that differ by less are equal up to rounding


def officials_of(cases: Sequence[Case]) -> list[Official]:
    """The official implementations of the worlds of some adaptations.

    Raises:
      UsageError: if a world has none, or its dependencies are not installed.
    """
    return [find_official(case.env, envs.make(case.env)) for case in cases]


def compare(cases: Sequence[Case], officials: Sequence[Official]) -> Iterator[dict[str, Any]]:
    """Yield a row for each optimized prompt of some adaptations; episodes run one after the other."""
    sizes = [case.result.eval_returns.shape[:2] for case in cases]
    with Progress(sum(seeds * tasks for seeds, tasks in sizes), "prompt") as progress:
        for case, official, (seeds, tasks) in zip(cases, officials, sizes, strict=True):
            for seed, index in product(range(seeds), range(tasks)):
                yield _compare_prompt(case, official, seed, index)
                progress.update()


def _compare_prompt(case: Case, official: Official, seed: int, index: int) -> dict[str, Any]:
    """The row of one seed and task: an episode under its optimized prompt in each of both worlds."""
    result, task = case.result, task_at(case.tasks, index)
    goals = result.best_goals(seed, index)
    assert goals is not None  # ``open_case`` refuses methods without prompts
    # The same stepwise policy acts in both, so that they only differ in the world.
    actor = Actor(case.policy, goals)
    own = play(actor, Own(envs.make(case.env), task, official.goal_name))
    theirs = play(actor, official.episode(task))
    return {
        "folder": str(case.folder),
        "env": case.env,
        "official": official.name,
        "optimizer": result.method,
        "seed": seed,
        "task": index,
        "task_name": official.task_name(task),
        "prompt": [official.goal_name(goal) for goal in goals],
        "adapted": float(result.eval_returns[seed, index, -1]),
        "here": _entries(own),
        "there": _entries(theirs),
        "agrees": own.reached == theirs.reached,
        "same_return": abs(own.return_ - theirs.return_) < SAME_RETURN,
    }


def _entries(played: Played) -> dict[str, Any]:
    """The outcome of an episode as JSON values."""
    return {
        "reached": list(played.reached),
        "steps": list(played.steps),
        "return": played.return_,
        "length": played.length,
    }


def summaries(cases: Sequence[Case], rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A summary of each adaptation that has rows: how many prompts agree, and mean returns."""
    by_folder = {str(case.folder): case for case in cases}
    found = []
    for folder, case in by_folder.items():
        own = [row for row in rows if row["folder"] == folder]
        if own:
            found.append(
                {
                    **{name: own[0][name] for name in ("folder", "env", "official", "optimizer")},
                    "policy_sha256": case.policy.sha256,
                    "results_sha256": hash_file(case.folder / ARRAYS),
                    "num_prompts": len(own),
                    "num_agreeing": sum(row["agrees"] for row in own),
                    "num_same_return": sum(row["same_return"] for row in own),
                    "adapted": float(np.mean([row["adapted"] for row in own])),
                    "return": float(np.mean([row["here"]["return"] for row in own])),
                    "official_return": float(np.mean([row["there"]["return"] for row in own])),
                }
            )
    return found


HEAD = (
    "folder", "seed", "task", "task description", "goals reached", "goals reached (official)", "return",
    "return (official)", "agree",
)  # fmt: skip


def cells(row: dict[str, Any]) -> list[str]:
    """The cells of a row in the printed table."""
    here, there = row["here"], row["there"]
    return [
        row["folder"],
        str(row["seed"]),
        str(row["task"]),
        row["task_name"],
        ", ".join(here["reached"]),
        "the same" if row["agrees"] else ", ".join(there["reached"]),
        f"{here['return']:.2f}",
        f"{there['return']:.2f}",
        "yes" if row["agrees"] else "no",
    ]


def told(summary: dict[str, Any]) -> str:
    """A summary in words."""
    num = summary["num_prompts"]
    return (
        f"{summary['folder']}: {summary['num_agreeing']} of {num} prompts reach the same goals in the same "
        f"order, {summary['num_same_return']} have the same return; mean return {summary['return']:.3f} in "
        f"{summary['env']}, {summary['official_return']:.3f} in {summary['official']}"
    )
