"""The worlds in ``examples/`` are sound, and the guide quotes one of them verbatim."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.episodes import run_episode
from envs.official import Played
from envs.registry import World
from mgpo_jax.dataset import load_dataset

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "docs" / "guides" / "own-gymnasium-world.md"


@pytest.fixture(autouse=True)
def _root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path, str(ROOT)])


def world(name: str) -> World:
    if name == "doors":
        pytest.importorskip("minigrid")
    return importlib.import_module(f"examples.{name}").WORLD


def test_the_guide_shows_the_example() -> None:
    source = (ROOT / "examples" / "doors.py").read_text()
    assert f"```python\n{source}```" in GUIDE.read_text()
    assert len(source.splitlines()) < 150
    assert f"{len(source.splitlines())} lines" in GUIDE.read_text()


def test_stuck_searches_are_counted(tmp_path: Path) -> None:
    """Of two seeds and three tasks, two are solved; one of the others had an optimal episode of each kind,
    and one a sampled one only."""
    from examples.stuck import count_stuck

    greedy = np.tile([True, False], (2, 3, 2))
    returns = np.zeros((2, 3, 4))
    returns[0, 1, 0] = returns[0, 1, 1] = returns[1, 2, 3] = 1.0
    returns[0, 0, 0] = 1.0
    judged = np.zeros((2, 3, 2))
    judged[0, 0, 1] = judged[1, 0, 1] = 1.0
    np.savez(
        tmp_path / "results.npz",
        **{"eval_returns": judged, "returns": returns, "choice.greedy": greedy},
    )
    assert count_stuck(tmp_path).tolist() == [4, 1, 2]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["doors", "point_maze"])
def test_they_are_sound(name: str) -> None:
    assert envs.check_world(world(name)).faults == ()


def test_the_planner_reaches_the_goal_through_the_doors() -> None:
    doors = world("doors")
    env, key = doors.make(), jax.random.key(0)
    planner = doors.demonstrators(env)["planner"]
    task = planner.sample_task(key, jnp.int32(0))
    episode = jax.jit(lambda key, task: run_episode(key, env, planner.agent(()), task))(key, task)
    length = int(episode.trajectory.length)
    assert 20 <= length < 60
    np.testing.assert_allclose(episode.trajectory.outcomes[length - 1], task.goal)
    # Minigrid pays 1 - 0.9 steps / 80 at the goal.
    assert episode.return_ == pytest.approx(1 - 0.9 * length / 80, abs=1e-5)
    assert episode.trajectory.obs[:length, 3].any()  # a closed door was ahead


@pytest.mark.slow
def test_the_kitchen_pays_in_turn() -> None:
    kitchen = world("kitchen").make()
    described = kitchen.described
    wrapper = described.make()
    wrapper.reset(seed=0, options={"order": [4, 1, 0, -1, -1]})
    assert wrapper.order == ["microwave", "light switch", "bottom burner"]
    assert kitchen.spec.obs == envs.make("kitchen").spec.obs
    assert kitchen.spec.actions == envs.make("kitchen").spec.actions
    task = kitchen.sample_task(jax.random.key(0))
    state, told = kitchen.reset(jax.random.key(0), task)
    assert told.obs.shape == (59,)
    assert task.goal.sum() == 3
    _, told = kitchen.step(state, jnp.zeros(9))
    assert not told.goal_reached
    assert told.reward == 0


def test_a_place_far_from_the_start_is_told_from_near_ones() -> None:
    pytest.importorskip("craftax")
    places = importlib.import_module("examples.crafter_places")
    iron = places.Achievement.COLLECT_IRON
    rows = np.zeros((4, places.NUM_ACHIEVEMENTS + 3), np.float32)
    rows[:3, iron.value] = 1
    rows[2, places.Achievement.COLLECT_COAL.value] = 1  # both at once
    known, cells = places.NUM_ACHIEVEMENTS, slice(places.NUM_ACHIEVEMENTS + 1, None)
    rows[:, known] = 1
    rows[:, cells] = np.array([[1, 2], [-20, 4], [9, -3], [30, 30]]) / places.PLACE_UNIT

    class Found:
        returns = np.zeros((1, 1, 2))

        def reached_in(self, seed: int, task: int, episode: int) -> tuple[np.ndarray, np.ndarray]:
            return np.arange(2), rows[2 * episode : 2 * episode + 2]

    goal = places.rare_goal(Found(), 0, iron)
    assert goal[: places.NUM_ACHIEVEMENTS].sum() == goal[iron.value] == 1
    np.testing.assert_allclose(goal[cells] * places.PLACE_UNIT, [9, -3])
    assert places.rare_goal(Found(), 0, places.Achievement.COLLECT_DIAMOND) is None
    np.testing.assert_allclose(places.mirrored(goal[None])[0, cells] * places.PLACE_UNIT, [-9, 3])

    # One episode unlocks it a step away from the place, one elsewhere, one never.
    achieved = np.zeros((3, 5, len(goal)), np.float32)
    achieved[0, 2] = goal
    achieved[0, 2, cells] += np.array([1, 0]) / places.PLACE_UNIT
    achieved[1, 4] = rows[1]
    trajectory = SimpleNamespace(goal_reached=achieved.any(axis=-1), achieved_goals=achieved)
    found = places.arrivals(SimpleNamespace(trajectory=trajectory), goal)
    np.testing.assert_allclose(found, (1 / 3, 2 / 3))


def test_what_the_policy_reached_in_crafter_itself_is_told() -> None:
    pytest.importorskip("craftax")
    itself = importlib.import_module("examples.crafter_itself")
    found = [
        Played(("wood", "coal"), (3, 9), 1.5, 20),
        Played(("wood",), (8,), 0.5, 12),
    ]
    text = itself.report(found, ("wood", "coal", "iron"), horizon=20)
    lines = [line.strip("| ").split(" | ") for line in text.splitlines()]
    told = {words[0]: words[1] for words in lines if len(words) == 2}
    assert told["return, mean ± standard error"] == "1.00 ± 0.50"
    assert told["died before the horizon"] == "50 %"
    assert (told["wood"], told["coal"], told["iron"]) == ("100 %", "50 %", "0 %")
    assert told["achieved"] == "50.0 %"


def test_ways_of_acting_are_compared() -> None:
    from examples.task_goal import rows

    returns = np.zeros((2, 3, 4))
    returns[0, 1] = 6.0  # one episode of each task
    greedy, sampled = rows([0.0, 1.0], returns)
    assert greedy[:3] == ["greedy", "12", "2.00 ± 0.85"]
    assert greedy[3:] == ["2.000 [2.000, 2.000]", "6.00"]
    assert sampled == ["sampled at 1", "12", "0.00 ± 0.00", "", "0.00"]


@pytest.mark.slow
def test_the_task_goal_alone_is_played() -> None:
    """On the validation tasks, and no two episodes at random."""
    from examples.task_goal import play

    returns = play("gridworld", [0.0, 1.0], episodes=2, validation=True)
    assert returns.shape == (2, 2, 50)
    assert (returns[1, 0] != returns[1, 1]).any()


def test_the_large_data_are_a_dataset_and_the_guide_has_their_training(tmp_path: Path) -> None:
    big_data = importlib.import_module("examples.big_data")
    big_data.write(tmp_path / "data", 3)
    dataset, _ = load_dataset(tmp_path / "data")
    assert dataset.lengths.tolist() == [50, 50, 50]
    assert dataset.obs.dtype == np.uint8
    assert len(np.unique(dataset.obs[::50].reshape(3, -1), axis=0)) == 3
    guide = " ".join((GUIDE.parent / "own-data.md").read_text().replace("\\\n", " ").split())
    assert f"--data /tmp/big_data {big_data.TRAINING} --out /tmp/big_run" in guide


@pytest.mark.slow
def test_the_memory_of_a_training_hardly_grows_with_its_data(tmp_path: Path) -> None:
    """Ten times the data, 300 MB instead of 30, take far less than those more bytes of memory."""
    peaks = []
    for num in (48, 480):
        words = (
            f"{tmp_path}/{num} --trajectories {num} --run {tmp_path}/run{num} --steps 10".split()
        )
        done = subprocess.run(
            [sys.executable, "-m", "examples.big_data", *words],
            cwd=ROOT, capture_output=True, text=True, check=True,
        )  # fmt: skip
        peaks.append(float(done.stdout.split("trained: peak ")[1].split(" MB")[0].replace(",", "")))
    assert peaks[1] - peaks[0] < 150, peaks
