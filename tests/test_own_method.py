"""A user's own method in one file outside of the package: it adapts, and its settings are flags."""

from __future__ import annotations

import importlib
import json
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_method import METHOD, LuckyHyper
from own_world import Line

import mgpo_jax
from experiments import runtime
from experiments.store.result_files import load_results
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.prompts import single_goal
from mgpo_jax.tasks import sample_tasks
from mgpo_jax.transformer import GoalTransformer


class Done(NamedTuple):
    """What a command left behind."""

    code: int
    out: str
    err: str


Run = Callable[[str], Done]


def untrained() -> LoadedPolicy:
    """A policy for the world of ``own_world.py``."""
    spec = Line().spec
    config = network_config(spec, embed_dim=8, num_layers=1, num_heads=2, max_prompt_length=4)
    prompt = single_goal(jnp.zeros(spec.goal_dim), config.max_prompt_length)
    obs, actions = jnp.zeros((1, *spec.obs.shape), spec.obs.dtype), jnp.zeros(1, jnp.int32)
    params = GoalTransformer(config).init(jax.random.key(1), prompt, obs, actions)
    return LoadedPolicy(config, params, {})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The current folder, with the files of a method and a world, and a policy."""
    here = tmp_path_factory.mktemp("own")
    for name in ("own_world.py", "own_method.py"):
        shutil.copy(Path(__file__).with_name(name), here)
    policy = untrained()
    mgpo_jax.save_policy(here / "policy", policy.config, policy.params, {"env": "own_world:WORLD"})
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        patch.setattr(runtime, "configure", lambda: None)
        patch.setattr(sys, "path", list(sys.path))
        yield here


@pytest.fixture
def adapt(folder: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Adapts with the method as a command line says."""
    command = importlib.import_module("experiments.adapt").command
    words = "--env own_world:WORLD --policy policy --seeds 1 --episodes 5"

    def call(line: str) -> Done:
        method = "" if "--method" in line else "--method own_method:METHOD"
        with pytest.raises(SystemExit) as stop:
            command(f"{words} {method} {line}".split())
        return Done(int(stop.value.code or 0), *capsys.readouterr())

    return call


def test_it_adapts_as_its_flags_say(adapt: Run) -> None:
    done = adapt("--longest 1 --thrift 0.25 --no-figures")
    assert done.code == 0, done.err
    assert "own_world:WORLD, own_method:METHOD: 4 tasks x 1 seeds x 5 episodes" in done.out
    folder = Path("runs/adapt/own_world.WORLD/own_method.METHOD-seed0")
    config = json.loads((folder / "config.json").read_text())
    assert config["hyper"] == {"longest": 1, "thrift": 0.25}
    results = load_results(folder)
    assert results.method == "own_method:METHOD"
    assert results.choices["prompt.mask"].sum(axis=-1).max() == 1


def test_its_settings_are_in_the_help(adapt: Run) -> None:
    done = adapt("--help")
    assert done.code == 0
    text = " ".join(done.out.replace("│", " ").split())
    longest = "--longest INT Goals of the longest prompt to draw."
    assert f"{longest} (at least 1, below 2147483648; default: 3)" in text
    thrift = "--thrift FLOAT How much better a prompt must be to be kept."
    assert f"{thrift} (at least 0, at most 1000000000; default: 0.0)" in text
    assert "--keep-rewarded" not in text


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        ("--longest 0", "--longest must be at least 1, found 0"),
        ("--thrift -1", "--thrift must be at least 0, found -1"),
        ("--thrift inf", "--thrift must be a finite number, found inf"),
        ("--thrift much", "--thrift must be a number, found 'much'"),
        ("--c 2", "--c is not a setting of lucky; it belongs to ucb"),
        ("--keep-rewarded", "is not a setting of lucky; it belongs to ucb, bpe, explore"),
        (
            "--method own_method:LuckyHyper",
            "own_method:LuckyHyper is a type; the place of a method must",
        ),
        ("--method own_method:METHODS", "cannot load the method 'own_method:METHODS'"),
    ],
)
def test_bad_values_are_refused(adapt: Run, flags: str, says: str) -> None:
    done = adapt(f"{flags} --out other")
    assert (done.code, says in done.err) == (2, True), done.err
    assert not Path("other").exists()


def test_it_keeps_the_luckiest_prompt() -> None:
    """As a library, too: the best prompt after each episode is that of the best return so far."""
    env, policy = Line(), untrained()
    tasks = sample_tasks(env, 3, 6)
    found = mgpo_jax.adapt(
        env, policy, tasks, METHOD, {"longest": 4}, seeds=2, episodes=8, eval_every=8
    )
    lucky = found.returns.argmax(axis=-1)
    assert len(np.unique(lucky)) > 1
    for place in np.ndindex(lucky.shape):
        np.testing.assert_array_equal(
            found.best.prompt.goals[place][-1], found.choices.prompt.goals[place][lucky[place]]
        )
    assert found.best.greedy.all()
    assert not found.choices.greedy.any()


def test_variants_of_its_numbers_share_a_program() -> None:
    env, policy = Line(), untrained()
    tasks = sample_tasks(env, 3, 3)
    hypers = [LuckyHyper(longest=1), LuckyHyper(longest=4), LuckyHyper(thrift=2.0)]
    options = {"seeds": 1, "episodes": 4, "eval_every": 4}
    together = mgpo_jax.sweep(env, policy, tasks, METHOD, hypers, **options)
    for hyper, outcome in zip(hypers, together, strict=True):
        alone = mgpo_jax.adapt(env, policy, tasks, METHOD, hyper, **options)
        np.testing.assert_array_equal(alone.returns, outcome.returns)
        np.testing.assert_array_equal(alone.best.prompt.goals, outcome.best.prompt.goals)
