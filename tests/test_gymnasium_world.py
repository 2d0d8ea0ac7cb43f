"""Worlds made from gymnasium environments behave as pure functions, whatever a program does with them."""

from __future__ import annotations

import gc
import importlib
import json
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import own_gymnasium
import pytest
from own_gymnasium import PLANE, SWITCHES, SWITCHING, WINDY, WORLD, Plane

import envs
import mgpo_jax
from envs.episodes import replay, run_episode
from envs.errors import DataError, NotAvailableError, UsageError
from envs.gymnasium_world import GymnasiumWorld
from envs.live import Moment, Pool, Start
from experiments import runtime
from mgpo_jax.network_configs import network_config
from mgpo_jax.prompts import single_goal
from mgpo_jax.transformer import GoalTransformer


def fresh(described: GymnasiumWorld, **changes) -> GymnasiumWorld:
    """The description with a pool of its own."""
    return replace(described, **changes)


SWITCHED = pytest.param(SWITCHING, marks=pytest.mark.slow)
WINDS = pytest.param(WINDY.world(num_test_tasks=4), marks=pytest.mark.slow)


@pytest.mark.parametrize("world", [WORLD, SWITCHED, WINDS], ids=["plane", "switches", "windy"])
def test_they_keep_what_every_world_promises(world) -> None:
    report = envs.check_world(world)
    assert report.faults == ()


def test_an_environment_that_pays_every_step_is_sound() -> None:
    """CartPole pays 1 for each step and ends when the pole falls, which is not the goal."""
    described = GymnasiumWorld(
        name="cartpole", make=lambda: gymnasium.make("CartPole-v1", max_episode_steps=40),
        return_range=(0.0, 40.0), achieved=lambda moment: moment.obs[2:3], desired=lambda moment: [0.0],
    )  # fmt: skip
    report = envs.check_world(described.world(num_test_tasks=4))
    assert report.faults == ()
    assert "rewards are paid before the end of an episode" in report.notes[0]


def played_by_hand(seed: int, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Observations and rewards of the environment itself, stepped without any of this."""
    env = Plane()
    obs, _ = env.reset(seed=seed)
    seen, rewards, over = [obs["observation"]], [], False
    for action in actions:
        if not over:
            obs, reward, over, _, _ = env.step(np.float32([0.5, 0.25]) * action)
        seen.append(obs["observation"])
        rewards.append(reward)
    return np.float32(seen), np.float32(rewards)


def test_episodes_are_those_of_the_environment() -> None:
    described = fresh(PLANE)
    env = described.environment()
    tasks = jax.jit(jax.vmap(env.sample_task))(jax.random.split(jax.random.key(3), 5))
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 12, 2)).astype(np.float32)
    play = jax.jit(
        jax.vmap(lambda task, acts: replay(jax.random.key(0), env, task, acts, jnp.int32(12)))
    )
    episodes = play(tasks, actions)
    for lane in range(5):
        obs, rewards = played_by_hand(int(tasks.seed[lane]), actions[lane])
        length = int(episodes.trajectory.length[lane])
        np.testing.assert_allclose(episodes.trajectory.obs[lane, :length], obs[:length], atol=1e-6)
        np.testing.assert_array_equal(episodes.rewards[lane, :length], rewards[:length])
        np.testing.assert_allclose(episodes.last_obs[lane], obs[length], atol=1e-6)
        np.testing.assert_allclose(tasks.goal[lane], obs[0, :2] + obs[0, 2:], atol=1e-6)
    assert described.pool.num_replayed == 0
    assert described.pool.num_made <= 5 + 1


def test_any_state_can_be_stepped_at_any_time() -> None:
    """Another branch, and the same one once more."""
    described = fresh(PLANE)
    env = described.environment()
    task = env.sample_task(jax.random.key(1))
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    states, told = [reset(jax.random.key(0), task)[0]], []
    moves = jax.random.uniform(jax.random.key(2), (4, 2), minval=-0.2, maxval=0.2)
    for move in moves:
        state, timestep = step(states[-1], move)
        states.append(state)
        told.append(timestep)
    for index in (3, 0, 2):
        other, _ = step(states[index], -moves[index])
        assert not np.array_equal(other.identity, states[index + 1].identity)
        after, timestep = step(states[index], moves[index])
        jax.tree.map(
            np.testing.assert_array_equal, (after, timestep), (states[index + 1], told[index])
        )
    assert described.pool.num_replayed >= 3


def test_few_live_environments_and_threads_change_nothing() -> None:
    found = []
    for described in (fresh(PLANE), fresh(PLANE, most=1, threads=3)):
        env = described.environment()
        keys = jax.random.split(jax.random.key(5), 4)
        tasks = jax.jit(jax.vmap(env.sample_task))(keys)
        agent = described.demonstrators["straight"].agent(())
        run = jax.jit(
            jax.vmap(lambda key, task, env=env, agent=agent: run_episode(key, env, agent, task))
        )
        found.append(run(keys, tasks))
    jax.tree.map(np.testing.assert_array_equal, *found)
    assert (found[0].return_ == 1).all()
    assert described.pool.num_replayed > 0
    assert described.pool.num_made <= 5


class Closable(Plane):
    """A plane that tells whether it was closed, as its environment of many does when it is forgotten."""

    is_closed = False

    def close(self):
        self.is_closed = True

    def step(self, action):
        assert not self.is_closed
        return super().step(action)


def many_planes(mode: str):
    """Three planes in one vector environment, which resets them in one of gymnasium's ways."""
    mode = gymnasium.vector.AutoresetMode[mode]
    return gymnasium.vector.SyncVectorEnv([Closable] * 3, autoreset_mode=mode)


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP", "DISABLED"])
def test_the_environments_of_a_vector_environment_are_used_one_by_one(mode: str) -> None:
    """Episodes are those of single environments to the last bit, also beyond the end of some of them."""
    found = []
    for described in (fresh(PLANE), fresh(PLANE, make=partial(many_planes, mode))):
        env, pool, rng = described.environment(), described.pool, np.random.default_rng(0)
        starts = [Start(int(rng.integers(1000)), ()) for _ in range(5)]
        moves = rng.uniform(-1, 1, (5, 12, 2)).astype(np.float32)
        told = []
        for start, actions in zip(starts, moves, strict=True):
            identity, kind, reading = pool.begin(start, lambda moment: type(moment.env))
            assert kind in (Plane, Closable)
            gc.collect()
            for step in range(12):
                told.append((identity, *map(bytes, reading)))
                if not reading.over:
                    identity, reading = pool.advance(start, identity, actions[:step], actions[step])
        # An episode without an end keeps its environment; one of each first three is only inspected.
        assert pool.num_made <= 5 + 3
        assert env.spec.obs.shape == (4,)
        found.append(told)
    assert found[0] == found[1]


def test_vector_environments_of_another_kind_are_refused() -> None:
    native = partial(gymnasium.make_vec, "CartPole-v1", vectorization_mode="vector_entry_point")
    wrapped = partial(gymnasium.wrappers.vector.ClipReward, min_reward=0.0)
    for make, name, single in (
        (native, "CartPoleVectorEnv", "CartPole-v1"),
        (lambda: wrapped(many_planes("NEXT_STEP")), "ClipReward", "ID"),
    ):
        with pytest.raises(UsageError, match=f"make returns {name}, a vector .*cannot be") as error:
            fresh(PLANE, make=make).environment()
        assert f'single environment, such as gymnasium.make("{single}")' in str(error.value)
        assert "\n" not in str(error.value)


def test_accelerators_call_the_host_in_another_way(monkeypatch: pytest.MonkeyPatch) -> None:
    described = fresh(PLANE)
    env, keys = described.environment(), jax.random.split(jax.random.key(0), 3)

    def begin_and_step(key):
        state, _ = env.reset(key, env.sample_task(key))
        return env.step(state, jnp.float32([0.1, -1.0]))[1]

    told = []
    for backend in ("cpu", "gpu"):
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        told.append(jax.jit(jax.vmap(partial(begin_and_step)))(keys))
    jax.tree.map(np.testing.assert_array_equal, *told)


class InPlace(Plane):
    """Writes what it tells into one array of float32."""

    def look(self):
        seen = super().look()
        if not hasattr(self, "kept"):
            self.kept = np.zeros(4, np.float32)
        self.kept[:] = seen["observation"]
        return {**seen, "observation": self.kept}


def test_what_was_told_stays_as_it_was() -> None:
    described, start = fresh(PLANE, make=InPlace), Start(3, ())
    first, _, reading = described.pool.begin(start)
    kept = reading.obs.copy()
    moves = np.full((1, 2), 0.5, np.float32)
    described.pool.advance(start, first, moves[:0], moves[0])
    np.testing.assert_array_equal(reading.obs, kept)


class OneGoal(Plane):
    """Writes its goals into one array of float32."""

    def look(self):
        seen = super().look()
        if not hasattr(self, "aim"):
            self.aim = np.zeros(2, np.float32)
        self.aim[:] = seen["desired_goal"]
        return {**seen, "desired_goal": self.aim}


def test_goals_are_read_before_others_may_use_the_environment() -> None:
    are_shared = []

    def desired(moment: Moment) -> np.ndarray:
        lives = described.pool._live.values()
        are_shared.append(any(live.env is moment.env for live in lives))
        return moment.obs["desired_goal"]

    described = fresh(PLANE, make=OneGoal, most=1, desired=desired)
    env = described.environment()
    tasks = jax.vmap(env.sample_task)(jax.random.split(jax.random.key(0), 2))
    assert are_shared
    assert not any(are_shared)
    first, second = np.asarray(jax.vmap(env.task_goal)(tasks))
    assert (first != second).any()


class Forgetful(Plane):
    """Its place depends on all episodes before."""

    visits = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        Forgetful.visits += 1
        self.place = self.place + 0.01 * Forgetful.visits
        return self.look(), {}


def test_what_does_not_repeat_itself_is_refused() -> None:
    described = fresh(PLANE, make=Forgetful)
    start, moves = Start(3, ()), np.zeros((2, 2), np.float32)
    first, _, _ = described.pool.begin(start)
    second, _ = described.pool.advance(start, first, moves[:0], moves[0])
    described.pool.advance(start, second, moves[:1], moves[1])
    with pytest.raises(
        DataError, match="is not reproducible: after reset with seed 3 and the same 1 actions"
    ):
        described.pool.advance(start, second, moves[:1], moves[1] + 1)


@pytest.mark.slow
def test_the_check_finds_what_does_not_repeat_itself() -> None:
    report = envs.check_world(fresh(PLANE, make=Forgetful).world(num_test_tasks=4))
    assert any("not pure" in text or "deterministic" in text for text in report.faults)


def test_an_error_of_the_environment_ends_the_program() -> None:
    env = fresh(PLANE, make=own_gymnasium.Broken).environment()
    state, _ = env.reset(jax.random.key(0), env.sample_task(jax.random.key(0)))
    with pytest.raises(Exception, match="the motor is off"):
        jax.block_until_ready(jax.jit(env.step)(state, jnp.zeros(2)))


def test_numbers_that_are_not_finite_break_the_world_down() -> None:
    class Diverging(Plane):
        def look(self):
            return {**super().look(), "observation": np.full(4, np.nan)}

    env = fresh(PLANE, make=Diverging).environment()
    state, _ = env.reset(jax.random.key(0), env.sample_task(jax.random.key(0)))
    _, told = jax.jit(env.step)(state, jnp.zeros(2))
    assert told.failed
    assert told.terminated
    assert np.isfinite(told.obs).all()


def test_actions_have_the_units_of_the_environment() -> None:
    np.testing.assert_allclose(PLANE.to_env(np.float32([1, -1])), [0.5, -0.25])
    np.testing.assert_allclose(PLANE.to_env(np.float32([0, 3])), [0, 0.25])
    np.testing.assert_allclose(PLANE.to_program([0.25, 0.25]), [0.5, 1])
    assert SWITCHES.to_env(np.asarray(2)) == 7
    assert SWITCHES.to_program(7) == 2


def test_repeated_steps_are_one_action() -> None:
    gymnasium.register("mgpo_test/Plane-v0", entry_point=Plane, max_episode_steps=10)
    described = fresh(
        PLANE, repeat=3, horizon=None, make=lambda: gymnasium.make("mgpo_test/Plane-v0")
    )
    env = described.environment()
    assert env.spec.horizon == 4
    state, first = env.reset(jax.random.key(0), env.sample_task(jax.random.key(4)))
    _, told = env.step(state, jnp.float32([0.1, 0]))
    assert told.terminated or np.allclose(told.obs[0] - first.obs[0], 0.15, atol=1e-6)


def test_observations_are_joined_and_goals_are_drawn() -> None:
    env = SWITCHES.environment()
    spec = env.spec
    assert (spec.obs.shape, spec.obs.dtype, spec.goal_dim) == ((7,), "float32", 3)
    assert spec.actions == envs.Discrete(3)
    assert env.goal_set.shape == (3, 3)
    assert env.sample_goal(jax.random.key(0)).sum() == 1
    with pytest.raises(NotAvailableError, match="plane draws no goals"):
        PLANE.environment().sample_goal(jax.random.key(0))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"desired": lambda moment: [1.0]}, r"desired of plane has shape \[1\], achieved has \[2\]"),
        ({"horizon": None}, "no max_episode_steps; say after how many actions"),
        ({"deterministic": False}, "pass options, or leave out deterministic=False"),
        ({"repeat": 0}, "repeat of plane must be at least 1"),
        ({"threads": 0}, "threads of plane must be at least 1"),
        ({"make": own_gymnasium.Switches}, "have no achieved_goal; say how to read it"),
        (
            {"make": lambda: gymnasium.wrappers.TransformAction(
                Plane(), lambda a: a, gymnasium.spaces.Box(-np.inf, np.inf, (2,)))},
            "a Box with finite bounds",
        ),
        ({"observe": lambda moment: np.array("far")}, "arrays of dtype <U3 are not supported"),
    ],
)  # fmt: skip
def test_what_cannot_be_a_world(changes, says) -> None:
    with pytest.raises(UsageError, match=says):
        fresh(PLANE, **changes).environment()


def test_a_pool_needs_no_world() -> None:
    pool = Pool(PLANE.make, PLANE.reset, PLANE.step, PLANE.read, most=2)
    first, moment, reading = pool.begin(Start(1, ()), lambda moment: moment)
    assert len(first) == 8
    np.testing.assert_allclose(reading.obs, moment.obs["observation"].astype(np.float32))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    here = tmp_path_factory.mktemp("own")
    shutil.copy(Path(__file__).with_name("own_gymnasium.py"), here)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        patch.delenv("MGPO_DATA", raising=False)
        patch.setattr(runtime, "configure", lambda: None)
        patch.setattr(sys, "path", list(sys.path))
        yield here


def command(line: str) -> None:
    name, *words = line.split()
    with pytest.raises(SystemExit) as stop:
        importlib.import_module(f"experiments.{name}").command(words)
    assert not stop.value.code, line


COLLECT = "collect --env own_gymnasium:WORLD --trajectories 40"
ADAPT = (
    "adapt --env own_gymnasium:WORLD --seeds 2 --episodes 6 --eval-every 3 --no-figures --policy "
)
PRETRAIN = (
    "pretrain --env own_gymnasium:WORLD --preset smoke --trajectories 40 --holdout 8 --embed-dim 8 "
    "--num-layers 1 --num-heads 2 --steps 2 --batch-size 8 --part-size 4 --eval-tasks 2 --eval-every 2 "
    "--save-every 2 --out run"
)


def save_untrained(folder: Path) -> None:
    """A policy that knows nothing."""
    spec = PLANE.environment().spec
    config = network_config(spec, embed_dim=8, num_layers=1, num_heads=2, max_prompt_length=3)
    prompt = single_goal(jnp.zeros(spec.goal_dim), config.max_prompt_length)
    obs, actions = jnp.zeros((1, *spec.obs.shape)), jnp.zeros((1, spec.action_dim))
    params = GoalTransformer(config).init(jax.random.key(1), prompt, obs, actions)
    mgpo_jax.save_policy(folder, config, params, {"env": "own_gymnasium:WORLD"})


def test_a_script_demonstrates(folder: Path) -> None:
    command(COLLECT.replace("--trajectories 40", "--trajectories 12"))
    with np.load("data/plane/straight-12-seed0/trajectories.npz") as file:
        assert file["lengths"].max() <= 12
        assert file["obs"].shape[1:] == (4,)
        assert file["rewards"].sum() == 12


@pytest.mark.slow
def test_an_untrained_policy_adapts(folder: Path) -> None:
    save_untrained(Path("untrained"))
    command(f"{ADAPT} untrained --out untrained-ucb")
    summary = json.loads(Path("untrained-ucb/summary.json").read_text())
    assert summary["optimal_return"] == 1


@pytest.mark.slow
def test_all_commands_take_them(folder: Path) -> None:
    noisy = "--action-noise 0.1 --episodes 2 --json noise.json"
    for line in (COLLECT, PRETRAIN, f"{ADAPT} run/policy --out ucb", f"evaluate ucb {noisy}"):
        command(line)
    command("table ucb")


def test_an_error_on_the_host_is_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        importlib.import_module("experiments.check").command(["own_gymnasium:BROKEN"])
    assert stop.value.code == 1
    assert capsys.readouterr().err.strip() == "error: RuntimeError: the motor is off"
