"""Methods by name: records, bounds of hyper-parameters, users' own modules, all without jax."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.errors import NotAvailableError, UsageError
from envs.maze.env import MazeRunner
from envs.registry import Judgement, World
from envs.wrappers import Wrapper
from mgpo_jax import methods, runner
from mgpo_jax.adaptation import Adapter
from mgpo_jax.methods import (
    BBT,
    BPE,
    GRIPS,
    UCB,
    BbtHyper,
    BpeHyper,
    ExploreHyper,
    GripsHyper,
    Method,
    NoHyper,
    Setting,
    UcbHyper,
    split_hyper,
)
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.prompts import Prompt
from mgpo_jax.runner import adapt, sweep
from mgpo_jax.settings import Count, static
from mgpo_jax.tasks import sample_tasks
from mgpo_jax.transformer import GoalTransformer, network_config

ROOT = Path(__file__).parents[1]
ENV = MazeRunner(name="tiny", side=7, horizon=6)
WORLD = World(name="tiny", make=lambda: ENV)
NETWORK = network_config(
    ENV.spec, max_prompt_length=3, embed_dim=8, num_layers=1, num_heads=1, dropout=0.0
)
SETTING = Setting(ENV, NETWORK, 9, Judgement())


@pytest.fixture(scope="module")
def policy():
    prompt = Prompt(jnp.zeros((3, 2)), jnp.ones(3, bool))
    inputs = (prompt, jnp.zeros((2, 6)), jnp.zeros(2, jnp.int32))
    shapes = jax.eval_shape(GoalTransformer(NETWORK).init, jax.random.key(0), *inputs)
    rng = np.random.default_rng(1)
    params = jax.tree.map(
        lambda leaf: jnp.asarray(0.5 * rng.standard_normal(leaf.shape), leaf.dtype), shapes
    )
    return LoadedPolicy(NETWORK, params, {})


def test_the_built_in_methods():
    assert methods.names()[:7] == ["ucb", "bpe", "plan", "explore", "grips", "bbt", "gcbc"]
    for name in methods.names()[:7]:
        method = methods.find(name)
        assert method.name == name
        assert method.title
        assert method.summary
        assert callable(methods.load(method.make))
        for field in dataclasses.fields(method.hyper):
            assert field.name.isidentifier()


@pytest.mark.parametrize(
    ("name", "near"), [("uct", "ucb"), ("grip", "grips"), ("gcbd", "gcbc"), ("explor", "explore")]
)
def test_a_name_that_is_nearly_right(name, near):
    says = f"unknown method '{name}'; did you mean '{near}'.*known: ucb, bpe,"
    with pytest.raises(UsageError, match=says):
        methods.find(name)


MODULE = """
from dataclasses import dataclass
from mgpo_jax.methods import Method
from mgpo_jax.settings import Count, Positive

@dataclass(frozen=True)
class Hyper:
    rate: Positive = 0.1
    num_edits: Count = 1

def make(setting, params, hyper):
    from mgpo_jax.methods import GCBC, NoHyper
    return GCBC.adapter(setting, params, NoHyper())

MINE = Method(name="mine", title="Mine", make=make, hyper=Hyper)
NOT_MINE = {"name": "mine"}
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module in the current folder, which is no package that anyone installed."""
    name = f"method_of_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield name
    sys.modules.pop(name, None)


def test_a_method_in_a_module_of_ones_own(module, policy):
    method = methods.find(f"{module}:MINE")
    assert method.name == "mine"
    assert methods.find(f"{module}:MINE") is method
    tasks = sample_tasks(ENV, 5, 2)
    options = {"seeds": 1, "episodes": 3, "eval_every": 3}
    mine = adapt(ENV, policy, tasks, f"{module}:MINE", {"rate": 2.0}, **options)
    fixed = adapt(ENV, policy, tasks, "gcbc", **options)
    np.testing.assert_array_equal(mine.returns, fixed.returns)
    with pytest.raises(UsageError, match=r"--rate must be above 0, found 0\.0"):
        adapt(ENV, policy, tasks, f"{module}:MINE", {"rate": 0.0}, **options)


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("{}:OTHER", "cannot load the method '{}:OTHER': .*has no attribute 'OTHER'"),
        (
            "{}:NOT_MINE",
            "{}:NOT_MINE is a dict; the place of a method must be that of a Method record",
        ),
        ("no_such_module:MINE", "cannot load the method .*No module named 'no_such_module'"),
    ],
)
def test_places_where_no_method_is(module, place, says):
    with pytest.raises(UsageError, match=says.format(module)):
        methods.find(place.format(module))


@pytest.fixture
def registry(monkeypatch):
    monkeypatch.setattr(methods.METHODS, "_registered", dict(methods.METHODS._registered))


def test_registered_methods(registry):
    mine = Method(name="mine", make="mgpo_jax.optimizers.methods:make_gcbc")
    assert methods.register(mine) is mine
    assert methods.find("mine") is mine
    assert "mine" in methods.names()
    with pytest.raises(UsageError, match="did you mean 'mine'"):
        methods.find("min")
    methods.register(mine)  # the same record, as when a module is imported again
    with pytest.raises(UsageError, match="there is a method 'mine' already; choose another name"):
        methods.register(replace(mine, title="Another"))
    assert methods.find("mine") is mine


@pytest.mark.parametrize("name", ["ucb", "gcbc"])
def test_built_in_names_are_taken(registry, name):
    with pytest.raises(UsageError, match=f"there is a method '{name}' already"):
        methods.register(replace(UCB, name=name))


@pytest.mark.parametrize(
    ("method", "name", "says"),
    [
        (UCB, "num_edits", "--num-edits is not a setting of ucb; it belongs to grips$"),
        (BPE, "c", "--c is not a setting of bpe; it belongs to ucb$"),
        (BBT, "keep_rewarded", "not a setting of bbt; it belongs to ucb, bpe, explore$"),
        (methods.GCBC, "max_goals", "of gcbc; it belongs to ucb, bpe, plan, explore, grips, bbt$"),
        (GRIPS, "temper", "--temper is not a setting of grips$"),
    ],
)
def test_settings_of_another_method(method, name, says):
    with pytest.raises(UsageError, match=says):
        method.hyper_from({name: 1})


def test_worlds_have_defaults_of_their_own(policy):
    world = replace(WORLD, method_defaults={"ucb": {"scale": 3.0}, "bpe": {"keep_rewarded": False}})
    assert UCB.hyper_in(world) == UcbHyper(scale=3.0)
    assert UCB.hyper_in(world, {"c": 2.0, "scale": 1.0}) == UcbHyper(c=2.0, scale=1.0)
    assert BPE.hyper_in(world) == BpeHyper(keep_rewarded=False)
    assert BBT.hyper_in(world) == BbtHyper()
    assert UCB.hyper_in(None) == UCB.hyper_in(WORLD) == UcbHyper()
    wrong = replace(WORLD, method_defaults={"bbt": {"scale": 3.0}})
    with pytest.raises(UsageError, match="--scale is not a setting of bbt; it belongs to ucb"):
        BBT.hyper_in(wrong)


def test_an_adaptation_starts_from_the_defaults_of_its_world(policy, monkeypatch):
    class AskedError(Exception):
        """Tells with which hyper-parameters an adaptation would run."""

    def ask(env, policy, tasks, method, hypers, **options):
        raise AskedError(hypers)

    monkeypatch.setattr(runner, "sweep", ask)
    world, tasks = (
        replace(WORLD, method_defaults={"ucb": {"scale": 3.0}}),
        sample_tasks(ENV, 0, 1),
    )
    for where, hyper, wanted in (
        (world, None, UcbHyper(scale=3.0)),
        (world, {"c": 2.0}, UcbHyper(scale=3.0, c=2.0)),
        (world, UcbHyper(), UcbHyper()),
        (ENV, None, UcbHyper()),
    ):
        with pytest.raises(AskedError) as asked:
            adapt(where, policy, tasks, "ucb", hyper)
        assert asked.value.args == ([wanted],)


def test_hyper_parameters_from_a_dict():
    assert UCB.hyper_from({}) == UcbHyper()
    assert UCB.hyper_from({"c": 2.0, "max_goals": 3}) == UcbHyper(c=2.0, max_goals=3)


@pytest.mark.parametrize(
    ("method", "hyper", "says"),
    [
        (UCB, UcbHyper(c=-0.1), r"--c must be at least 0, found -0\.1"),
        (UCB, UcbHyper(c=float("nan")), "--c must be a finite number"),
        (UCB, UcbHyper(scale=0.0), r"--scale must be above 0, found 0\.0"),
        (UCB, UcbHyper(max_goals=0), "--max-goals must be at least 1, found 0"),
        (UCB, UcbHyper(max_goals=4), "--max-goals 4 is longer than the policy's prompts .3 goals"),
        (BPE, BpeHyper(min_std=0.0), "--min-std must be above 0"),
        (GRIPS, GripsHyper(num_edits=0), "--num-edits must be at least 1"),
        (GRIPS, GripsHyper(max_goals=4), "--max-goals 4 is longer"),
        (BBT, BbtHyper(population_size=1), "--population-size must be at least 2"),
        (BBT, BbtHyper(latent_dim=0), "--latent-dim must be at least 1"),
        (BBT, BbtHyper(std_init=0.0), "--std-init must be above 0"),
        (UCB, BpeHyper(), "ucb takes hyper-parameters as UcbHyper, found BpeHyper"),
        (UCB, {"c": 1.0}, "ucb takes hyper-parameters as UcbHyper, found dict"),
    ],
)
def test_bounds_of_hyper_parameters(method, hyper, says):
    with pytest.raises(UsageError, match=says):
        method.check_use(SETTING, hyper)


def test_what_is_within_bounds_may_be_used():
    for name in methods.names()[:7]:
        method = methods.find(name)
        method.check_use(SETTING, method.hyper())
    UCB.check_use(SETTING, UcbHyper(c=0.0, scale=None, max_goals=3))


@dataclass(frozen=True)
class Goalless(Wrapper):
    """A world that draws no goals."""

    def sample_goal(self, key):
        raise NotAvailableError("tiny draws no goals at random")


def test_random_goals_where_there_are_none():
    setting = replace(SETTING, env=Goalless(ENV))
    with pytest.raises(UsageError, match="tiny draws no goals at random"):
        GRIPS.check_use(setting, GripsHyper())
    for method in (UCB, BPE, BBT, methods.EXPLORE):
        method.check_use(setting, method.hyper())


def test_numbers_are_data_and_shapes_are_not():
    fixed, numbers = split_hyper([BbtHyper(std_init=s, max_goals=3) for s in (0.5, 1.0)])
    assert numbers == {"std_init": [0.5, 1.0], "max_goals": [3, 3]}
    assert (fixed.std_init, fixed.max_goals) == (0, 0)
    assert (fixed.population_size, fixed.latent_dim) == (10, 5)
    others, _ = split_hyper([BbtHyper(std_init=s, max_goals=1) for s in (0.1, 7.0)])
    assert others == fixed
    assert hash(others) == hash(fixed)
    fixed, numbers = split_hyper([UcbHyper()])
    assert numbers == {"c": [1.0]}
    assert fixed.scale is None
    assert fixed.keep_rewarded is True
    for hypers in (
        [BbtHyper(population_size=4), BbtHyper(population_size=6)],
        [UcbHyper(scale=None), UcbHyper(scale=1.0)],
        [UcbHyper(keep_rewarded=True), UcbHyper(keep_rewarded=False)],
    ):
        with pytest.raises(
            UsageError, match="cannot be swept, because it changes the compiled program"
        ):
            split_hyper(hypers)


VARIANTS = {
    "ucb": [UcbHyper(c=0.0, scale=1.0, max_goals=1), UcbHyper(c=3.0, scale=2.0, max_goals=3)],
    "bpe": [BpeHyper(min_std=0.02, max_goals=1), BpeHyper(min_std=0.5, max_goals=3)],
    "explore": [ExploreHyper(max_goals=2), ExploreHyper(max_goals=3)],
    "grips": [GripsHyper(num_edits=2), GripsHyper(num_edits=4)],
    "bbt": [BbtHyper(std_init=std, population_size=4, latent_dim=2) for std in (0.1, 2.0)],
    "gcbc": [NoHyper(), NoHyper()],
}


@pytest.mark.parametrize("name", VARIANTS)
def test_every_method_sweeps_its_numbers(name, policy):
    tasks, hypers = sample_tasks(ENV, 5, 2), VARIANTS[name]
    options = {"seeds": 1, "episodes": 7, "eval_every": 7}
    outcomes = sweep(ENV, policy, tasks, methods.find(name), hypers, **options)
    for outcome in outcomes:
        assert outcome.returns.shape == (1, 2, 7)
        assert np.isfinite(outcome.eval_returns).all()
    goals = [outcome.choices.prompt.goals for outcome in outcomes]
    assert (goals[0] == goals[1]).all() == (name == "gcbc")


def test_adapters_are_checked_before_anything_runs(policy):
    """Also those of a user, whose check may be a function."""

    @dataclass(frozen=True)
    class Hyper:
        size: Count = static(1)

    def check(setting, hyper):
        assert setting.num_episodes == 3
        raise UsageError(f"no use for size {hyper.size} in {setting.env.spec.name}")

    def make(setting, params, hyper) -> Adapter:
        raise AssertionError("not reached")

    method = Method(name="fussy", make=make, hyper=Hyper, check=check)
    with pytest.raises(UsageError, match="no use for size 2 in tiny"):
        adapt(ENV, policy, sample_tasks(ENV, 5, 1), method, {"size": 2}, seeds=1, episodes=3)


WITHOUT_JAX = """
import sys
import mgpo_jax
import mgpo_jax.methods as methods
import mgpo_jax.settings
import envs
for name in envs.names():
    envs.find(name)
for name in methods.names():
    method = methods.find(name)
    method.hyper()
dir(mgpo_jax)
heavy = [name for name in ("jax", "flax", "optax", "evosax", "matplotlib") if name in sys.modules]
assert not heavy, heavy
"""


def test_records_need_no_jax():
    """Names, help and usage errors answer at once."""
    subprocess.run([sys.executable, "-c", WITHOUT_JAX], check=True, cwd=ROOT)
