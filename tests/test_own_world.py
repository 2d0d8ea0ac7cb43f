"""A user's own world in one file outside of the package: every command runs, from data to tables."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_world import CELLS, Doors, Line

from envs.episodes import replay
from experiments import runtime
from experiments.store.result_files import load_results
from mgpo_jax import methods
from mgpo_jax.kinds import MULTI_GOAL
from mgpo_jax.tasks import task_at

ROOT = Path(__file__).parents[1]
ENV = "--env own_world:WORLD"
TINY = (
    "--preset smoke --trajectories 40 --holdout 8 --embed-dim 8 --num-layers 1 --num-heads 2 "
    "--steps 4 --batch-size 8 --part-size 4 --eval-tasks 2 --eval-every 2 --save-every 4 --out run"
)


class Done(NamedTuple):
    """What a command left behind."""

    code: int
    out: str
    err: str


Run = Callable[[str], Done]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The current folder, which holds nothing but the file of the world and what commands write."""
    here = tmp_path_factory.mktemp("own")
    shutil.copy(Path(__file__).with_name("own_world.py"), here)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        patch.delenv("MGPO_DATA", raising=False)
        patch.setattr(runtime, "configure", lambda: None)
        patch.setattr(sys, "path", list(sys.path))
        yield here


@pytest.fixture
def command(folder: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command line in this process."""

    def call(line: str) -> Done:
        name, *words = line.split()
        capsys.readouterr()
        with pytest.raises(SystemExit) as stop:
            importlib.import_module(f"experiments.{name}").command(words)
        return Done(int(stop.value.code or 0), *capsys.readouterr())

    return call


@pytest.fixture(scope="module")
def policy(folder: Path) -> Path:
    """A policy of four gradient steps, on a dataset that a process of its own collected."""
    line = f"-m experiments.collect {ENV} --trajectories 40"
    path = {"PYTHONPATH": str(ROOT), "MGPO_CACHE": str(folder / "cache")}
    words, path = [sys.executable, *line.split()], {**os.environ, **path}
    done = subprocess.run(words, check=False, env=path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (folder / "data/line/knowing-40-seed0/trajectories.npz").is_file()
    with pytest.raises(SystemExit) as stop:
        importlib.import_module("experiments.pretrain").command(f"{ENV} {TINY}".split())
    assert stop.value.code == 0
    return folder / "run" / "policy"


def adapt(method: str) -> str:
    return (
        f"adapt {ENV} --policy run/policy --method {method} --seeds 2 --episodes 6 --eval-every 3 "
        f"--out {method}"
    )


@pytest.fixture(scope="module")
def results(folder: Path, policy: Path) -> Path:
    """Results of UCB."""
    with pytest.raises(SystemExit) as stop:
        importlib.import_module("experiments.adapt").command(adapt("ucb").split()[1:])
    assert stop.value.code == 0
    return folder / "ucb"


def test_the_dataset_holds_the_world_as_it_is(folder: Path, policy: Path) -> None:
    with np.load(folder / "data/line/knowing-40-seed0/trajectories.npz") as file:
        assert file["obs"].dtype == np.uint8
        assert file["obs"].shape[1:] == (3, 3)
        assert file["lengths"].max() <= 12
    network = json.loads((policy / "config.json").read_text())["network"]
    assert (network["obs_shape"], network["obs_dtype"]) == ([3, 3], "uint8")
    rows = (folder / "run/metrics.jsonl").read_text().splitlines()
    assert [json.loads(row)["step"] for row in rows] == [2, 4]
    assert not any("regret" in row for row in rows)


OTHERS = [
    name
    for name in methods.names()
    if name not in ("ucb", "grips") and methods.find(name).policy == MULTI_GOAL
]


@pytest.mark.parametrize("method", OTHERS)
def test_methods_adapt(command: Run, policy: Path, method: str) -> None:
    rounds = " --round-episodes 3" if hasattr(methods.find(method).hyper, "round_episodes") else ""
    done = command(adapt(method) + rounds)
    assert done.code == 0, done.err
    assert f"own_world:WORLD, {method}: 4 tasks x 2 seeds x 6 episodes" in done.out
    check_without_optimum(Path(method), done.out)


def check_without_optimum(folder: Path, printed: str) -> None:
    """The optimum is unknown, and nothing pretends otherwise."""
    summary = json.loads((folder / "summary.json").read_text())
    for name in ("optimal_return", "regret", "regret_std_over_seeds", "regret_after_40"):
        assert summary[name] is None
    assert summary["solved_optimally"] is None
    assert "NaN" not in (folder / "summary.json").read_text()
    assert not any(word in printed for word in ("regret", "optimal", "nan"))
    with np.load(folder / "results.npz") as file:
        assert "optimal_returns" not in file


def test_methods_that_insert_random_goals_refuse_in_one_line(command: Run, policy: Path) -> None:
    done = command(adapt("grips"))
    assert done.code == 2
    assert "line draws no goals at random" in done.err
    assert len(done.err.strip().splitlines()) == 1
    assert not Path("grips").exists()


def test_results_are_those_of_the_episodes(command: Run, results: Path) -> None:
    """Each episode can be played again from what is kept of it."""
    check_without_optimum(results, "")
    found, env = load_results(results), Line()
    assert found.keys is None  # nothing is left to chance, and the actions say it all
    assert found.actions.shape == (2, 4, 6, 12)
    assert found.actions.dtype == np.uint8
    again = jax.jit(lambda *args: replay(args[0], env, *args[1:]))
    first = 0
    for place in np.ndindex(found.returns.shape):
        actions = found.actions[place]
        length = int((actions < 255).sum())
        assert (actions[:length] < 3).all()
        assert (actions[length:] == 255).all()
        task = jax.tree.map(jnp.asarray, task_at(found.task_set, place[1]))
        episode = again(jax.random.key(0), task, jnp.minimum(actions, 2).astype(jnp.int32), length)
        assert episode.trajectory.length == length
        assert episode.return_ == found.returns[place]
        steps = np.flatnonzero(np.asarray(episode.trajectory.goal_reached)[:length])
        last = first + found.reached.counts[place]
        np.testing.assert_array_equal(found.reached.steps[first:last], steps)
        np.testing.assert_array_equal(
            found.reached.goals[first:last], episode.trajectory.achieved_goals[steps]
        )
        first = last
    assert first == len(found.reached.steps) > 0


def test_results_are_evaluated_drawn_and_tabled(command: Run, results: Path) -> None:
    done = command("evaluate ucb --action-noise 0 0.5 --episodes 2 --json noise.json")
    assert done.code == 0, done.err
    still, noisy = json.loads(Path("noise.json").read_text())["rows"]
    assert (still["noise"], noisy["noise"]) == ("none", "actions 0.5")
    assert still["change"] == pytest.approx(0)
    assert 0 <= noisy["return"] <= 1

    done = command("plot ucb --out figures")
    assert done.code == 0, done.err
    drawn = [path.name for path in Path("figures").iterdir()]
    assert drawn == ["own_world.WORLD_learning_curve.png"]
    assert Path("ucb/learning_curve.png").is_file()

    done = command("table ucb")
    assert done.code == 0, done.err
    head, _, row = ([cell.strip() for cell in line.split("|")] for line in done.out.splitlines())
    cells = dict(zip(head, row, strict=True))
    assert (cells["env"], cells["method"]) == ("own_world:WORLD", "ucb")
    for name in ("optimum", "regret", "after 40", "solved optimally", "paper: final"):
        assert cells[name] == ""


def test_the_policy_is_released(command: Run, policy: Path) -> None:
    done = command("release run --out packed")
    assert done.code == 0, done.err
    assert "40 demonstrations of knowing, seed 0" in Path("packed/README.md").read_text()
    with np.load("packed/tasks.npz") as file:
        assert file["order"].shape == (4, 2)


@pytest.mark.slow
def test_its_speed_is_measured(command: Run, policy: Path) -> None:
    done = command(f"bench {ENV} --quick --trajectories 100")
    assert done.code == 0, done.err
    assert "untrained policy, 4 tasks x 3 seeds x 20 episodes" in done.out


def test_noise_on_integers_is_refused(command: Run, results: Path) -> None:
    done = command("evaluate ucb --obs-noise 0.1")
    assert done.code == 2
    assert "needs floating-point observations, those of line are uint8[3, 3]" in done.err


def test_own_tasks(command: Run, policy: Path) -> None:
    np.savez("mine.npz", start=[0], order=[[4, 8]])
    line = f"{adapt('gcbc')} --no-figures".replace("--out gcbc", "--out mine --tasks mine.npz")
    done = command(line)
    assert done.code == 0, done.err
    assert load_results(Path("mine")).returns.shape == (2, 1, 6)
    np.savez("mine.npz", start=[0], order=[4])
    done = command(line.replace("--out mine", "--out other"))
    assert done.code == 1
    assert "order has shape [1], wanted [task 1, 2]" in done.err


@pytest.mark.parametrize("name", ["collect", "pretrain --preset smoke"])
def test_without_demonstrators_nothing_is_collected(command: Run, name: str) -> None:
    done = command(f"{name} --env own_world:UNSHOWN --out nothing")
    assert done.code == 2
    assert "line-unshown has no demonstrators" in done.err
    assert len(done.err.strip().splitlines()) == 1
    assert not Path("nothing").exists()


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("own_word:WORLD", "cannot load the world 'own_word:WORLD': No module named 'own_word'"),
        ("own_world:WORD", "has no attribute 'WORD'"),
        (
            "own_world:Line",
            "own_world:Line is a type; the place of a world must be that of a World",
        ),
    ],
)
def test_wrong_places(command: Run, place: str, says: str) -> None:
    done = command(f"collect --env {place}")
    assert done.code == 2
    assert says in done.err


def test_the_world_does_what_its_text_says() -> None:
    env, right = Line(), jnp.int32(2)
    task = Doors(jnp.int32(3), jnp.array([5, 4]))
    np.testing.assert_array_equal(env.task_goal(task), np.isin(np.arange(CELLS), [4, 5]))
    state, seen = env.reset(jax.random.key(0), task)
    assert seen.obs.tolist() == [[0, 0, 0], [1, 0, 0], [0, 0, 0]]
    rewards = []
    for action in (right, right, right - 2, right):
        state, seen = env.step(state, action)
        rewards.append(float(seen.reward))
    assert rewards == [0, 0.5, 0.5, 0]  # the nearer door opens last; then nothing changes
    assert bool(seen.terminated)
    assert int(state.cell) == 4
