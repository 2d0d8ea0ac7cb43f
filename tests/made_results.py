"""Handmade results in a world of two tiny mazes, and their files."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from envs.maze import MAZE15
from envs.maze.env import MazeRunner
from envs.registry import Judgement, World
from envs.wrappers import Wrapper
from experiments.store.results import Results
from mgpo_jax.outcomes import Reached

SIDE = 7
ENV = MazeRunner(name="tiny", side=SIDE, horizon=6)
TINY = World(
    name="tiny", make=lambda: ENV, pictures=MAZE15.pictures, demonstrators=MAZE15.demonstrators
)
MAZE = np.array(
    [
        [1, 1, 1, 1, 1, 1, 1],
        [1, 0, 0, 0, 0, 0, 1],
        [1, 0, 1, 0, 1, 0, 1],
        [1, 0, 1, 0, 0, 0, 1],
        [1, 0, 0, 0, 0, 0, 1],
        [1, 0, 1, 0, 1, 0, 1],
        [1, 1, 1, 1, 1, 1, 1],
    ]
)
GOALS = np.array([(1, 5), (5, 1)])
FORMAT_1 = {
    "choice.greedy": "greedy",
    "choice.prompt.goals": "prompt_goals",
    "choice.prompt.mask": "prompt_masks",
    "best.prompt.goals": "best_goals",
    "best.prompt.mask": "best_masks",
}


@dataclass(frozen=True)
class Named(Wrapper):
    """A world whose first goals have names."""

    goal_names: tuple[str, ...] = ("down", "right")


LUCKY = replace(
    TINY, make=lambda: Named(ENV), judged=Judgement(mode="sample", episodes=4), num_test_tasks=2
)
"""The same world, but judged by sampled actions, and with named goals."""


def made_results(method: str = "ucb", shift: float = 0.0, **changes: Any) -> Results:
    """2 seeds, 2 tasks, 20 episodes, 3 slots; the best prompt gains a waypoint at episode 10."""
    shape = (2, 2, 20)
    masks = np.zeros((*shape, 3), bool)
    masks[..., -1] = True
    masks[:, :, 9:, -2] = True
    goals = np.zeros((*shape, 3, 2), np.float32)
    goals[..., -1, :] = GOALS[:, None] / SIDE
    goals[:, :, 9:, -2, :] = np.array([3, 3]) / SIDE
    evals = np.array([[[-3.0, -1.0], [-1.0, 0.0]], [[-2.0, -1.0], [-2.0, 1.0]]]) + shift
    actions = np.full((*shape, 6), 255, np.uint8)
    actions[..., :4] = 2
    steps = np.tile(np.arange(4, dtype=np.uint8), np.prod(shape))
    parts = {"prompt.goals": goals, "prompt.mask": masks, "greedy": np.ones(shape, bool)}
    made: dict[str, Any] = {
        "returns": np.full(shape, -1.0, np.float32),
        "choices": parts,
        "best": dict(parts),
        "eval_episodes": np.array([1, 20]),
        "eval_returns": evals.astype(np.float32),
        "optimal_returns": np.array([0.5, 0.7], np.float32),
        "actions": actions,
        "reached": Reached(
            counts=np.full(shape, 4, np.int32),
            steps=steps,
            goals=np.stack([4 - steps, 0 * steps + 3], axis=1).astype(np.float32) / SIDE,
        ),
        "tasks": {"maze": np.stack([MAZE, MAZE]), "goal": GOALS},
        "config": {"env": "tiny", "method": method, "policy": None},
    }
    return Results(**{**made, **changes})


def save_format_1(folder: Path, results: Results) -> Path:
    """Save results in format 1, which has no actions and other names."""
    folder.mkdir(parents=True)
    arrays = {f"choice.{name}": array for name, array in results.choices.items()}
    arrays |= {f"best.{name}": array for name, array in results.best.items() if name != "greedy"}
    arrays = {FORMAT_1[name]: array for name, array in arrays.items()}
    for name in ("returns", "eval_episodes", "eval_returns", "optimal_returns"):
        arrays[name] = getattr(results, name)
    np.savez(folder / "results.npz", **arrays)
    np.savez(folder / "tasks.npz", **results.tasks)
    config = dict(results.config)
    config["bandit"] = config.pop("method")
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "summary.json").write_text("{}")
    return folder
