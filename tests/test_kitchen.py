"""The kitchen: its rules on handmade cases, and its physics against MuJoCo and gymnasium-robotics."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from importlib.metadata import PackageNotFoundError
from itertools import permutations
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import require_kitchen
from jax.sharding import PartitionSpec

import envs
from envs.errors import MissingExtraError
from envs.kitchen import NoOpenGLError, extra
from envs.kitchen.demonstrators import kitchen_demonstrators
from envs.kitchen.engines import resolve_backend
from envs.kitchen.env import NONE, SUBTASKS, Kitchen, KitchenState, KitchenTask
from envs.kitchen.fidelity import jit_for
from mgpo_jax.sharding import device_mesh

require_kitchen()
import mujoco  # noqa: E402

HORIZON = 500
WORLD = Kitchen(name="kitchen", horizon=HORIZON)
NATIVE = Kitchen(name="kitchen", horizon=HORIZON, backend="native")  # WORLD is MJX on a GPU
MJX = Kitchen(name="kitchen-mjx", horizon=HORIZON, backend="mjx")
STOCK = Kitchen(name="stock", horizon=HORIZON, model="stock")
NUM_TASKS = 325
BURNER, LIGHT, SLIDE, HINGE, MICROWAVE = range(5)
# Places in the 14 positions of the reduced model, and positions that complete the subtask and that do not.
OBJECTS = {
    BURNER: (9, -0.88, -0.5),
    LIGHT: (10, -0.69, -0.3),
    SLIDE: (11, 0.37, 0.05),
    HINGE: (12, 1.45, 1.1),
    MICROWAVE: (13, -0.75, -0.4),
}


def padded(order) -> np.ndarray:
    return np.array([*order, *[NONE] * (5 - len(order))], np.int32)


def multi_hot(subtasks) -> np.ndarray:
    return np.isin(np.arange(5), list(subtasks)).astype(np.float32)


@cache
def stepper(env):
    return jax.jit(env.step)


@cache
def many_stepper(env):
    return jit_for(env)(jax.vmap(env.step))


def begin(order, env=WORLD):
    return env.reset(jax.random.key(0), KitchenTask(jnp.asarray(padded(order))))[0]


def put(state, *subtasks, short=False):
    """The state with these objects where they complete their subtasks, or short of it."""
    qpos = state.physics.qpos
    for subtask in subtasks:
        place, complete, incomplete = OBJECTS[subtask]
        qpos = qpos.at[place].set(incomplete if short else complete)
    return state._replace(physics=state.physics._replace(qpos=qpos))


def wait(state, env=WORLD):
    return stepper(env)(state, jnp.zeros(9))


def random_actions(seed, *shape) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (*shape, 9)).astype(np.float32)


class TestRules:
    def test_reset(self):
        state, first = WORLD.reset(jax.random.key(3), KitchenTask(jnp.asarray(padded([2]))))
        np.testing.assert_allclose(first.obs[:3], [0.148388, -1.768486, 1.843903], atol=1e-5)
        assert (first.obs[9:18] == 0).all()
        assert not first.goal_reached
        assert not state.done
        assert (first.outcome == 0).all()

    @pytest.mark.parametrize("subtask", range(5))
    def test_thresholds(self, subtask):
        _, timestep = wait(put(begin([subtask]), subtask, short=True))
        assert timestep.reward == 0
        state, timestep = wait(put(begin([subtask]), subtask))
        assert timestep.reward == 1
        assert timestep.goal_reached
        np.testing.assert_array_equal(timestep.achieved_goal, multi_hot([subtask]))
        np.testing.assert_array_equal(timestep.outcome, multi_hot([subtask]))
        assert timestep.terminated
        assert state.done

    def test_in_order_pays_shares(self):
        state, rewards = begin([MICROWAVE, LIGHT, HINGE]), []
        for subtask in (MICROWAVE, LIGHT, HINGE):
            state, timestep = wait(put(state, subtask))
            rewards.append(float(timestep.reward))
            state, timestep = wait(state)
            assert not timestep.goal_reached or timestep.terminated
        np.testing.assert_allclose(rewards, [1 / 3] * 3, rtol=1e-6)
        assert WORLD.num_parts(state.task) == 3
        assert timestep.terminated

    def test_a_later_one_too_early_ends_all_reward(self):
        state = begin([MICROWAVE, LIGHT])
        for subtask in (LIGHT, MICROWAVE):
            state, timestep = wait(put(state, subtask))
            np.testing.assert_array_equal(timestep.achieved_goal, multi_hot([subtask]))
            assert timestep.reward == 0
        assert not timestep.terminated
        np.testing.assert_array_equal(timestep.outcome, multi_hot([LIGHT, MICROWAVE]))

    def test_others_do_not_matter(self):
        state, timestep = wait(put(begin([LIGHT]), SLIDE))
        assert timestep.reward == 0
        state, timestep = wait(put(state, LIGHT))
        assert timestep.reward == 1

    def test_completed_stays_completed(self):
        """Unlike in GridWorld; and an object that moves back and forth is a goal once."""
        state, _ = wait(put(begin([SLIDE, LIGHT]), SLIDE))
        state, timestep = wait(put(state, SLIDE, short=True))
        np.testing.assert_array_equal(timestep.outcome, multi_hot([SLIDE]))
        state, timestep = wait(put(state, SLIDE))
        assert not timestep.goal_reached
        state, timestep = wait(put(state, LIGHT))
        assert timestep.reward == 0.5
        assert timestep.terminated

    def test_two_at_once_count_one_after_the_other(self):
        state, first = wait(put(begin([SLIDE, HINGE]), SLIDE, HINGE))
        _, second = wait(state)
        np.testing.assert_array_equal(first.achieved_goal, multi_hot([SLIDE]))
        np.testing.assert_array_equal(second.achieved_goal, multi_hot([HINGE]))
        assert first.reward == second.reward == 0.5

    def test_of_two_at_once_the_next_of_the_task_counts_first(self):
        state, first = wait(put(begin([HINGE, SLIDE]), SLIDE, HINGE))
        _, second = wait(state)
        np.testing.assert_array_equal(first.achieved_goal, multi_hot([HINGE]))
        np.testing.assert_array_equal(second.achieved_goal, multi_hot([SLIDE]))
        assert first.reward == second.reward == 0.5

    def test_the_horizon_truncates_and_absorbs(self):
        short = Kitchen(name="short", horizon=3)
        state = begin([LIGHT], short)
        for step in range(1, 6):
            state, timestep = wait(state, short)
            assert timestep.truncated == (step >= 3)
        assert state.steps == 3
        state, timestep = wait(put(state, LIGHT), short)
        assert timestep.reward == 0

    def test_derived_positions(self):
        """Burner and lamp follow their switches; the kettle and the rest stand still."""
        moved = put(begin([LIGHT]), BURNER, LIGHT)
        _, timestep = wait(moved)
        obs = np.asarray(timestep.obs)
        np.testing.assert_allclose(obs[[21, 27]], obs[[20, 26]] / [174, 14], rtol=1e-5)
        np.testing.assert_allclose(obs[32:39], [-0.2694, 0.3504, 1.6203, 1, 0, 0, 0], atol=1e-6)
        np.testing.assert_allclose(obs[[20, 26]], [-0.88, -0.69], atol=0.05)


class TestTasks:
    def test_all_orders_once(self):
        orders = np.asarray(jax.jit(jax.vmap(WORLD.task))(jnp.arange(NUM_TASKS + 5)).order)
        found = [tuple(row[row >= 0].tolist()) for row in orders[:NUM_TASKS]]
        expected = {order for num in range(1, 6) for order in permutations(range(5), num)}
        assert WORLD.num_tasks == len(expected) == NUM_TASKS
        assert len(found) == NUM_TASKS
        assert set(found) == expected
        np.testing.assert_array_equal(orders[NUM_TASKS:], orders[:5])
        WORLD.check_task(KitchenTask(orders))

    def test_a_split_of_25_test_tasks_leaves_300(self):
        from mgpo_jax.tasks import benchmark_tasks, task_hashes

        num = envs.find("kitchen").num_test_tasks
        tests = set(task_hashes(WORLD, benchmark_tasks(WORLD, num)).tolist())
        everything = jax.vmap(WORLD.task)(jnp.arange(NUM_TASKS))
        assert len(tests) == 25
        assert len(set(task_hashes(WORLD, everything).tolist()) - tests) == 300

    def test_goals(self):
        task = KitchenTask(jnp.asarray(padded([4, 0])))
        np.testing.assert_array_equal(WORLD.task_goal(task), multi_hot([0, 4]))
        goals = jax.vmap(WORLD.sample_goal)(jax.random.split(jax.random.key(0), 100))
        assert (np.asarray(goals).sum(axis=1) == 1).all()
        assert (np.asarray(goals).sum(axis=0) > 5).all()
        assert len(SUBTASKS) == 5

    @pytest.mark.parametrize(
        ("order", "message"),
        [
            ([[0, 5, -1, -1, -1]], r"subtasks 0\.\.4, or -1 at the end"),
            ([[-1] * 5], "task 0: no subtasks"),
            ([[0, 1, 2, 3, 4], [0, -1, 1, -1, -1]], "task 1: -1 may only fill the end"),
            ([[1, 1, -1, -1, -1]], r"task 0: a subtask occurs twice in \[1, 1\]"),
            ([0, 1, 2, 3, 4], r"order must have shape \[N, 5\]"),
            ([[0.0, 1, 2, 3, 4]], "order must hold integers"),
        ],
    )
    def test_bad_tasks(self, order, message):
        with pytest.raises(ValueError, match=message):
            WORLD.check_task(KitchenTask(np.array(order)))


def test_the_expert_goes_for_the_next_subtask():
    """After the last subtask of the task it stays with that one."""
    nothing = KitchenState(*[None] * len(KitchenState._fields))
    state = nothing._replace(task=KitchenTask(jnp.asarray(padded([LIGHT, HINGE]))))
    for solved, subtask in ((0, LIGHT), (1, HINGE), (2, HINGE)):
        goal = WORLD.expert_goal(state._replace(num_solved=jnp.int32(solved)), 10)
        np.testing.assert_array_equal(goal, multi_hot([subtask]))


class TestBadInput:
    def test_settings(self):
        for settings, message in (
            ({"backend": "warp"}, "backend must be one of auto, native, mjx, found 'warp'"),
            ({"model": "small"}, "model must be reduced or stock, found 'small'"),
            ({"backend": "mjx", "model": "stock"}, "use backend native"),
        ):
            with pytest.raises(ValueError, match=message):
                Kitchen(name="kitchen", horizon=HORIZON, **settings)

    @pytest.fixture(autouse=True)
    def _fresh(self):
        extra.check_extra.cache_clear()
        yield
        extra.check_extra.cache_clear()

    @pytest.mark.parametrize("package", ["mujoco", "mujoco-mjx", "gymnasium-robotics"])
    def test_a_missing_package(self, monkeypatch, package):
        def version(name):
            if name == package:
                raise PackageNotFoundError(name)
            return "3.17.0"

        monkeypatch.setattr(extra, "version", version)
        with pytest.raises(MissingExtraError, match=rf"{package}: pip install '[^\[]*'$"):
            extra.check_extra()

    def test_demonstrators_of_a_world_made_by_hand(self, monkeypatch):
        versions = {"mujoco": "4.0.0", "mujoco-mjx": "3.17.0"}
        monkeypatch.setattr(extra, "version", versions.get)
        with pytest.raises(MissingExtraError, match=r"pip install"):
            kitchen_demonstrators(WORLD)

    def test_a_wrong_pair(self, monkeypatch):
        versions = {"mujoco": "4.0.0", "mujoco-mjx": "3.17.0"}
        monkeypatch.setattr(extra, "version", versions.get)
        with pytest.raises(
            MissingExtraError, match=r"4\.0\.0 and mujoco-mjx 3\.17\.0 do not match"
        ):
            extra.check_extra()

    def test_an_old_pair(self, monkeypatch, tmp_path):
        monkeypatch.setattr(extra, "version", lambda name: "3.3.0")
        monkeypatch.setattr(extra, "_folders", lambda module: [tmp_path])
        with pytest.raises(MissingExtraError, match=r"mujoco 3\.3\.0 is too old .* pip install"):
            extra.check_extra()

    def test_missing_files(self, monkeypatch):
        monkeypatch.setattr(extra, "SCENE", extra.Path("nowhere.xml"))
        with pytest.raises(MissingExtraError, match=r"no kitchen scene \(nowhere.xml\)"):
            extra.check_extra()

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    @pytest.mark.parametrize("env", [NATIVE, pytest.param(MJX, marks=pytest.mark.slow)])
    def test_an_action_that_is_no_number_ends_its_own_episode(self, env, bad):
        step_many = many_stepper(env)
        states = jax.vmap(lambda _: begin([LIGHT], env))(jnp.arange(4))
        actions = jnp.asarray(random_actions(0, 4)).at[2, 5].set(bad)
        after, steps = step_many(states, actions)
        assert after.failed.tolist() == after.done.tolist() == [False, False, True, False]
        assert steps.truncated.tolist() == [False, False, True, False]
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(after.physics))
        clean, _ = step_many(states, jnp.where(jnp.isfinite(actions), actions, 0))
        for one, other in zip(after.physics, clean.physics, strict=True):
            np.testing.assert_array_equal(one[:2], other[:2])

    @pytest.mark.parametrize("speed", [1e5, 1e15, 1e30])
    @pytest.mark.parametrize("env", [NATIVE, pytest.param(MJX, marks=pytest.mark.slow)])
    def test_a_diverged_world_ends_its_own_episode(self, env, speed):
        num = 20  # enough for several threads
        step_many = many_stepper(env)
        states = jax.vmap(lambda _: begin([LIGHT], env))(jnp.arange(num))
        bad = jnp.arange(num) % 7 == 1
        qvel = jnp.where(bad[:, None], speed, states.physics.qvel)
        broken = states._replace(physics=states.physics._replace(qvel=qvel))
        after, steps = step_many(broken, jnp.zeros((num, 9)))
        np.testing.assert_array_equal(after.failed, bad)
        np.testing.assert_array_equal(steps.truncated, bad)
        np.testing.assert_array_equal(steps.failed, bad)
        assert (steps.reward == 0).all()
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(after.physics))
        whole, _ = step_many(states, jnp.zeros((num, 9)))
        np.testing.assert_array_equal(after.physics.qpos[~bad], whole.physics.qpos[~bad])
        assert not Path("MUJOCO_LOG.TXT").exists()


@pytest.mark.parametrize("library", ["nonsense", "osmesa"])
def test_an_opengl_that_is_not_there(library):
    """MuJoCo looks for it when it is imported."""
    code = (
        "import ctypes, ctypes.util as util; util.find_library = lambda name: None\n"
        "import envs\ntry: envs.find('kitchen').make()\n"
        "except ImportError as error: print(type(error).__name__, error)\n"
        "else: print('found')"
    )
    found = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "MUJOCO_GL": library},
        capture_output=True,
        text=True,
        check=True,
    )
    assert found.stdout.startswith(NoOpenGLError.__name__) or (
        library == "osmesa" and found.stdout == "found\n"
    )
    if library == "nonsense":
        assert "found MUJOCO_GL=nonsense" in found.stdout


def test_other_worlds_do_not_load_physics():
    code = (
        "import sys, envs; "
        "envs.find('gridworld').demonstrators(envs.make('gridworld')); "
        "assert 'mujoco' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


class TestNative:
    def test_it_is_mujoco(self):
        """A batched scan against a plain loop over the same model in double precision."""
        from envs.kitchen.model import load_model

        actions = random_actions(1, 3, 12)
        scan = jax.jit(jax.vmap(lambda state, rows: jax.lax.scan(WORLD.step, state, rows)))
        state = jax.vmap(lambda _: begin([LIGHT]))(jnp.arange(3))
        obs = np.asarray(scan(state, actions)[1].obs)
        model = load_model("reduced")
        low, high = np.array([-2.9] * 9), np.array([2.9] * 9)
        low[[1, 3, 5, 7, 8]], high[[1, 3, 5, 7, 8]] = (
            [-1.8, -3.1, 0, 0, 0],
            [1.8, 0, 3.8, 0.04, 0.04],
        )
        for world in range(3):
            data = mujoco.MjData(model)
            data.qpos[:] = np.asarray(state.physics.qpos[world])
            for step, action in enumerate(actions[world]):
                data.ctrl[:] = np.clip(data.qpos[:9] + 0.16 * action, low, high)
                mujoco.mj_step(model, data, 10)
                np.testing.assert_allclose(obs[world, step, :9], data.qpos[:9], atol=1e-4)

    @pytest.mark.skipif(jax.device_count() < 2, reason="needs two devices")
    @pytest.mark.parametrize(("lanes", "steps"), [(24, 30), (2000, 2)])
    def test_two_devices(self, lanes, steps):
        """Each runs its own part of the lanes, as in adaptation, and calls at the same time."""
        spec = PartitionSpec("data")
        actions = random_actions(4, lanes, steps)
        state = jax.tree.map(jnp.asarray, begin([LIGHT]))

        def play(rows):
            return jax.vmap(lambda rows: jax.lax.scan(WORLD.step, state, rows)[1].obs)(rows)

        sharded = jax.jit(
            jax.shard_map(play, mesh=device_mesh(2), in_specs=spec, out_specs=spec, check_vma=False)
        )
        expected = np.asarray(jax.jit(play)(actions))
        for _ in range(3):
            np.testing.assert_allclose(sharded(actions), expected, atol=1e-5)

    def test_threads_share_it(self):
        stepper = NATIVE.physics  # loads the model once, before the threads
        state = jax.tree.map(jnp.asarray, stepper.initial)
        advance = jax.jit(jax.vmap(partial(stepper.advance, state, active=jnp.array(True))))
        targets = state.qpos[:9] + 0.1 * jnp.asarray(random_actions(2, 8, 16))
        expected = [np.asarray(advance(rows).qpos) for rows in targets]
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(lambda rows: np.asarray(advance(rows).qpos), targets))
        np.testing.assert_array_equal(found, expected)


@pytest.fixture(scope="module")
def kitchen():
    """FrankaKitchen of gymnasium-robotics."""
    pytest.importorskip("gymnasium_robotics")
    from envs.kitchen.official import franka_kitchen

    return franka_kitchen(HORIZON).unwrapped


class TestOracle:
    """Our world on the stock model is FrankaKitchen, step for step."""

    def test_observations(self, kitchen):
        actions = 1.3 * random_actions(3, 25)  # beyond the bounds too
        state = begin([LIGHT], STOCK)
        kitchen.reset(seed=0)
        for action in actions:
            state, timestep = stepper(STOCK)(state, jnp.asarray(action))
            expected = kitchen.step(action)[0]["observation"]
            np.testing.assert_array_equal(timestep.obs, expected.astype(np.float32))

    def test_completion(self, kitchen):
        """On positions around the thresholds, set in both."""
        rng = np.random.default_rng(0)
        arrived = jax.jit(STOCK._at_target)
        physics = begin([LIGHT], STOCK).physics
        counts = np.zeros(5, int)
        for _ in range(40):
            qpos = np.asarray(physics.qpos).astype(np.float64)
            for subtask, (_, complete, _) in OBJECTS.items():
                qpos[[11, 17, 19, 21, 22][subtask]] = complete + rng.uniform(-0.6, 0.6)
            found = np.asarray(arrived(physics._replace(qpos=jnp.asarray(qpos, jnp.float32))))
            kitchen.robot_env.set_state(qpos, np.zeros(29))
            achieved = kitchen._get_obs(np.zeros(18))["achieved_goal"]
            kitchen.tasks_to_complete = set(SUBTASKS)
            kitchen.compute_reward(achieved, kitchen.goal, {})
            expected = [name in kitchen.step_task_completions for name in SUBTASKS]
            assert found.tolist() == expected
            counts += expected
        assert (counts > 5).all()
        assert (counts < 35).all()


def test_the_stock_model_without_visual_shapes_moves_in_the_same_bits():
    """20 random control steps of MuJoCo's own batch stepper on the whole scene and on ours."""
    from mujoco.batch import Batch

    from envs.kitchen.model import INITIAL_POSITIONS, SUBSTEPS, full_model, load_model

    actions = random_actions(9, 4, 20)
    whole, ours = full_model(), load_model("stock")
    assert ours.ngeom < whole.ngeom
    batches = [Batch(model, len(actions), 1) for model in (whole, ours)]
    for batch in batches:
        qpos, ctrl = batch.bind("qpos"), batch.bind("ctrl")
        qpos[:] = INITIAL_POSITIONS
        for step in range(actions.shape[1]):
            ctrl[:] = qpos[:, :9] + 0.16 * actions[:, step]
            batch.step(nstep=SUBSTEPS["stock"])
    first, second = (batch.bind("qpos") for batch in batches)
    assert np.abs(first - INITIAL_POSITIONS).max() > 0.1
    np.testing.assert_array_equal(first, second)


def test_one_step_of_mjx_is_one_of_native():
    actions = random_actions(5, 3)
    after = [
        jit_for(env)(
            jax.vmap(lambda action, env=env: env.step(begin([LIGHT], env), action)[1].obs)
        )(actions)
        for env in (NATIVE, MJX)
    ]
    np.testing.assert_allclose(*after, atol=5e-3)
    assert np.median(np.abs(after[0] - after[1])) < 1e-5


@pytest.mark.parametrize(
    ("device", "model", "engine"),
    [
        ("cpu", "reduced", "native"),
        ("cpu", "stock", "native"),
        ("gpu", "reduced", "mjx"),
        ("tpu", "reduced", "mjx"),
        ("gpu", "stock", "native"),
    ],
)
def test_mjx_is_the_default_on_accelerators_where_it_can_run_the_scene(
    monkeypatch, device, model, engine
):
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    assert resolve_backend("auto", model) == engine
    assert {resolve_backend(name, model) for name in ("native", "mjx")} == {"native", "mjx"}


def test_accelerators_call_c_through_a_pure_callback(monkeypatch):
    state, action = begin([LIGHT]), jnp.asarray(random_actions(6))
    expected, _ = stepper(NATIVE)(state, action)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    again = Kitchen(name="traced anew", horizon=HORIZON, backend="native")
    found, _ = jax.jit(again.step)(state, action)
    for one, other in zip(found.physics, expected.physics, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_mjx_follows_native():
    from envs.kitchen.fidelity import kitchen, random_actions, record

    actions = random_actions(4, 20)
    native, mjx = (record(kitchen(name, horizon=20), actions).obs for name in ("native", "mjx"))
    errors = np.abs(mjx - native)
    assert errors.max() < 5e-3
    assert np.median(errors) < 1e-5
