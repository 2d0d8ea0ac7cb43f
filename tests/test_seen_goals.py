"""The goals seen in a training, and warnings of goals far from them."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_np
from pages_js import needs_node

import envs
from envs.errors import DataError
from experiments import adaptation
from experiments.adapt import command as adapt_command
from experiments.adaptation import results_with_summary
from experiments.evaluate import command as evaluate_command
from experiments.pages.build import SCRIPTS, Bundle
from experiments.pages.packing import unpacked
from experiments.pages.playground import world_data
from experiments.pages.report import report_data
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.policies import far_prompts, seen_goals_of
from experiments.store.result_files import load_results
from experiments.store.rows import read_row
from mgpo_jax import tasks as tasks_of
from mgpo_jax.dataset import Dataset
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy_files import (
    load_policy,
    read_policy,
    read_seen_goals,
    save_policy,
    write_seen_goals,
)
from mgpo_jax.prompts import single_goal
from mgpo_jax.released import released_folder
from mgpo_jax.seen_goals import (
    MOST_KEPT,
    SeenGoals,
    covering,
    seen_in,
    warning_of_goals,
    warning_of_prompts,
)
from mgpo_jax.transformer import GoalTransformer

ROOT = Path(__file__).parents[1]
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
    seen = covering(goals)
    assert not seen.far(goals).any()
    # Nor after a file has rounded the distance to single precision.
    assert not seen._replace(reach=float(np.float32(seen.reach))).far(goals).any()


def test_of_many_goals_some_are_kept_that_cover_the_others() -> None:
    goals = np.random.default_rng(0).uniform(size=(5000, 2)).astype(np.float32)
    seen = covering(goals)
    assert len(seen.goals) == MOST_KEPT
    distances = np.linalg.norm(goals[:, None].astype(np.float64) - seen.goals, axis=-1).min(axis=1)
    assert distances.max() == pytest.approx(seen.reach)
    assert seen.reach < 0.03
    assert not seen.far(goals).any()


def dataset(
    goals: np.ndarray, lengths: list[int], reached: np.ndarray | None = None, outcomes: Any = None
) -> Dataset:
    total = len(goals)
    return Dataset(
        obs=np.zeros((total, 1), np.float32),
        actions=np.zeros(total, np.int32),
        achieved_goals=goals.astype(np.float32),
        goal_reached=np.ones(total, bool) if reached is None else reached,
        outcomes=np.asarray(goals if outcomes is None else outcomes, np.float32),
        lengths=np.asarray(lengths, np.int32),
    )


def test_goals_are_those_of_all_trajectories(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = seen_in(dataset(GRID, [3, 5, 8]))
    assert len(seen.goals) == 16
    monkeypatch.setattr("mgpo_jax.seen_goals.MOST_TRAJECTORIES", 2)
    few = seen_in(dataset(GRID, [3, 5, 8]))
    assert len(few.goals) in (8, 11, 13)


def test_steps_that_reach_nothing_have_no_goal_and_outcomes_are_goals_too() -> None:
    goals = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    outcomes = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    reached = goals.any(axis=1)
    seen = seen_in(dataset(goals, [4], reached, outcomes))
    assert sorted(map(tuple, seen.goals)) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    seen = seen_in(dataset(goals, [4], reached, outcomes[-1:].repeat(4, axis=0)))
    assert sorted(map(tuple, seen.goals)) == [(0, 1), (1, 0), (1, 1)]


def test_a_training_that_goes_on_knows_the_goals_of_both() -> None:
    half, other = covering(GRID[:8]), covering(GRID[8:])
    joined = half.joined(other)
    assert len(joined.goals) == 16
    assert not joined.far(GRID).any()
    assert half.joined(None) is half
    again = seen_in(dataset(GRID[8:], [8]), before=half)
    np.testing.assert_array_equal(again.goals, other.joined(half).goals)


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


def far_of(method: str) -> list[bool]:
    """Which optimized prompts of published results the page of a report marks."""
    folder = ROOT / "results" / "maze15" / method
    found = report_data({folder: load_results(folder)}, [read_row(folder)])
    (run,) = found["runs"]
    arrays = unpacked(run["arrays"])
    assert ("prompts far from training goals", far_prompts(load_results(folder))) in run["facts"]
    rows = arrays["prompts"][arrays["best"][:, :, -1]].astype(int)
    return list(((rows > 0) & (arrays["far"][rows - 1] == 1)).any(axis=-1).ravel())


def test_reports_mark_invented_goals() -> None:
    assert not any(far_of("ucb"))  # its goals were reached in episodes
    far = far_of("bbt")  # moves goals to anywhere
    said = far_prompts(load_results(ROOT / "results" / "maze15" / "bbt"))
    assert said.startswith(f"{sum(far)} of {len(far)} optimized prompts lie far")
    assert sum(far) > 50


@pytest.mark.parametrize("where", ["other weights", "damaged", "not kept"])
def test_a_report_goes_without_goals_that_it_cannot_trust(
    tmp_path: Path, params: dict, where: str
) -> None:
    folder = ROOT / "results" / "maze15" / "bbt"
    results = load_results(folder)
    place = tmp_path / "policy"
    if where == "other weights":
        save_policy(place, CONFIG, params, {}, covering(GRID))
    else:
        shutil.copytree(released_folder(results.world), place)
        (place / "goals.npz").unlink()
        if where == "damaged":
            (place / "goals.npz").write_bytes(b"no archive")
    moved = replace(results, config={**results.config, "policy": str(place)}, folder=None)
    assert seen_goals_of(moved) is None
    assert far_prompts(moved) == ""


def test_commands_warn_of_goals_that_no_demonstration_reached(
    tmp_path: Path, params: dict, capsys: pytest.CaptureFixture[str]
) -> None:
    policy, out = tmp_path / "policy", tmp_path / "out"
    save_policy(
        policy, CONFIG, params, {"env": "maze15"}, covering(np.array([[0.5, 0.5], [0.5, 0.6]]))
    )
    world = envs.find("maze15")
    tasks = jax.tree.map(lambda leaf: leaf[:2], tasks_of.test_tasks(world))
    tasks_of.save_tasks(tmp_path / "tasks.npz", tasks)
    words = ["--policy", str(policy), "--tasks", str(tmp_path / "tasks.npz"), "--out", str(out)]
    short = ["--episodes", "4", "--seeds", "1", "--no-figures"]
    with pytest.raises(SystemExit) as stop:
        adapt_command([*words, *short])
    assert stop.value.code == 0
    said = capsys.readouterr().err
    assert (
        "warning: 2 of 2 task goals lie far from all goals that the policy was trained on" in said
    )
    assert f"warning: 2 of 2 optimized prompts of {out} lie far" in said
    with pytest.raises(SystemExit) as stop:
        evaluate_command([str(out), "--episodes", "1"])
    assert stop.value.code == 0
    assert f"warning: 2 of 2 prompts of {out} lie far" in capsys.readouterr().err


def test_sweeps_and_comparisons_warn_like_single_adaptations(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """They all make their results by the same function."""
    found = load_results(ROOT / "results" / "maze15" / "bbt")
    monkeypatch.setattr(adaptation, "results_of", lambda *given: found)
    monkeypatch.setattr(adaptation, "summarize", lambda *given, **more: found.summary)
    env: Any = SimpleNamespace(optimal_return=lambda task: 0.0)
    policy: Any = SimpleNamespace(sha256="")
    outcome: Any = SimpleNamespace(num_episodes=0, num_failed=0, cpu_seconds=0.0)
    config = AdaptConfig(out=Path("sweep/c=1"))
    results_with_summary(config, env, policy, np.zeros(2), outcome)
    assert "optimized prompts of sweep/c=1 lie far" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["maze15", "maze30", "gridworld", "kitchen", "crafter-symbolic"])
def test_released_policies_know_the_goals_of_their_tasks(name: str) -> None:
    policy, world = load_policy(name), envs.find(name)
    goals = np.asarray(jax.vmap(world.make().task_goal)(tasks_of.test_tasks(world)))
    assert policy.seen_goals is not None
    assert not policy.seen_goals.far(goals).any()


@needs_node
def test_a_playground_marks_far_goals_as_python_does() -> None:
    world, policy = envs.find("maze15"), load_policy("maze15")
    goals = np.random.default_rng(0).uniform(-0.2, 1.2, size=(60, 2)).astype(np.float32)
    bundle = Bundle()
    module = bundle.add(SCRIPTS / "seen.js")
    seen = json.dumps(world_data(world, policy)["seen"])
    script = (
        f"{bundle.source}{module}.farFrom({seen}).then((isFar) => "
        f"console.log(JSON.stringify({json.dumps(goals.tolist())}.map(isFar))));"
    )
    done = subprocess.run(["node", "-e", script], check=True, capture_output=True, text=True)
    assert policy.seen_goals is not None
    assert json.loads(done.stdout) == policy.seen_goals.far(goals).tolist()
    assert 5 < sum(json.loads(done.stdout)) < 55
