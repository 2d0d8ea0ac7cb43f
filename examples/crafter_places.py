"""Does the policy of ``crafter-map`` go to the places that a prompt names?

    python -m examples.crafter_places results/crafter-map/ucb

Plays sampled episodes on every task of an adaptation, under prompts whose goals are at the places where the
search found them, and under the same goals at places mirrored through the start, where something else is.
The prompt of the task goal alone, which names no place, stands beside both. First it takes the prompts that
the search chose and compares their returns. Then it takes prompts of two goals: a rare achievement at the
place where the search unlocked it, and the task goal. Of these it reports the share of episodes that unlock
the achievement near that place, and the share that unlock it anywhere.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import mgpo_jax as mgpo
from envs.crafter.env import NUM_ACHIEVEMENTS, PLACE_UNIT, Achievement
from experiments.store.result_files import load_results
from experiments.store.results import Results
from experiments.store.statistics import gain_over_tasks

RARE = (Achievement.COLLECT_COAL, Achievement.COLLECT_IRON, Achievement.COLLECT_DIAMOND)
FAR = 8  # cells between the start and a place, at least: what is nearer is in view, or nearly so
NEAR = 3  # cells between a place and the agent, at most, to have unlocked the achievement there


def mirrored(goals: np.ndarray) -> np.ndarray:
    """The same goals [k, G], each at its place mirrored through the start."""
    changed = goals.copy()
    changed[:, NUM_ACHIEVEMENTS + 1 :] *= -1
    return changed


PLACES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as found": lambda goals: goals,
    "mirrored": mirrored,
    "task goal alone": lambda goals: goals[-1:],
}


class Arrivals(NamedTuple):
    """What became of a prompt's first goal, as shares of the episodes."""

    near: float
    """Unlocked its achievement within ``NEAR`` cells of the place that was found."""
    at_all: float
    """Unlocked its achievement."""


class Player:
    """Plays sampled episodes of the released policy."""

    def __init__(self, results: Results, num_episodes: int) -> None:
        self.env, self.num_episodes = results.environment, num_episodes
        self.policy = mgpo.load_policy(results.env)
        self.num_slots = self.policy.config.max_prompt_length

    def play(self, task: object, goals: np.ndarray) -> mgpo.Episode:
        """Episodes under one prompt, the same random numbers for every prompt."""
        query = mgpo.Query(mgpo.prompt_of(goals, self.num_slots), greedy=jnp.zeros((), bool))
        return mgpo.play(jax.random.key(1), self.env, self.policy, task, query, self.num_episodes)


def rare_goal(results: Results, task: int, achievement: Achievement) -> np.ndarray | None:
    """The goal [G] of an achievement at the nearest far place where the search unlocked it, if any."""
    found = [results.reached_in(0, task, episode)[1] for episode in range(results.returns.shape[2])]
    goals = np.concatenate(found)
    goals = goals[goals[:, achievement.value] > 0]
    distance = PLACE_UNIT * np.abs(goals[:, NUM_ACHIEVEMENTS + 1 :]).sum(axis=1)
    if not (distance >= FAR).any():
        return None
    only = goals[np.argmin(np.where(distance >= FAR, distance, np.inf))].copy()
    only[:NUM_ACHIEVEMENTS] = np.eye(NUM_ACHIEVEMENTS)[achievement.value]
    return only


def arrivals(episodes: mgpo.Episode, goal: np.ndarray) -> Arrivals:
    """What became of one goal [G] in episodes."""
    of_task = episodes.trajectory
    unlocked = of_task.goal_reached & (
        of_task.achieved_goals[..., :NUM_ACHIEVEMENTS] @ goal[:NUM_ACHIEVEMENTS] > 0
    )
    where = of_task.achieved_goals[..., NUM_ACHIEVEMENTS + 1 :]
    distance = PLACE_UNIT * np.abs(where - goal[NUM_ACHIEVEMENTS + 1 :]).sum(axis=-1)
    near = unlocked & (distance <= NEAR)
    return Arrivals(float(near.any(axis=1).mean()), float(unlocked.any(axis=1).mean()))


def measure(
    results: Results, player: Player
) -> tuple[dict[str, np.ndarray], dict[str, dict[str, list[Arrivals]]]]:
    """Mean returns [N] of the chosen prompts, and what became of each rare goal, by where the goals are."""
    num_tasks = results.returns.shape[1]
    chosen = {name: np.zeros(num_tasks) for name in PLACES}
    rare: dict[str, dict[str, list[Arrivals]]] = {
        achievement.name.lower(): {name: [] for name in PLACES} for achievement in RARE
    }
    for index in tqdm(range(num_tasks), disable=None):
        task, best = results.task(index), results.best_goals(0, index)
        assert best is not None
        for name, change in PLACES.items():
            chosen[name][index] = player.play(task, change(best)).return_.mean()
        for achievement in RARE:
            if (goal := rare_goal(results, index, achievement)) is None:
                continue
            prompt = np.stack([goal, results.task_goals[index]])
            for name, change in PLACES.items():
                episodes = player.play(task, change(prompt))
                rare[achievement.name.lower()][name].append(arrivals(episodes, goal))
    return chosen, rare


def main(folder: Path, num_episodes: int = 8) -> None:
    """Print what was measured as JSON."""
    results = load_results(folder)
    chosen, rare = measure(results, Player(results, num_episodes))
    as_found, *others = PLACES
    means = {
        achievement: {
            name: dict(zip(Arrivals._fields, np.mean(found, axis=0).tolist(), strict=True))
            for name, found in of.items()
        }
        for achievement, of in rare.items()
        if of[as_found]
    }
    report = {
        "chosen prompts": {name: float(returns.mean()) for name, returns in chosen.items()},
        f"minus {as_found}": {
            name: gain_over_tasks(chosen[name][None], chosen[as_found][None]) for name in others
        },
        "one rare goal": means,
        "tasks with it": {achievement: len(of[as_found]) for achievement, of in rare.items()},
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
