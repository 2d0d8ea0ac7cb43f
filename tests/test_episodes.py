"""The episode loop: batches of episodes against single ones, and replays."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

import envs
from envs.agents import Agent
from envs.episodes import MAX_SEGMENTS, num_segments, replay, run_episode
from envs.specs import Engine
from envs.wrappers import Noisy

MAZE = envs.make("maze15")
GRID = envs.make("gridworld")
NUM = 8


def stroller(env, quit_rate=0.02):
    """Random actions; quits with the given probability at every step."""

    def act(key):
        key_action, key_quit = jax.random.split(key)
        action = jax.random.randint(key_action, (), 0, env.spec.action_dim)
        return action, jax.random.bernoulli(key_quit, quit_rate), ()

    return Agent(
        begin=lambda key, task, state, timestep: act(key),
        proceed=lambda key, memory, state, timestep: act(key),
    )


def expert(env):
    demonstrator = envs.find("gridworld").demonstrators(env)["expert"]
    return demonstrator.agent(demonstrator.weights)


def keys_and_tasks(env, num=NUM):
    keys = jax.random.split(jax.random.key(1), num)
    return keys, jax.vmap(env.sample_task)(jax.random.split(jax.random.key(2), num))


def at(tree, index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


def assert_trees_equal(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(np.testing.assert_array_equal, a, b)


CASES = [(MAZE, stroller), (GRID, stroller), (GRID, expert)]


@pytest.mark.parametrize(("env", "make_agent"), CASES)
def test_a_batch_equals_single_episodes(env, make_agent):
    """No axis has a name; episodes of one batch end at different times."""
    keys, tasks = keys_and_tasks(env)
    play = partial(run_episode, env=env, agent=make_agent(env))
    one = jax.jit(lambda key, task: play(key, task=task))
    together = jax.jit(jax.vmap(one))(keys, tasks)
    for index in range(NUM):
        assert_trees_equal(one(keys[index], at(tasks, index)), at(together, index))
    # Batches in batches, as of seeds and tasks, share the clock as well.
    folded = jax.tree.map(lambda leaf: leaf.reshape(2, NUM // 2, *leaf.shape[1:]), (keys, tasks))
    nested = jax.jit(jax.vmap(jax.vmap(one)))(*folded)
    assert_trees_equal(
        together, jax.tree.map(lambda leaf: leaf.reshape(NUM, *leaf.shape[2:]), nested)
    )
    lengths = np.asarray(together.trajectory.length)
    assert len(set(lengths)) > 3  # the comparison means something
    for index, length in enumerate(lengths):
        for rows in (*together.trajectory.steps.values(), together.rewards):
            assert not np.asarray(rows[index, length:]).any()


def test_the_clock_of_a_batch_is_shared():
    """No step selects between the old and the new memory of an agent, which may be large."""
    size = 12_345

    def act(memory):
        return jnp.zeros((), jnp.int32), jnp.zeros((), bool), memory + 1

    agent = Agent(
        begin=lambda key, task, state, timestep: act(jnp.zeros(size)),
        proceed=lambda key, memory, state, timestep: act(memory),
    )
    keys, tasks = keys_and_tasks(MAZE)
    play = jax.vmap(lambda key, task: run_episode(key, MAZE, agent, task))
    assert f"{size}]" in str(jax.make_jaxpr(play)(keys, tasks))
    chosen = [
        variable.aval.shape
        for equation in equations(jax.make_jaxpr(play)(keys, tasks).jaxpr)
        if equation.primitive.name == "select_n"
        for variable in equation.outvars
    ]
    assert chosen
    assert all(size not in shape for shape in chosen)


def equations(jaxpr):
    """All equations of a program, those of its loops and branches included."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in jaxprs_in_params(equation.params):
            yield from equations(inner)


@pytest.mark.parametrize(("env", "make_agent"), [*CASES, (Noisy(MAZE, 0.1, 0.3), stroller)])
def test_an_episode_played_again_is_the_same(env, make_agent):
    """Key and actions determine it: where the agent starts, what noise it meets, what it earns."""
    keys, tasks = keys_and_tasks(env)
    play = jax.jit(jax.vmap(lambda key, task: run_episode(key, env, make_agent(env), task)))
    episodes = play(keys, tasks)
    trajectory = episodes.trajectory
    again = jax.jit(
        jax.vmap(lambda key, task, actions, length: replay(key, env, task, actions, length))
    )
    assert_trees_equal(again(keys, tasks, trajectory.actions, trajectory.length), episodes)
    if not env.spec.deterministic:  # another key is another episode
        others = again(keys[::-1], tasks, trajectory.actions, trajectory.length)
        assert (others.trajectory.obs != trajectory.obs).any()


@pytest.mark.parametrize("length", [0, 1, 5])
def test_only_the_real_actions_are_played_again(length):
    key, task = jax.random.key(0), MAZE.sample_task(jax.random.key(3))
    stay = jnp.full(MAZE.spec.horizon, 4)
    again = replay(key, MAZE, task, stay, jnp.int32(length))
    assert again.trajectory.length == length
    assert float(again.return_) == pytest.approx(-0.1 * length)


def test_the_last_observation_comes_after_the_last_action():
    keys, tasks = keys_and_tasks(GRID)
    play = jax.jit(jax.vmap(lambda key, task: run_episode(key, GRID, stroller(GRID), task)))
    episodes = jax.tree.map(np.asarray, play(keys, tasks))
    step = jax.jit(GRID.step)
    for index, length in enumerate(episodes.trajectory.length):
        state, timestep = GRID.reset(jax.random.split(keys[index], 3)[0], at(tasks, index))
        for action in episodes.trajectory.actions[index, :length]:
            state, timestep = step(state, jnp.asarray(action))
        np.testing.assert_array_equal(episodes.last_obs[index], timestep.obs)


def test_what_an_agent_decided_is_kept():
    """Its memory at the end of an episode, as far as it says."""
    counter = Agent(
        begin=lambda key, task, state, timestep: (jnp.int32(4), jnp.array(False), jnp.int32(1)),
        proceed=lambda key, memory, state, timestep: (jnp.int32(4), memory >= 5, memory + 1),
        decisions=lambda memory: {"asked": memory},
    )
    task = MAZE.sample_task(jax.random.key(3))
    episode = run_episode(jax.random.key(0), MAZE, counter, task)
    assert episode.trajectory.length == 5
    assert episode.decisions == {"asked": 6}


def test_what_an_agent_intended_is_kept_beside_what_it_did():
    """It means to count, executes 4 at every other step, and quits after five steps."""

    def step(time):
        return jnp.where(time % 2 == 0, 4, time), time >= 5, time

    agent = Agent(
        begin=lambda key, task, state, timestep: step(jnp.int32(0)),
        proceed=lambda key, memory, state, timestep: step(memory + 1),
        intended=lambda memory: memory,
    )
    task = MAZE.sample_task(jax.random.key(3))

    def play(agent):
        one = jax.jit(lambda key: run_episode(key, MAZE, agent, task))
        return one(jax.random.key(0)).trajectory

    trajectory, silent = play(agent), play(agent._replace(intended=None))
    assert trajectory.actions[:6].tolist() == [4, 1, 4, 3, 4, 0]
    assert trajectory.intended[:6].tolist() == [0, 1, 2, 3, 4, 0]
    assert not np.asarray(trajectory.intended[5:]).any()
    assert trajectory.intended.dtype == trajectory.actions.dtype
    np.testing.assert_array_equal(trajectory.labels, trajectory.intended)
    assert silent.intended is None
    assert "intended" not in silent.steps
    assert_trees_equal(silent, trajectory._replace(intended=None))
    np.testing.assert_array_equal(silent.labels, silent.actions)


@pytest.mark.parametrize("most", [None, 1])
def test_memory_grows_to_the_length_of_the_episode(monkeypatch, most):
    """An agent is given room before each segment, in all for every step after the first."""
    env = GRID
    monkeypatch.setattr(type(env), "engine", Engine(max_segments=most))
    task = env.sample_task(jax.random.key(3))
    grown = []

    def grow(memory, num_steps):
        grown.append(num_steps)
        return jnp.concatenate([memory, jnp.zeros(num_steps)])

    agent = Agent(
        begin=lambda key, task, state, timestep: (jnp.int32(4), jnp.array(False), jnp.zeros(1)),
        proceed=lambda key, memory, state, timestep: (jnp.int32(4), jnp.array(False), memory),
        grow=grow,
        decisions=lambda memory: memory,
    )
    episode = jax.jit(lambda key: run_episode(key, env, agent, task))(jax.random.key(0))
    assert sum(grown) == env.spec.horizon - 1
    assert len(grown) == num_segments(env.spec.horizon, most)
    assert episode.decisions.shape == (env.spec.horizon,)


@pytest.mark.parametrize(
    ("horizon", "num"), [(1, 1), (32, 1), (64, 2), (90, 2), (255, 7), (500, MAX_SEGMENTS)]
)
def test_segments(horizon, num):
    assert num_segments(horizon) == num
    assert num_segments(horizon, 4) == min(num, 4)
