"""What every world promises to the method, checked for each that ``envs.make`` knows."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs


def installed(name):
    try:
        return envs.make(name) is not None
    except ImportError:
        return False


# Variants (kitchen-mjx) are one world with other physics, which tests/test_kitchen.py compares.
NAMES = [name for name in envs.ENVIRONMENTS if "-" not in name and installed(name)]
NUM_TASKS = 256
NUM_LANES = 16
AFTER_END = 4  # steps beyond the horizon

every_world = pytest.mark.parametrize("name", NAMES)


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


@pytest.fixture(scope="module", params=NAMES)
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
    assert spec.name == name
    assert isinstance(env, envs.Environment)
    key = jax.random.key(0)
    task = jax.eval_shape(env.sample_task, key)
    state, first = jax.eval_shape(env.reset, key, task)
    action = jax.ShapeDtypeStruct(
        *(((), jnp.int32) if spec.discrete else ((spec.action_dim,), jnp.float32))
    )
    next_state, timestep = jax.eval_shape(env.step, state, action)

    def shapes(tree):
        return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)

    # A scan needs states and time steps that keep shape and type.
    assert shapes(next_state) == shapes(state)
    assert shapes(timestep) == shapes(first)
    scalar, flag = ((), jnp.float32), ((), jnp.bool_)
    assert shapes(timestep)._asdict() == {
        "obs": ((spec.obs_dim,), jnp.float32),
        "goal": ((spec.goal_dim,), jnp.float32),
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
    assert shapes(jax.eval_shape(env.optimal_return, task)) == scalar
    fingerprint = jax.eval_shape(env.fingerprint, task)
    assert fingerprint.ndim == 1
    assert jnp.issubdtype(fingerprint.dtype, jnp.integer)


@every_world
def test_equal_worlds_share_one_program(name):
    traces = []

    @partial(jax.jit, static_argnums=0)
    def draw(env, key):
        traces.append(env.spec.name)
        return env.sample_goal(key)

    for seed in range(3):
        draw(envs.make(name), jax.random.key(seed))
    assert traces == [name]
    assert envs.make(name) == envs.make(name)
    assert hash(envs.make(name)) == hash(envs.make(name))


def test_different_worlds_differ():
    assert len({envs.make(name) for name in NAMES}) == len(NAMES)


def test_vmap_equals_loop(world):
    for lane in range(3):
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
        for field in ("obs", "goal", "outcome", "terminated", "truncated"):
            rows = getattr(steps, field)[lane, end:]
            assert (rows == rows[0]).all(), field
        # While the episode runs, at least a step counter moves.
        assert not unchanged[lane, : end + 1].any()


def test_returns_stay_in_the_range_of_the_spec(world):
    low, high = world["env"].spec.return_range
    assert low < high
    for returns in (world["steps"].reward.sum(1), world["best"]):
        assert np.isfinite(returns).all()
        assert (returns >= low - 1e-4).all()
        assert (returns <= high + 1e-4).all()


def test_no_play_beats_the_optimal_return(world):
    best = np.sort(world["best"])[::-1][:NUM_LANES]
    assert (world["steps"].reward.sum(1) <= best + 1e-4).all()


def test_the_outcome_of_a_solved_task_is_its_goal(world):
    steps = world["steps"]
    goals = np.asarray(jax.vmap(world["env"].task_goal)(world["easy"]))
    solved = steps.terminated.any(1)
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


class TestUnknownNames:
    @pytest.mark.parametrize(("wrong", "right"), [("maze16", "maze1[56]"), ("Maze30", "maze30")])
    def test_the_nearest_name_is_offered(self, wrong, right):
        with pytest.raises(ValueError, match=f"{wrong}.*did you mean '{right}'"):
            envs.make(wrong)

    def test_nothing_is_offered_for_what_is_like_none(self):
        with pytest.raises(ValueError, match="unknown environment 'zzz'") as raised:
            envs.make("zzz")
        assert "did you mean" not in str(raised.value)
        assert all(name in str(raised.value) for name in NAMES)
