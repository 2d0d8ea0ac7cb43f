"""The published results: their episodes can be replayed, and folders in format 1 can be read."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.episodes import replay
from experiments.store.result_files import load_results

RESULTS = Path(__file__).parent.parent / "results"
NUM_REPLAYED = 200
REPLAYABLE = [
    f"{world}/{method}"
    for world in ("maze15", "gridworld")
    for method in ("ucb", "bpe", "explore", "grips", "bbt")
    if (world, method) != ("gridworld", "bbt")  # of the first format, which has no actions
]


@pytest.mark.parametrize("name", REPLAYABLE)
def test_published_episodes_can_be_played_again(name):
    results = load_results(RESULTS / name)
    env = envs.make(results.env)
    rng = np.random.default_rng(0)
    where = tuple(rng.integers(size, size=NUM_REPLAYED) for size in results.returns.shape)
    actions = results.actions[where]
    length = (actions != 255).sum(axis=1)
    if results.keys is None:  # a world without chance
        keys = jax.random.split(jax.random.key(0), NUM_REPLAYED)
    else:
        keys = jax.random.wrap_key_data(jnp.asarray(results.keys[where]))
    tasks = jax.tree.map(lambda leaf: jnp.asarray(leaf)[where[1]], results.task_set)
    play = jax.jit(jax.vmap(partial(replay, env=env)))
    played = play(key=keys, task=tasks, actions=actions.astype(np.int32), length=length)
    np.testing.assert_allclose(played.return_, results.returns[where], atol=1e-5)
    np.testing.assert_array_equal(played.trajectory.length, length)
    reached = np.asarray(played.trajectory.goal_reached).sum(axis=1)
    np.testing.assert_array_equal(reached, results.reached.counts[where])


@pytest.mark.parametrize("name", ["maze15/ucb", "gridworld/ucb"])
def test_reached_goals_are_those_of_the_replayed_episodes(name):
    results = load_results(RESULTS / name)
    reached = results.reached
    ends = np.cumsum(reached.counts.ravel()).reshape(reached.counts.shape)
    assert ends[-1, -1, -1] == len(reached.steps) == len(reached.goals)
    for where in [(0, 0, 0), (1, 7, 13), (2, 49, 99)]:
        episode = results.replay(*where)
        assert episode.return_ == pytest.approx(results.returns[where], abs=1e-5)
        steps, goals = results.reached_in(*where)
        np.testing.assert_array_equal(steps, np.flatnonzero(episode.trajectory.goal_reached))
        np.testing.assert_array_equal(goals, episode.trajectory.achieved_goals[steps])


def test_results_of_the_first_format_are_read():
    results = load_results(Path(__file__).parent / "data" / "results_of_format_1")
    assert results.method == "ucb"
    assert results.actions is None
    assert results.reached is None
    assert results.best_goals(0, 0).shape[1] == results.task_goals.shape[1] == 5
    assert set(results.choices) == {"prompt.goals", "prompt.mask", "greedy"}
