"""``Actor``: the same actions as the episode loop in a world that the caller steps, or a clear error."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs.episodes
from envs.errors import UsageError
from envs.maze.env import MazeRunner
from mgpo_jax.acting import Actor
from mgpo_jax.judging import play
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.prompts import Prompt, goals_of, prompt_of
from mgpo_jax.rollout import Query
from mgpo_jax.tasks import sample_tasks, task_at
from mgpo_jax.transformer import GoalTransformer

ENV = MazeRunner(name="tiny", side=7, horizon=20)
STEP = jax.jit(ENV.step)


def untrained(**changes):
    config = network_config(
        ENV.spec, max_prompt_length=3, embed_dim=16, num_layers=2, num_heads=2, dropout=0.0
    )
    config = replace(config, **changes)
    prompt = Prompt(jnp.zeros((3, 2)), jnp.ones(3, bool))
    obs = jnp.zeros((2, *config.obs_shape), config.obs_dtype)
    discrete = config.head == "categorical"
    actions = jnp.zeros(2, jnp.int32) if discrete else jnp.zeros((2, config.action_dim))
    init = GoalTransformer(config).init
    shapes = jax.eval_shape(init, jax.random.key(0), prompt, obs, actions)
    rng = np.random.default_rng(1)
    params = jax.tree.map(
        lambda leaf: jnp.asarray(0.5 * rng.standard_normal(leaf.shape), leaf.dtype), shapes
    )
    return LoadedPolicy(config, params, {})


@pytest.fixture(scope="module", autouse=True)
def several_segments():
    """Room for the memory is made more than once in an episode."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(envs.episodes, "SEGMENT_STEPS", 6)
        yield


@pytest.fixture(scope="module")
def policy():
    return untrained()


TASKS = sample_tasks(ENV, 5, 4)
FIRST = np.asarray(ENV.reset(jax.random.key(0), task_at(TASKS, 0))[1].obs)


def act_out(actor, task):
    """Actions of an episode, stepped by hand."""
    state, timestep = ENV.reset(jax.random.key(0), task)
    action, actions = actor.reset(np.asarray(timestep.obs)), []
    while True:
        actions.append(int(action))
        state, timestep = STEP(state, jnp.asarray(action))
        if timestep.terminated or timestep.truncated:
            return actions
        action = actor.act(np.asarray(timestep.obs))


def test_an_actor_does_what_the_policy_does_in_the_episode_loop(policy):
    """Under one prompt after another, to the last step of the horizon."""
    prompts = np.random.default_rng(0).random((4, 3, 2)).astype(np.float32)
    actor = Actor(policy, prompts[0])
    lengths = []
    for index in range(4):
        task = task_at(TASKS, index)
        goals = np.concatenate([prompts[index][: index % 3], ENV.task_goal(task)[None]])
        actor.prompt = goals
        np.testing.assert_array_equal(goals_of(actor.prompt), goals)
        query = Query(prompt_of(goals, 3), jnp.ones((), bool))
        episode = play(jax.random.key(0), ENV, policy, task, query, 1)
        length = int(episode.trajectory.length[0])
        assert act_out(actor, task) == episode.trajectory.actions[0, :length].tolist()
        lengths.append(length)
    assert max(lengths) == ENV.horizon
    assert envs.episodes.num_segments(ENV.horizon) == 3


def test_an_encoder_is_prepared_once(policy, monkeypatch):
    """Its parameters are not prepared a second time, which an encoder need not allow."""
    calls = []

    def prepared(config, params):
        calls.append(params)
        return params

    monkeypatch.setattr(type(policy.config), "prepared", prepared)
    actor = Actor(policy, np.zeros((1, 2)))
    actor.reset(FIRST)
    actor.act(FIRST)
    assert len(calls) == 1


def test_an_exploring_actor_follows_its_seed(policy):
    task = task_at(TASKS, 0)
    goals = np.asarray(ENV.task_goal(task))[None]
    runs = [act_out(Actor(policy, goals, greedy=False, seed=seed), task) for seed in (0, 0, 1)]
    assert runs[0] == runs[1] != runs[2]
    actor = Actor(policy, goals, greedy=False)
    assert act_out(actor, task) != act_out(actor, task)  # another episode, other actions


def test_actions_are_numpy(policy):
    action = Actor(policy, [[0.5, 0.5]]).reset(FIRST.tolist())
    assert isinstance(action, np.ndarray)
    assert action.shape == ()
    assert np.issubdtype(action.dtype, np.integer)


def test_continuous_actions():
    policy = untrained(head="gaussian", action_dim=2)
    action = Actor(policy, [[0.5, 0.5]]).reset(FIRST)
    assert action.shape == (2,)
    assert (np.abs(action) <= 1).all()


@pytest.mark.parametrize(
    ("goals", "says"),
    [
        (np.zeros((4, 2)), r"a list of 1 to 3 goals, .* found shape \[4, 2\]"),
        (np.zeros((0, 2)), "a list of 1 to 3 goals"),
        (np.zeros(2), "a list of 1 to 3 goals"),
        (np.zeros((2, 3)), r"takes prompts of shape \[3, 2\] .*, found \[3, 3\]"),
        ([[np.nan, 0.0]], "must be finite numbers"),
        (
            Prompt(jnp.zeros((5, 2)), jnp.ones(5, bool)),
            r"takes prompts of shape \[3, 2\] .*, found \[5, 2\]",
        ),
    ],
)
def test_prompts_that_the_policy_does_not_take(policy, goals, says):
    with pytest.raises(UsageError, match=says):
        Actor(policy, goals)


@pytest.mark.parametrize(
    ("obs", "says"),
    [
        (np.zeros(5), r"takes observations of shape \[6\], found \[5\]"),
        (np.zeros((1, 6)), r"takes observations of shape \[6\], found \[1, 6\]"),
        ([0.0, np.nan, 0.0, 0.0, 0.0, 0.0], "holds NaN or infinity"),
        (np.full(6, np.inf), "holds NaN or infinity"),
    ],
)
def test_observations_that_the_policy_does_not_take(policy, obs, says):
    actor = Actor(policy, [[0.5, 0.5]])
    with pytest.raises(UsageError, match=says):
        actor.reset(obs)
    actor.reset(FIRST)
    with pytest.raises(UsageError, match=says):
        actor.act(obs)
    actor.act(FIRST)  # nothing is lost


def test_fractions_are_no_bytes():
    actor = Actor(untrained(obs_dtype="uint8"), [[0.5, 0.5]])
    with pytest.raises(UsageError, match="takes observations of uint8, found float32"):
        actor.reset(FIRST)
    actor.reset(np.arange(6))


def test_an_episode_begins_with_reset(policy):
    with pytest.raises(
        UsageError, match="act was called before reset; call reset with the first observation"
    ):
        Actor(policy, [[0.5, 0.5]]).act(FIRST)


def test_episodes_are_no_longer_than_those_of_training(policy):
    actor = Actor(policy, [[0.5, 0.5]])
    for _ in range(2):
        actor.reset(FIRST)
        for _ in range(ENV.horizon - 1):
            actor.act(FIRST)
        with pytest.raises(UsageError, match="trained for episodes of 20 steps; call reset"):
            actor.act(FIRST)
