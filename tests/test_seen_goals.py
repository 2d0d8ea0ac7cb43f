"""Goals of a training, and goals that lie far from them."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_np

import envs
from envs.errors import DataError
from mgpo_jax.dataset import Dataset
from mgpo_jax.policy_files import read_policy, read_seen_goals, save_policy, write_seen_goals
from mgpo_jax.prompts import single_goal
from mgpo_jax.seen_goals import (
    MOST_KEPT,
    SeenGoals,
    covering,
    seen_in,
    warning_of_goals,
    warning_of_prompts,
)
from mgpo_jax.transformer import GoalTransformer, network_config

CONFIG = network_config(envs.make("maze15").spec, embed_dim=8, num_layers=1)
GRID = np.stack(np.meshgrid(np.arange(4), np.arange(4)), -1).reshape(-1, 2) / 4


@pytest.fixture(scope="module")
def params() -> dict:
    prompt = single_goal(jnp.zeros(CONFIG.goal_dim), CONFIG.max_prompt_length)
    obs, actions = jnp.zeros((1, *CONFIG.obs_shape)), jnp.zeros(1, jnp.int32)
    return GoalTransformer(CONFIG).init(jax.random.key(0), prompt, obs, actions)


def test_cells_of_a_grid_are_all_kept_and_half_a_cell_is_near() -> None:
    seen = covering(np.concatenate([GRID, GRID]))
    assert sorted(map(tuple, seen.goals)) == sorted(map(tuple, GRID.astype(np.float32)))
    assert seen.reach == pytest.approx(0.125)
    near = [[0.0, 0.0], [0.1, 0.0], [0.75, 0.85]]
    far = [[0.0, 0.9], [-0.2, 0.0], [0.125, 0.13]]
    np.testing.assert_array_equal(seen.far(near), [False] * 3)
    np.testing.assert_array_equal(seen.far(far), [True] * 3)
    np.testing.assert_allclose(seen.distances([[[0.0, 0.95]], [[0.0, 0.0]]]), [[0.2], [0.0]])


def test_between_one_hot_goals_nothing_is_near() -> None:
    seen = covering(np.eye(5))
    np.testing.assert_array_equal(
        seen.far([np.eye(5)[2], np.zeros(5), np.ones(5), 0.9 * np.eye(5)[0]]),
        [False, True, True, False],
    )


def test_one_goal_is_near_to_itself_only() -> None:
    seen = covering(np.full((3, 2), 0.5))
    np.testing.assert_array_equal(seen.far([[0.5, 0.5], [0.5, 0.51]]), [False, True])


@settings(max_examples=30, deadline=None)
@given(
    st_np.arrays(
        np.float32,
        st.tuples(st.integers(1, 60), st.integers(1, 4)),
        elements=st.floats(-3, 3, width=32),
    )
)
def test_no_goal_of_the_data_is_far(goals: np.ndarray) -> None:
    assert not covering(goals).far(goals).any()


def test_of_many_goals_some_are_kept_that_cover_the_others() -> None:
    goals = np.random.default_rng(0).uniform(size=(5000, 2)).astype(np.float32)
    seen = covering(goals)
    assert len(seen.goals) == MOST_KEPT
    distances = np.linalg.norm(goals[:, None].astype(np.float64) - seen.goals, axis=-1).min(axis=1)
    assert distances.max() == pytest.approx(seen.reach)
    assert seen.reach < 0.03
    assert not seen.far(goals).any()


def dataset(goals: np.ndarray, lengths: list[int]) -> Dataset:
    total = len(goals)
    return Dataset(
        obs=np.zeros((total, 1), np.float32),
        actions=np.zeros(total, np.int32),
        achieved_goals=goals.astype(np.float32),
        goal_reached=np.ones(total, bool),
        outcomes=goals.astype(np.float32),
        lengths=np.asarray(lengths, np.int32),
    )


def test_goals_are_those_of_all_trajectories(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = seen_in(dataset(GRID, [3, 5, 8]))
    assert len(seen.goals) == 16
    monkeypatch.setattr("mgpo_jax.seen_goals.MOST_TRAJECTORIES", 2)
    few = seen_in(dataset(GRID, [3, 5, 8]))
    assert len(few.goals) in (8, 11, 13)


def test_a_training_that_goes_on_knows_the_goals_of_both() -> None:
    half, other = covering(GRID[:8]), covering(GRID[8:])
    joined = half.joined(other)
    assert len(joined.goals) == 16
    assert not joined.far(GRID).any()
    assert half.joined(None) is half


def test_warnings_count_and_say_how_far() -> None:
    seen = covering(GRID)
    assert warning_of_goals(seen, GRID, "task goals") == ""
    assert warning_of_goals(None, np.full((1, 2), 9.0), "task goals") == ""
    said = warning_of_goals(seen, [[0.0, 0.0], [0.0, 1.75]], "task goals")
    assert said.startswith(
        "1 of 2 task goals lie far from all goals that the policy was trained on"
    )
    assert "up to 1 from the nearest one, where goals within 0.125 count as near" in said
    prompts = np.zeros((2, 3, 2))
    prompts[:, 0] = 5.0
    mask = np.array([[False, True, True], [True, True, True]])
    assert warning_of_prompts(seen, prompts, mask, "prompts").startswith("1 of 2 prompts")
    assert warning_of_prompts(seen, prompts, mask & [False, True, True], "prompts") == ""


def test_a_policy_keeps_them(tmp_path: Path, params: dict) -> None:
    seen = covering(np.eye(CONFIG.goal_dim))
    save_policy(tmp_path / "new", CONFIG, params, {}, seen)
    found = read_policy(tmp_path / "new").seen_goals
    assert found is not None
    np.testing.assert_array_equal(found.goals, seen.goals)
    assert found.reach == pytest.approx(seen.reach)
    save_policy(tmp_path / "new", CONFIG, params, {})  # other weights, whose goals are not known
    assert read_policy(tmp_path / "new").seen_goals is None


@pytest.mark.parametrize(
    ("seen", "says"),
    [
        (SeenGoals(np.zeros((1, 99), np.float32), 0.1), "goals of 99 numbers"),
        (SeenGoals(np.full((1, 2), np.nan, np.float32), 0.1), "goals"),
        (SeenGoals(np.zeros((1, 2), np.float32), -1.0), "reach"),
    ],
)
def test_damaged_goals_are_refused(
    tmp_path: Path, params: dict, seen: SeenGoals, says: str
) -> None:
    save_policy(tmp_path / "policy", CONFIG, params, {})
    write_seen_goals(tmp_path / "policy", seen)
    with pytest.raises(DataError, match=says):
        read_policy(tmp_path / "policy")
    assert read_seen_goals(tmp_path) is None
