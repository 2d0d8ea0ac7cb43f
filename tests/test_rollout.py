"""Rollouts: golden episodes, lanes against single runs, and cached decoding against the full pass."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

import envs.episodes
from envs.agents import Agent
from envs.episodes import run_episode
from envs.maze.env import EAST, NORTH, STAY, WEST, MazeRunner, MazeTask
from envs.wrappers import Wrapper
from mgpo_jax.network_configs import TransformerConfig
from mgpo_jax.policy import transformer_policy
from mgpo_jax.prompts import Prompt
from mgpo_jax.rollout import Query, prompted, rollout
from mgpo_jax.transformer import GoalTransformer

ENV = MazeRunner(name="tiny", side=7, horizon=12)
DRAWING = """
#######
#.....#
#.###.#
#...#.#
#.#.###
#.#...#
#######
"""
MAZE = jnp.array([[cell == "#" for cell in row] for row in DRAWING.split()], jnp.int32)
CONFIG = TransformerConfig(
    obs_shape=(6,), goal_dim=2, action_dim=5, horizon=12, max_prompt_length=3,
    embed_dim=16, num_layers=1, dropout=0.0,
)  # fmt: skip


def task_to(row, column):
    return MazeTask(MAZE, jnp.array([row, column], jnp.int32))


def scripted(actions, quits_at=-1):
    """Plays a list of actions; quits before the action of step ``quits_at``."""
    script = jnp.asarray(actions, jnp.int32)

    def act(step):
        return script[jnp.minimum(step, len(actions) - 1)], step == quits_at, step + 1

    return Agent(
        lambda key, task, state, timestep: act(jnp.int32(0)),
        lambda key, memory, state, timestep: act(memory),
    )


def noisy(quit_rate):
    """Random actions; quits with the given probability at every step."""

    def act(key):
        key_action, key_quit = jax.random.split(key)
        quits = jax.random.bernoulli(key_quit, quit_rate)
        return jax.random.randint(key_action, (), 0, 5), quits, jnp.zeros(())

    return Agent(
        lambda key, task, state, timestep: act(key),
        lambda key, memory, state, timestep: act(key),
    )


@pytest.fixture(scope="module", autouse=True)
def several_segments():
    """An episode as short as these would run in one segment; borders are to be crossed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(envs.episodes, "SEGMENT_STEPS", 4)
        yield


@pytest.fixture(scope="module")
def params():
    network = GoalTransformer(CONFIG)
    prompt = Prompt(jnp.zeros((3, 2)), jnp.ones(3, bool))
    shapes = jax.eval_shape(
        network.init, jax.random.key(0), prompt, jnp.zeros((2, 6)), jnp.zeros(2, jnp.int32)
    )
    rng = np.random.default_rng(0)
    return jax.tree.map(
        lambda leaf: jnp.asarray(0.4 * rng.standard_normal(leaf.shape), leaf.dtype), shapes
    )


def assert_trees_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_a_scripted_episode_is_recorded_exactly():
    actions = [NORTH, EAST, NORTH, WEST, STAY, WEST]  # bumps into a wall, stands still once
    episode = jax.jit(lambda key: run_episode(key, ENV, scripted(actions), task_to(3, 1)))(
        jax.random.key(0)
    )
    trajectory = episode.trajectory
    seen = [(5, 3, 0, 2, 2, 0), (4, 3, 0, 1, 0, 1), (4, 3, 0, 1, 0, 1),
            (3, 3, 2, 0, 0, 2), (3, 2, 1, 0, 1, 0), (3, 2, 1, 0, 1, 0)]  # fmt: skip
    reached = [(4, 3), (4, 3), (3, 3), (3, 2), (3, 2), (3, 1)]
    assert int(trajectory.length) == 6
    assert float(episode.return_) == pytest.approx(1 - 6 * 0.1)
    rewards = [-0.1] * 5 + [0.9] + [0] * 6
    np.testing.assert_allclose(episode.rewards, rewards, atol=1e-6)
    np.testing.assert_allclose(trajectory.obs[:6] * 7, seen, atol=1e-5)
    np.testing.assert_array_equal(trajectory.actions[:6], actions)
    np.testing.assert_allclose(trajectory.achieved_goals[:6] * 7, reached, atol=1e-5)
    np.testing.assert_array_equal(trajectory.outcomes, trajectory.achieved_goals)
    np.testing.assert_array_equal(trajectory.goal_reached, np.arange(12) < 6)
    for rows in trajectory.steps.values():
        assert rows.shape[0] == 12
        assert not np.asarray(rows[6:]).any()


@pytest.mark.parametrize(("quits_at", "length"), [(-1, 12), (0, 0), (1, 1), (7, 7), (11, 11)])
def test_an_episode_ends_by_quitting_or_at_the_horizon(quits_at, length):
    agent = scripted([NORTH, STAY], quits_at)
    episode = run_episode(jax.random.key(0), ENV, agent, task_to(1, 1))
    assert int(episode.trajectory.length) == length
    assert float(episode.return_) == pytest.approx(-0.1 * length)
    np.testing.assert_array_equal(episode.trajectory.goal_reached, np.arange(12) < length)
    assert not np.asarray(episode.trajectory.obs[length:]).any()


@dataclass(frozen=True)
class Fragile(Wrapper):
    """Breaks down at the first step to the west."""

    def reset(self, key, task):
        state, timestep = self.env.reset(key, task)
        whole = jnp.zeros((), bool)
        return (whole, state), timestep._replace(failed=whole)

    def step(self, state, action):
        broken, inner = state
        broken |= action == WEST
        inner, timestep = self.env.step(inner, action)
        truncated = timestep.truncated | broken
        return (broken, inner), timestep._replace(truncated=truncated, failed=broken)


def test_a_world_that_breaks_down_ends_its_episode_alone():
    def play(second):
        def act(step):
            action = jnp.where(step == 1, second, NORTH)
            return action, jnp.zeros((), bool), step + 1

        agent = Agent(
            lambda key, task, state, timestep: act(jnp.int32(0)),
            lambda key, memory, state, timestep: act(memory),
        )
        return run_episode(jax.random.key(0), Fragile(ENV), agent, task_to(5, 5))

    episodes = jax.vmap(play)(jnp.array([EAST, WEST, NORTH]))
    np.testing.assert_array_equal(episodes.failed, [False, True, False])
    np.testing.assert_array_equal(episodes.trajectory.length, [12, 2, 12])


def test_lanes_equal_single_runs():
    near = [(4, 3), (3, 3), (1, 1), (1, 5), (5, 5), (3, 1), (5, 4), (4, 3)]
    tasks = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[task_to(*cell) for cell in near])
    keys = jax.random.split(jax.random.key(3), len(near))
    single = jax.jit(lambda key, task: run_episode(key, ENV, noisy(0.05), task))
    lanes = jax.jit(jax.vmap(single))(keys, tasks)
    loop = [single(keys[i], jax.tree.map(lambda leaf, i=i: leaf[i], tasks)) for i in range(8)]
    assert_trees_equal(lanes, jax.tree.map(lambda *leaves: jnp.stack(leaves), *loop))

    lengths = np.asarray(lanes.trajectory.length)
    assert len(set(lengths)) > 3  # the comparison means something
    for lane, length in enumerate(lengths):
        for rows in lanes.trajectory.steps.values():
            assert not np.asarray(rows[lane, length:]).any()


def test_a_policy_episode_is_what_the_full_pass_says(params):
    """Greedy actions are the argmax of the full pass replayed on what was recorded."""
    assert envs.episodes.num_segments(CONFIG.horizon) == 3
    prompts = Prompt(
        jax.random.uniform(jax.random.key(1), (4, 3, 2)),
        jnp.array([[False, False, True], [True, True, True], [False, True, True], [True] * 3]),
    )
    tasks = jax.tree.map(
        lambda *leaves: jnp.stack(leaves),
        *[task_to(*cell) for cell in [(1, 1), (4, 3), (5, 5), (1, 5)]],
    )
    greedy = jnp.array([True, True, True, False])

    @jax.jit
    @jax.vmap
    def run(key, task, prompt, greedy):
        policy = transformer_policy(CONFIG, params)
        episode = rollout(key, ENV, policy, task, Query(prompt, greedy))
        trajectory = episode.trajectory
        full = GoalTransformer(CONFIG).apply(params, prompt, trajectory.obs, trajectory.actions)
        return trajectory, full.logits

    trajectory, logits = run(jax.random.split(jax.random.key(2), 4), tasks, prompts, greedy)
    agree = np.argmax(logits, axis=-1) == trajectory.actions
    real = np.arange(12) < np.asarray(trajectory.length)[:, None]
    assert agree[:3][real[:3]].all()
    assert not agree[3][real[3]].all()  # this lane samples
    assert trajectory.length.max() == 12


def test_sampling_draws_from_the_policy(params):
    policy = transformer_policy(CONFIG, params)
    prompt = Prompt(jnp.full((3, 2), 0.3), jnp.ones(3, bool))
    task = task_to(1, 1)
    state, timestep = ENV.reset(jax.random.key(0), task)

    @jax.jit
    def first_actions(keys):
        agent = prompted(policy, Query(prompt, jnp.zeros((), bool)))
        actions = jax.vmap(lambda key: agent.begin(key, task, state, timestep)[0])(keys)
        return actions, policy.prefill(prompt, timestep.obs)[0].logits

    actions, logits = first_actions(jax.random.split(jax.random.key(5), 3000))
    expected = special.softmax(np.asarray(logits, np.float64)) * 3000
    assert expected.min() > 5
    assert stats.chisquare(np.bincount(actions, minlength=5), expected).pvalue > 1e-3
