"""Training, evaluation and test tasks are disjoint; the evaluations during a training."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.errors import DataError, UsageError
from envs.registry import Judgement
from envs.wrappers import Wrapper
from experiments import watching
from experiments.demonstrators import find_demonstrator
from experiments.watching import ReturnsOnTheWay
from mgpo_jax.network_configs import network_config
from mgpo_jax.optimizers.methods import judged_query
from mgpo_jax.prompts import single_goal
from mgpo_jax.released import released_folder
from mgpo_jax.tasks import (
    benchmark_tasks,
    evaluation_tasks,
    load_tasks,
    num_tasks,
    sample_tasks,
    save_tasks,
    task_at,
    task_hashes,
)
from mgpo_jax.tasks import (
    test_tasks as tasks_to_test,  # pytest would take it for a test
)
from mgpo_jax.transformer import GoalTransformer

NUM = 50
GREEDY = Judgement()


def assert_trees_equal(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.parametrize("name", ["maze15", "gridworld", "kitchen"])
def test_evaluation_tasks_are_no_test_tasks(name):
    env = envs.make(name)
    tasks = evaluation_tasks(env, 64, NUM)
    assert num_tasks(tasks) == 64
    assert not np.isin(task_hashes(env, tasks), task_hashes(env, benchmark_tasks(env, NUM))).any()


@pytest.mark.parametrize("name", ["maze15", "kitchen"])
def test_other_validation_tasks_share_none_with_those_that_watch_trainings(name):
    env = envs.make(name)
    num = 25
    watched = task_hashes(env, evaluation_tasks(env, 64, NUM))  # of which a training evaluates 64
    for seed in (1, 2, 3):
        others = task_hashes(env, evaluation_tasks(env, num, NUM, seed=seed))
        assert len(others) == num
        assert not np.isin(others, watched).any()
        assert not np.isin(others, task_hashes(env, benchmark_tasks(env, NUM))).any()


@pytest.mark.parametrize("name", ["maze15", "gridworld", "kitchen"])
def test_test_tasks_are_those_that_were_released(name):
    """And those that anyone would draw; none is there twice."""
    world = envs.find(name)
    env, tasks = world.make(), tasks_to_test(name)
    assert num_tasks(tasks) == world.num_test_tasks
    assert_trees_equal(tasks, load_tasks(released_folder(world) / "tasks.npz", env))
    drawn = benchmark_tasks(env, world.num_test_tasks)
    assert_trees_equal(tasks, jax.tree.map(np.asarray, drawn))
    rows = [np.asarray(leaf).reshape(num_tasks(tasks), -1) for leaf in jax.tree.leaves(tasks)]
    assert len(np.unique(np.concatenate(rows, axis=1), axis=0)) == num_tasks(tasks)


@dataclass(frozen=True)
class OfFew(Wrapper):
    """A world of ``num`` tasks."""

    num: int = 1

    def sample_task(self, key):
        which = jax.random.randint(key, (), 0, self.num)
        return self.env.sample_task(jax.random.key(which))


def test_worlds_of_few_tasks():
    few = OfFew(envs.make("gridworld"), 40)
    tasks = benchmark_tasks(few, 20)
    assert len(np.unique(task_hashes(few, tasks))) == 20
    with pytest.raises(
        DataError,
        match=r"82 random tasks of gridworld include only .* different ones, too few for 41 test tasks",
    ):
        benchmark_tasks(few, 41)
    others = evaluation_tasks(few, 5, 20)
    assert not np.isin(task_hashes(few, others), task_hashes(few, tasks)).any()
    two = OfFew(envs.make("gridworld"), 2)
    with pytest.raises(
        DataError, match="of 2 random tasks of gridworld, only 0 are not test tasks"
    ):
        evaluation_tasks(two, 1, 2)


@pytest.mark.parametrize("name", ["maze15", "gridworld"])
def test_tasks_in_a_file_come_back(name, tmp_path):
    env = envs.make(name)
    tasks = jax.tree.map(np.asarray, sample_tasks(env, 3, 4))
    save_tasks(tmp_path / "tasks.npz", tasks)
    loaded = load_tasks(tmp_path / "tasks.npz", env)
    assert_trees_equal(loaded, tasks)
    for index in range(4):
        assert_trees_equal(task_at(loaded, index), task_at(tasks, index))


def test_files_that_hold_no_tasks(tmp_path):
    env, path = envs.make("maze15"), tmp_path / "tasks.npz"
    with pytest.raises(UsageError, match="no task file"):
        load_tasks(path, env)
    tasks = sample_tasks(env, 3, 2)
    np.savez(path, maze=tasks.maze)
    with pytest.raises(DataError, match="lacks goal; tasks of maze15 need the arrays maze, goal"):
        load_tasks(path, env)
    np.savez(path, maze=tasks.maze[:0], goal=tasks.goal[:0])
    with pytest.raises(DataError, match=r"maze has shape \[0, 15, 15\], wanted \[task 1 to"):
        load_tasks(path, env)
    np.savez(path, maze=tasks.maze, goal=tasks.goal * 0)
    with pytest.raises(DataError, match=r"tasks\.npz: task 0: goal \(0, 0\) is not a free cell"):
        load_tasks(path, env)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: {"maze": t.maze.astype(complex)}, "maze must hold integers, found complex128"),
        (lambda t: {"goal": t.goal.astype("m8[s]")}, "goal must hold integers, found timedelta64"),
        (lambda t: {"maze": t.maze.astype(str)}, "maze must hold integers, found <U"),
        (
            lambda t: {"goal": t.goal.astype(np.int64) + 2**40},
            r"goal holds .* at task 0, must be from -2147483648",
        ),
        (lambda t: {"maze": np.array([None] * 2)}, "maze must hold integers, found object"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_arrays_that_are_no_numbers_of_tasks(tmp_path, change, says):
    """Nothing is converted with a warning, and no pickle is opened."""
    env, path = envs.make("maze15"), tmp_path / "tasks.npz"
    tasks = jax.tree.map(np.asarray, sample_tasks(env, 3, 2))
    np.savez(path, **{**tasks._asdict(), **change(tasks)})
    with pytest.raises(DataError, match=f"{says}.*tasks of maze15 need the arrays maze, goal"):
        load_tasks(path, env)


@pytest.mark.parametrize("dtype", [">i8", np.uint8, np.uint64])
def test_tasks_of_foreign_tools_are_converted(tmp_path, dtype):
    env, path = envs.make("maze15"), tmp_path / "tasks.npz"
    tasks = jax.tree.map(np.asarray, sample_tasks(env, 3, 2))
    np.savez(path, **{k: np.asfortranarray(v.astype(dtype)) for k, v in tasks._asdict().items()})
    assert_trees_equal(load_tasks(path, env), tasks)
    assert load_tasks(path, env).maze.dtype == np.int32


@pytest.mark.parametrize(("name", "demonstrates"), [("gridworld", True), ("maze15", False)])
def test_what_a_policy_makes_of_a_demonstration(name, demonstrates, monkeypatch):
    """Is measured where the demonstrator does the task at hand."""
    world = envs.find(name)
    env = world.make()
    config = network_config(env.spec, embed_dim=8, num_layers=1, num_heads=1, dropout=0.0)
    _, demonstrator = find_demonstrator(world, env, None)
    prompt = single_goal(env.task_goal(env.sample_task(jax.random.key(0))), 5)
    obs = jnp.zeros((2, *env.spec.obs.shape))
    params = GoalTransformer(config).init(jax.random.key(0), prompt, obs, jnp.zeros(2, jnp.int32))
    asked = []

    def noted(prompt, judged):
        asked.append(judged)
        return judged_query(prompt, judged)

    # Policies act there as the world judges them.
    monkeypatch.setattr(watching, "judged_query", noted)
    world = replace(world, judged=Judgement("sample", 0.5, episodes=3) if demonstrates else GREEDY)
    evaluated = ReturnsOnTheWay(world, env, config, demonstrator, 4)
    found = evaluated(params)
    assert set(asked) == {world.judged}
    assert ("eval/followed_return" in found) == demonstrates
    assert all(np.isfinite(value) for value in found.values())
    assert found["eval/initial_return"] < 0.9
    check_what_is_reported(evaluated, params, demonstrates)


def check_what_is_reported(evaluated, params, demonstrates):
    """As if the return of an episode were a tenth of the number of goals in its prompt."""
    evaluated._returns = lambda params, keys, tasks, prompts: prompts.mask.sum(axis=-1) / 10
    if demonstrates:  # the last of four demonstrations does not count, and has the longest prompt
        mask = evaluated._followed.mask.at[0, :].set(jnp.arange(5) >= 3).at[3].set(True)
        evaluated._followed = evaluated._followed._replace(mask=mask)
        evaluated._perfect = np.array([True, True, True, False])
        shares = np.asarray(mask[:3]).sum(axis=-1) / 10
    found = evaluated(params)
    assert found["eval/initial_return"] == pytest.approx(0.1)
    assert found["eval/initial_regret"] == pytest.approx(np.mean(evaluated.optimum) - 0.1)
    if demonstrates:
        assert found["eval/followed_return"] == pytest.approx(shares.mean()) != 0.1
