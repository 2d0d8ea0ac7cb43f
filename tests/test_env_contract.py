"""The contract between worlds and the method, checked for every world in ``envs.names``."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import EntryPoint
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import Environment
from envs.errors import NotAvailableError, UsageError
from envs.registry import WORLDS
from envs.specs import ArraySpec, Box, Discrete, Engine, EnvSpec
from envs.wrappers import Noisy


def installed(name):
    try:
        return envs.make(name) is not None
    except UsageError:
        return False


def parameters(names):
    """Test parameters. Variants of a world (kitchen-stock) are slow."""
    return [pytest.param(name, marks=pytest.mark.slow if "-" in name else ()) for name in names]


NAMES = [name for name in envs.names() if installed(name)]
# Worlds that only choose another engine (kitchen-mjx) are compared with theirs in tests/test_kitchen.py.
PLAYED = [name for name in NAMES if envs.find(name).policy_of is None]
NUM_TASKS = 256
NUM_LANES = 16
AFTER_END = 4  # steps beyond the horizon

every_world = pytest.mark.parametrize("name", parameters(NAMES))


@partial(jax.jit, static_argnums=0)
def sample(env, keys):
    """A batch of tasks and the best return on each."""
    tasks = jax.vmap(env.sample_task)(keys)
    return tasks, jax.vmap(env.optimal_return)(tasks)


def random_actions(env, key):
    num = env.spec.horizon + AFTER_END
    if env.spec.discrete:
        return jax.random.randint(key, (num,), 0, env.spec.action_dim)
    return jax.random.uniform(key, (num, env.spec.action_dim), minval=-1, maxval=1)


def same(a, b):
    """Whether all arrays of two states are equal."""

    def equal(x, y):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        return jnp.all(x == y)

    return jnp.all(jnp.stack(jax.tree.leaves(jax.tree.map(equal, a, b))))


def play(env, key, task):
    """Random actions to beyond the horizon: the time steps, and whether each left the state alone."""
    key_reset, key_actions = jax.random.split(key)
    state, first = env.reset(key_reset, task)

    def step(state, action):
        new_state, timestep = env.step(state, action)
        return new_state, (timestep, same(state, new_state))

    _, (steps, unchanged) = jax.lax.scan(step, state, random_actions(env, key_actions))
    return first, steps, unchanged


play_one = jax.jit(play, static_argnums=0)
play_many = jax.jit(
    lambda env, keys, tasks: jax.vmap(partial(play, env))(keys, tasks), static_argnums=0
)


@pytest.fixture(scope="module", params=parameters(PLAYED))
def world(request):
    """A world, many of its tasks, and random play on the easiest, which it sometimes solves."""
    env = envs.make(request.param)
    tasks, best = sample(env, jax.random.split(jax.random.key(1), NUM_TASKS))
    easiest = np.argsort(-np.asarray(best))[:NUM_LANES]
    easy = jax.tree.map(lambda leaf: leaf[easiest], tasks)
    keys = jax.random.split(jax.random.key(2), NUM_LANES)
    first, steps, unchanged = jax.tree.map(np.asarray, play_many(env, keys, easy))
    return {
        "env": env,
        "tasks": tasks,
        "best": np.asarray(best),
        "easy": easy,
        "keys": keys,
        "first": first,
        "steps": steps,
        "unchanged": unchanged,
    }


@every_world
def test_sizes_are_those_of_the_spec(name):
    env = envs.make(name)
    spec = env.spec
    assert spec.name == envs.find(name).home
    assert isinstance(env, Environment)
    assert isinstance(env.engine, Engine)
    key = jax.random.key(0)
    task = jax.eval_shape(env.sample_task, key)
    state, first = jax.eval_shape(env.reset, key, task)
    action = jax.ShapeDtypeStruct(
        *(((), jnp.int32) if spec.discrete else ((spec.action_dim,), jnp.float32))
    )
    assert jax.eval_shape(spec.zero_action) == action
    next_state, timestep = jax.eval_shape(env.step, state, action)

    def shapes(tree):
        return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)

    # A scan needs states and time steps that keep shape and type.
    assert shapes(next_state) == shapes(state)
    assert shapes(timestep) == shapes(first)
    scalar, flag = ((), jnp.float32), ((), jnp.bool_)
    assert shapes(timestep)._asdict() == {
        "obs": (spec.obs.shape, spec.obs.dtype),
        "achieved_goal": ((spec.goal_dim,), jnp.float32),
        "goal_reached": flag,
        "outcome": ((spec.goal_dim,), jnp.float32),
        "reward": scalar,
        "terminated": flag,
        "truncated": flag,
        "failed": flag,
    }
    goal = ((spec.goal_dim,), jnp.float32)
    assert shapes(jax.eval_shape(env.sample_goal, key)) == goal
    assert shapes(jax.eval_shape(env.task_goal, task)) == goal
    assert env.goal_set.shape[1:] == (spec.goal_dim,)
    assert env.goal_set.dtype == np.float32
    with suppress(NotAvailableError):
        assert shapes(jax.eval_shape(lambda state: env.expert_goal(state, 10), state)) == goal
    assert shapes(jax.eval_shape(env.optimal_return, task)) == scalar
    fingerprint = jax.eval_shape(env.fingerprint, task)
    assert fingerprint.ndim == 1
    assert jnp.issubdtype(fingerprint.dtype, jnp.integer)


@every_world
def test_equal_worlds_share_one_program(name):
    traces = []

    @partial(jax.jit, static_argnums=0)
    def draw(env, key):
        traces.append(env)
        return env.sample_goal(key)

    for seed in range(3):
        draw(envs.make(name), jax.random.key(seed))
    assert traces == [envs.make(name)]
    assert envs.make(name) == envs.make(name)
    assert hash(envs.make(name)) == hash(envs.make(name))


def test_different_worlds_differ():
    assert len({envs.make(name) for name in NAMES}) == len(NAMES)


def test_vmap_equals_loop(world):
    for lane in (0, 1, NUM_LANES // 2, NUM_LANES - 1):  # a fault of XLA began with the ninth
        task = jax.tree.map(lambda leaf, lane=lane: leaf[lane], world["easy"])
        alone = play_one(world["env"], world["keys"][lane], task)
        together = [
            jax.tree.map(lambda leaf, lane=lane: leaf[lane], world[name])
            for name in ("first", "steps", "unchanged")
        ]
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-6), alone, (*together,))


def test_episodes_end_once_and_absorb(world):
    steps, unchanged = world["steps"], world["unchanged"]
    horizon = world["env"].spec.horizon
    ended = steps.terminated | steps.truncated
    assert not (steps.terminated & steps.truncated).any()
    assert not (world["first"].terminated | world["first"].truncated).any()
    for lane in range(NUM_LANES):
        end = int(np.argmax(ended[lane]))
        assert ended[lane].any()
        assert end < horizon
        assert steps.truncated[lane, end] == (not steps.terminated[lane, end])
        if steps.truncated[lane, end]:
            assert end == horizon - 1
        # From there on nothing changes and nothing is earned.
        assert unchanged[lane, end + 1 :].all()
        assert (steps.reward[lane, end + 1 :] == 0).all()
        for field in ("obs", "achieved_goal", "outcome", "terminated", "truncated"):
            rows = getattr(steps, field)[lane, end:]
            assert (rows == rows[0]).all(), field
        # While the episode runs, at least a step counter moves.
        assert not unchanged[lane, : end + 1].any()


def test_returns_stay_in_the_range_of_the_spec(world):
    low, high = world["env"].spec.return_range
    assert low < high
    returns_of = [world["steps"].reward.sum(1)]
    if not np.isnan(world["best"]).all():  # else the optimum is unknown
        returns_of.append(world["best"])
    for returns in returns_of:
        assert np.isfinite(returns).all()
        assert (returns >= low - 1e-4).all()
        assert (returns <= high + 1e-4).all()


def test_no_play_beats_the_optimal_return(world):
    if np.isnan(world["best"]).all():
        pytest.skip("the optimum is unknown")
    best = np.sort(world["best"])[::-1][:NUM_LANES]
    assert (world["steps"].reward.sum(1) <= best + 1e-4).all()


def test_every_reward_is_that_of_one_part(world):
    """Where a world says that its tasks are rewarded part by part."""
    env, rewards = world["env"], world["steps"].reward
    parts = np.asarray(jax.vmap(env.num_parts)(world["tasks"]))
    assert np.issubdtype(parts.dtype, np.integer)
    assert parts.shape == (NUM_TASKS,)
    assert (parts >= 0).all()
    assert (parts == 0).all() or env.spec.reward_confirms_goals
    of_easy = np.asarray(jax.vmap(Noisy(env).num_parts)(world["easy"]))[:, None]
    paid = (rewards * of_easy)[of_easy[:, 0] > 0]
    np.testing.assert_allclose(paid, paid > 0, atol=1e-5)


def test_the_outcome_of_a_solved_task_is_its_goal(world):
    steps = world["steps"]
    goals = np.asarray(jax.vmap(world["env"].task_goal)(world["easy"]))
    solved = steps.terminated.any(1)
    if np.isnan(jax.vmap(world["env"].optimal_return)(world["easy"])).all():
        pytest.skip("the optimum is unknown, so that nobody knows which episodes solve their tasks")
    if not solved.any():
        pytest.skip("random play solves none of the easiest tasks")
    np.testing.assert_allclose(steps.outcome[solved, -1], goals[solved], atol=1e-6)
    # And in no episode that ends at the horizon.
    assert (abs(steps.outcome[~solved, -1] - goals[~solved]).max(1, initial=0) > 1e-3).all()


def test_sampled_tasks_are_valid_and_vary(world):
    env, tasks = world["env"], world["tasks"]
    env.check_task(jax.tree.map(np.asarray, tasks))
    prints = np.asarray(jax.vmap(env.fingerprint)(tasks))
    assert len(np.unique(prints, axis=0)) > NUM_TASKS // 4


def test_tasks_are_a_function_of_the_key(world):
    again, _ = sample(world["env"], jax.random.split(jax.random.key(1), NUM_TASKS))
    assert same(world["tasks"], again)


def test_prompt_goals_vary(world):
    draw = jax.vmap(world["env"].sample_goal)
    goals = np.asarray(draw(jax.random.split(jax.random.key(3), 64)))
    assert np.isfinite(goals).all()
    assert len(np.unique(goals, axis=0)) > 1


def test_tasks_of_another_shape_are_refused(world):
    env, tasks = world["env"], jax.tree.map(np.asarray, world["tasks"])
    for index, leaf in enumerate(jax.tree.leaves(tasks)):
        shorter = leaf[..., :-1] if leaf.ndim > 1 else leaf[0]  # fewer numbers may be fewer tasks
        for bad in (leaf[:, None], shorter, leaf + 0.5, leaf.astype(str)):
            leaves = list(jax.tree.leaves(tasks))
            leaves[index] = bad
            with pytest.raises(ValueError, match=r"must (have shape|hold)"):
                env.check_task(jax.tree.unflatten(jax.tree.structure(tasks), leaves))


@pytest.mark.parametrize("name", NAMES)
def test_records(name):
    """What generic code reads of a world: its demonstrators, settings and judgement."""
    world = envs.find(name)
    assert world.name == name
    assert world.summary
    known = world.demonstrators(world.make())
    assert all(isinstance(one, envs.Demonstrator) for one in known.values())
    assert {"fast", "paper"} <= set(world.presets) <= {"fast", "paper", "smoke", "ablation"}
    for settings in world.presets.values():
        assert settings.get("steps", 1) > 0
        assert settings.get("trajectories", 1) > 0
        assert settings.get("demonstrator") in {None, *known}
    assert (world.judged.episodes > 1) == (not world.make().spec.deterministic)
    if world.policy_of is not None:
        home = envs.make(world.policy_of).spec
        assert replace(world.make().spec, name=home.name) == home


def test_listing_worlds_imports_no_jax():
    code = (
        "import sys, envs; [envs.find(name) for name in envs.names()]; "
        "assert not {'jax', 'numpy', 'mujoco', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


class Piece(NamedTuple):
    """A task with one array of each kind."""

    place: jax.Array
    weight: jax.Array
    marks: jax.Array


@dataclass(frozen=True)
class Bare(Environment):
    """A world that leaves everything at its default."""

    num: int = 3
    spec = EnvSpec(
        name="bare", obs=ArraySpec((4, 4, 3), "uint8"), goal_dim=2, actions=Discrete(2), horizon=5,
        return_range=(0.0, 1.0),
    )  # fmt: skip

    def sample_task(self, key):
        place = jax.random.randint(key, (2,), 0, 100)
        return Piece(place, jax.random.uniform(key), jax.random.bernoulli(key, 0.5, (self.num,)))


class TestDefaults:
    env = Bare()

    def tasks(self, num=4):
        tasks = jax.vmap(self.env.sample_task)(jax.random.split(jax.random.key(0), num))
        return jax.tree.map(np.array, tasks)

    def test_specs(self):
        spec = self.env.spec
        assert str(spec.obs) == "uint8[4, 4, 3]"
        assert spec.obs.size == 48
        assert not spec.obs.is_float
        assert (spec.discrete, spec.action_dim, spec.zero_action().shape) == (True, 2, ())
        assert (spec.deterministic, spec.reward_confirms_goals) == (True, False)
        assert ArraySpec((2,)).is_float
        assert Box(2) != Discrete(2)

    def test_a_world_must_say_what_it_is(self):
        bare, key = Environment(), jax.random.key(0)
        for missing in (
            lambda: bare.spec,
            lambda: bare.sample_task(key),
            lambda: bare.task_goal(None),
            lambda: bare.reset(key, None),
            lambda: bare.step(None, jnp.zeros(())),
        ):
            with pytest.raises(NotImplementedError):
                missing()

    def test_the_optimum_is_unknown(self):
        best = jax.jit(self.env.optimal_return)(self.env.sample_task(jax.random.key(0)))
        assert best.shape == ()
        assert np.isnan(best)

    def test_goals_are_not_drawn(self):
        with pytest.raises(NotAvailableError, match="bare draws no goals at random"):
            self.env.sample_goal(jax.random.key(0))

    def test_the_engine_wants_nothing_special(self):
        assert self.env.engine == Engine(worlds_together=1, compiler_options=())

    def test_equal_worlds_are_equal(self):
        assert Bare() == Bare()
        assert hash(Bare()) == hash(Bare())
        assert Bare(4) != Bare()

    def test_fingerprints_tell_tasks_apart(self):
        tasks = self.tasks(64)
        fingerprint = jax.jit(jax.vmap(self.env.fingerprint))
        prints = np.asarray(fingerprint(tasks))
        assert prints.dtype == np.int32
        assert len(np.unique(prints, axis=0)) == 64
        np.testing.assert_array_equal(prints, fingerprint(self.tasks(64)))
        # Every array counts, and every bit of it.
        for index, change in enumerate((1, np.spacing(tasks.weight), True)):
            leaves = list(tasks)
            leaves[index] = leaves[index] + change if index < 2 else ~leaves[index]
            others = np.asarray(fingerprint(Piece(*leaves)))
            assert (others != prints).any(axis=1).all()

    def test_good_tasks(self):
        tasks = self.tasks()
        self.env.check_task(tasks)
        self.env.check_task(tasks._replace(place=tasks.place.astype(np.int64)))
        self.env.check_task(tasks._replace(weight=np.ones(4, np.int8)))  # 1 is a number
        self.env.check_task(jax.tree.map(jnp.asarray, tasks))

    @pytest.mark.parametrize(
        ("field", "change", "message"),
        [
            ("place", lambda leaf: leaf[0], r"place must have shape \[N, 2\], found \[2\]"),
            ("place", lambda leaf: leaf.T, r"place must have shape \[N, 2\], found \[2, 4\]"),
            ("weight", lambda leaf: leaf[:3], r"weight must have shape \[4\], found \[3\]"),
            ("marks", lambda leaf: leaf[:, :1], r"marks must have shape \[4, 3\], found \[4, 1\]"),
            ("place", lambda leaf: leaf + 0.5, "place must hold integers, found float"),
            ("place", lambda leaf: leaf > 1, "place must hold integers, found bool"),
            ("weight", lambda leaf: leaf > 1, "weight must hold numbers, found bool"),
            ("marks", lambda leaf: leaf + 0, "marks must hold booleans, found int"),
            ("weight", lambda leaf: leaf / 0, "weight holds NaN or infinity"),
        ],
    )
    @pytest.mark.filterwarnings("ignore:divide by zero")
    def test_bad_tasks(self, field, change, message):
        tasks = self.tasks()
        with pytest.raises(ValueError, match=message):
            self.env.check_task(tasks._replace(**{field: change(getattr(tasks, field))}))


class TestRegistry:
    """Worlds of one's own, on a copy of the registry."""

    @pytest.fixture(autouse=True)
    def _copy(self, monkeypatch, tmp_path):
        monkeypatch.setattr(WORLDS, "_registered", dict(WORLDS._registered))
        monkeypatch.setattr(WORLDS, "_loaded", dict(WORLDS._loaded))
        monkeypatch.setattr(sys, "path", [*sys.path])
        monkeypatch.chdir(tmp_path)

    def test_a_registered_world(self):
        world = envs.World(name="bare", make=Bare)
        assert envs.register(world) is world
        assert envs.find("bare") is world
        assert envs.make("bare") == Bare()
        assert "bare" in envs.names()
        # What it does not say has a default.
        assert dict(world.demonstrators(Bare())) == {}
        assert (world.home, world.pictures, world.num_test_tasks) == ("bare", None, 50)
        assert world.judged == envs.Judgement(mode="greedy", temperature=1.0, episodes=1)
        envs.register(world)  # twice the same is no conflict
        for name in ("bare", "maze15"):
            with pytest.raises(UsageError, match=f"there is a world '{name}' already"):
                envs.register(envs.World(name=name, make=lambda: Bare(4)))

    def test_a_world_of_a_file_here(self, tmp_path):
        (tmp_path / "world_file_here.py").write_text(
            "import envs\nWORLD = envs.World(name='own', make=lambda: envs.make('maze15'))\nNO = 3"
        )
        assert envs.find("world_file_here:WORLD").name == "own"
        assert envs.make("world_file_here:WORLD") == envs.make("maze15")
        with pytest.raises(
            UsageError, match="world_file_here:NO is a int; the place of a world must be"
        ):
            envs.find("world_file_here:NO")
        with pytest.raises(UsageError, match="cannot load the world 'world_file_here:OTHER'"):
            envs.find("world_file_here:OTHER")
        with pytest.raises(UsageError, match="cannot load the world 'nowhere:WORLD'"):
            envs.find("nowhere:WORLD")


class TestPlugIns:
    """Worlds that installed packages announce by an entry point."""

    @pytest.fixture
    def announce(self, tmp_path, monkeypatch):
        """Write a module, and announce its ``WORLD`` under a name."""
        points = []
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
        monkeypatch.setattr(envs.registry, "entry_points", lambda group: points)

        def announce(module, name, text):
            (tmp_path / f"{module}.py").write_text(text)
            points.append(EntryPoint(name, f"{module}:WORLD", "mgpo_jax.worlds"))

        return announce

    @pytest.mark.parametrize(
        ("text", "says"),
        [
            ("WORLD = undefined", "NameError: name 'undefined' is not defined"),
            ("WORLD = ", r"SyntaxError: invalid syntax \(plug_in_\d.py, line 1\)"),
            ("import no_such_package", "No module named 'no_such_package'"),
        ],
    )
    def test_a_broken_one_disturbs_no_other(self, announce, text, says, request):
        module = f"plug_in_{request.node.callspec.indices['text']}"
        announce(module, "broken", text)
        usable = [world.name for world in WORLDS.usable()]
        assert "maze15" in usable
        assert "broken" not in usable
        with pytest.raises(UsageError, match=f"cannot load the world '{module}:WORLD': {says}"):
            envs.find("broken")

    def test_its_entry_point_has_its_name(self, announce):
        announce(
            "plug_in_maze", "mymaze", "import envs\nWORLD = envs.World(name='my-maze', make=None)"
        )
        with pytest.raises(
            UsageError, match=r"entry point 'mymaze' .* the world 'my-maze'; give both"
        ):
            envs.find("mymaze")
        assert not {"mymaze", "my-maze"} & {world.name for world in WORLDS.usable()}


class TestUnknownNames:
    @pytest.mark.parametrize(("wrong", "right"), [("maze16", "maze1[56]"), ("Maze30", "maze30")])
    def test_the_nearest_name_is_offered(self, wrong, right):
        with pytest.raises(ValueError, match=f"{wrong}.*did you mean '{right}'"):
            envs.make(wrong)

    def test_nothing_is_offered_for_what_is_like_none(self):
        with pytest.raises(ValueError, match="unknown world 'zzz'") as raised:
            envs.make("zzz")
        assert "did you mean" not in str(raised.value)
        assert all(name in str(raised.value) for name in NAMES)
