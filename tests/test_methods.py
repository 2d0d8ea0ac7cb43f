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
from envs.gridworld.env import GridWorld
from envs.maze.env import MazeRunner
from envs.registry import Judgement, World
from envs.wrappers import Noisy, Wrapper
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
    PlanHyper,
    Setting,
    UcbHyper,
    split_hyper,
)
from mgpo_jax.network_configs import network_config
from mgpo_jax.optimizers import methods as factories
from mgpo_jax.optimizers.base import SearchSpace
from mgpo_jax.optimizers.methods import search_space
from mgpo_jax.planning import methods as planning
from mgpo_jax.planning.searching import Features
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.prompts import Prompt
from mgpo_jax.runner import adapt, sweep
from mgpo_jax.settings import Count, static
from mgpo_jax.tasks import sample_tasks
from mgpo_jax.transformer import GoalTransformer

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


class AskedError(Exception):
    """Tells what an adaptation would run with."""


@pytest.fixture
def asked(policy, monkeypatch):
    """``(world, method, hyper, ..) -> (hyper-parameters, options)`` of the search that would be run."""

    def searching(env, policy, tasks, method, hypers, **options):
        raise AskedError(hypers, options)

    monkeypatch.setattr(runner, "sweep", searching)

    def ask(*args, **options):
        world, *rest = args
        with pytest.raises(AskedError) as found:
            adapt(world, policy, sample_tasks(ENV, 0, 1), *rest, **options)
        return found.value.args

    return ask


def test_an_adaptation_starts_from_the_defaults_of_its_world(asked):
    world = replace(WORLD, method_defaults={"ucb": {"scale": 3.0}})
    for where, hyper, wanted in (
        (world, None, UcbHyper(scale=3.0)),
        (world, {"c": 2.0}, UcbHyper(scale=3.0, c=2.0)),
        (world, UcbHyper(), UcbHyper()),
        (ENV, None, UcbHyper()),
    ):
        hypers, _ = asked(where, "ucb", hyper)
        assert hypers == [wanted]


def test_an_adaptation_is_judged_as_its_world_is(asked):
    sampled = Judgement("sample", 0.5, episodes=3)
    world = replace(WORLD, judged=sampled)
    assert asked(world, "ucb")[1]["judged"] == sampled
    assert asked(world, "ucb", judged=Judgement())[1]["judged"] == Judgement()
    assert asked(ENV, "ucb")[1]["judged"] is None  # there is no record to ask
    assert asked(ENV, "ucb", judged=sampled)[1]["judged"] == sampled


def test_a_library_call_passes_its_numbers_on(asked):
    numbers = {"seeds": 2, "episodes": 7, "seed": 3, "eval_every": 5, "keep_actions": True}
    found = asked(WORLD, "ucb", **numbers)[1]
    assert {name: found[name] for name in numbers} == numbers


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


GRID = GridWorld(name="grid", horizon=20)


@pytest.mark.parametrize("keeps", [True, False])
@pytest.mark.parametrize("env", [ENV, GRID])
def test_the_search_space_is_that_of_the_world(env, keeps):
    """The maze is deterministic; the starts of GridWorld are random, and its rewards confirm goals."""
    setting, hyper = replace(SETTING, env=env), UcbHyper(max_goals=2, keep_rewarded=keeps)
    assert env.spec.deterministic == (env is ENV)
    assert search_space(setting, hyper) == SearchSpace(
        num_slots=3,
        horizon=env.spec.horizon,
        return_range=env.spec.return_range,
        num_episodes=9,
        sample_goal=env.sample_goal,
        max_goals=2,
        deterministic=env is ENV,
        keep_rewarded=keeps and env is GRID,
    )
    assert not search_space(setting, GripsHyper()).keep_rewarded
    disturbed = replace(setting, env=Noisy(env, action_noise=0.1))
    assert not search_space(disturbed, hyper).deterministic


@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("ucb", {"c": 2.0, "scale": 0.5}),
        ("ucb", {"c": 1.0, "scale": None}),
        ("bpe", {"min_std": 0.3}),
        ("explore", {}),
        ("grips", {"num_edits": 3}),
        ("bbt", {"population_size": 4, "latent_dim": 2, "std_init": 0.25}),
    ],
)
def test_an_optimizer_gets_the_space_and_all_numbers_of_its_method(
    name, numbers, policy, monkeypatch
):
    method, given = methods.find(name), []
    hyper = method.hyper(**numbers, max_goals=2)

    def noted(*space, **others):
        given.append((space, others))
        return real(*space, **others)

    real = getattr(factories, name)
    monkeypatch.setattr(factories, name, noted)
    method.adapter(SETTING, policy.params, hyper)
    assert given == [((search_space(SETTING, hyper),), numbers)]


@pytest.mark.parametrize("splice", [True, False])
def test_a_plan_has_the_features_that_its_settings_name(policy, monkeypatch, splice):
    given = []

    def noted(*args):
        given.append(args)
        return factories.fixed_prompt(3)

    monkeypatch.setattr(planning, "plan_map", noted)
    hyper = PlanHyper(
        rehearse=1, steer=2, splice=splice, frontier=not splice, num_states=7, max_goals=2
    )
    methods.PLAN.adapter(SETTING, policy.params, hyper)
    ((space, spec, _, num_states, features),) = given
    assert (space, spec, num_states) == (search_space(SETTING, hyper), ENV.spec, 7)
    assert features == Features(rounds=1, steering=2, splice=splice, frontier=not splice)
