"""Collection: demonstrations that are not kept are tried again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

import envs
from envs.errors import DataError, UsageError
from envs.wrappers import Wrapper
from experiments.datasets import collect, collect_and_save
from experiments.demonstrators import find_demonstrator
from experiments.store.settings import CollectConfig
from mgpo_jax.dataset import load_dataset
from mgpo_jax.tasks import benchmark_tasks, task_hashes

WORLD = envs.make("gridworld")
EXPERT = envs.find("gridworld").demonstrators(WORLD)["expert"]
FIRST = 5000  # of the tasks below


def test_tasks_in_turn_are_demonstrated_equally_often() -> None:
    """Dropped are episodes of every eighth length, which is a matter of luck, since starts are random."""
    demonstrator = EXPERT._replace(
        sample_task=lambda key, index: WORLD.task(FIRST + index % 16),
        keeps=lambda episode: episode.trajectory.length % 8 > 0,
    )
    dataset, facts = collect(WORLD, demonstrator, 2000, seed=0, num_test_tasks=50)
    assert len(dataset) == 2000
    assert (dataset.lengths % 8 > 0).all()
    assert facts["tried_again"] > 100
    _, counts = np.unique(dataset.task_hashes, return_counts=True)
    tests = np.isin(task_hashes(WORLD, benchmark_tasks(WORLD, 50)), dataset.task_hashes)
    assert not tests.any()
    assert counts.max() - counts.min() <= 6, counts


@dataclass(frozen=True)
class Breaking(Wrapper):
    """Breaks down when an episode lasts 30 steps."""

    def step(self, state, action):
        state, timestep = self.env.step(state, action)
        failed = state.steps >= 30
        return state, timestep._replace(truncated=timestep.truncated | failed, failed=failed)


def test_episodes_of_broken_worlds_are_counted_not_kept() -> None:
    """Of tasks of three objects, most of which take fewer steps."""
    demonstrator = EXPERT._replace(sample_task=lambda key, index: WORLD.task(index % 200))
    dataset, facts = collect(Breaking(WORLD), demonstrator, 500, seed=0, num_test_tasks=50)
    assert len(dataset) == 500
    assert dataset.lengths.max() < 30
    assert facts["failed_episodes"] == facts["tried_again"] > 10


def test_settings_that_are_fixed() -> None:
    with pytest.raises(
        UsageError, match="the demonstrator expert has no settings to change; leave out"
    ):
        find_demonstrator(envs.find("gridworld"), WORLD, "expert,drop=0.3")


def test_a_dataset_keeps_what_the_demonstrator_intended() -> None:
    """It executes one action more than it means to, modulo their number, in every step."""
    agent = EXPERT.agent(EXPERT.weights)
    num = WORLD.spec.action_dim

    def missing(step):
        meant, quits, memory = step
        return (meant + 1) % num, quits, (memory, meant)

    noisy = EXPERT._replace(
        agent=lambda weights: agent._replace(
            begin=lambda *args: missing(agent.begin(*args)),
            proceed=lambda key, memory, *args: missing(agent.proceed(key, memory[0], *args)),
            intended=lambda memory: memory[1],
        )
    )
    dataset, _ = collect(WORLD, noisy, 40, seed=0, num_test_tasks=50)
    np.testing.assert_array_equal(dataset.actions, (dataset.intended + 1) % num)
    assert dataset.intended.dtype == dataset.actions.dtype
    assert len(np.unique(dataset.intended)) > 2


def test_a_task_that_cannot_be_demonstrated_is_an_error() -> None:
    demonstrator = EXPERT._replace(
        sample_task=lambda key, index: WORLD.task(index),
        keeps=lambda episode: episode.trajectory.length < 5,
    )
    with pytest.raises(DataError, match=r"failed 20 times at task [0-9]+ of gridworld"):
        collect(WORLD, demonstrator, 500, seed=0, num_test_tasks=50)


@pytest.mark.parametrize("large", [False, True])
def test_what_is_written_is_what_is_collected(tmp_path, monkeypatch, large) -> None:
    """Also if it is so large that it is mapped into memory."""
    if large:
        monkeypatch.setattr("mgpo_jax.dataset.LARGE", 1000)
    config = CollectConfig(env="gridworld", trajectories=300, seed=3, out=tmp_path / "data")
    collect_and_save(config)
    written, manifest = load_dataset(tmp_path / "data", WORLD.spec)
    dataset, facts = collect(WORLD, EXPERT, 300, seed=3, num_test_tasks=50)
    assert isinstance(written.obs, np.memmap) == large
    assert manifest["length"] == facts["length"]
    assert written.arrays.keys() == dataset.arrays.keys()
    for name, array in dataset.arrays.items():
        assert array.dtype == written.arrays[name].dtype
        np.testing.assert_array_equal(array, written.arrays[name])
