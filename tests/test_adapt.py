"""Adaptation: pieces against the whole, lanes against single runs, one compilation."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mgpo_jax.rollout
from envs.maze_runner import MazeRunner
from mgpo_jax.adapt import adapt, continue_adaptation, evaluate, start_adaptation
from mgpo_jax.optimizers import SearchSpace, ucb
from mgpo_jax.policy import transformer_policy
from mgpo_jax.rollout import rollout
from mgpo_jax.transformer import GoalTransformer, TransformerConfig
from mgpo_jax.types import Prompt, Query

NUM_EPISODES = 7
CONFIG = TransformerConfig(
    obs_dim=6, goal_dim=2, action_dim=5, horizon=12, max_prompt_length=3,
    embed_dim=16, num_layers=1, dropout=0.0,
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def few_segments():
    """Every segment of an episode is compiled on its own; two are enough to cross a border."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mgpo_jax.rollout, "NUM_SEGMENTS", 2)
        yield


def make_env():
    return MazeRunner(name="tiny", side=7, horizon=12)


class CountingMaze(MazeRunner):
    """Counts the episodes that are really run."""

    episodes = 0

    def reset(self, key, task):
        def count():
            CountingMaze.episodes += 1

        jax.debug.callback(count)
        return super().reset(key, task)


@pytest.fixture(scope="module")
def params():
    prompt = Prompt(jnp.zeros((3, 2)), jnp.ones(3, bool))
    init = GoalTransformer(CONFIG).init
    inputs = (prompt, jnp.zeros((2, 6)), jnp.zeros(2, jnp.int32))
    shapes = jax.eval_shape(init, jax.random.key(0), *inputs)
    rng = np.random.default_rng(1)
    return jax.tree.map(
        lambda leaf: jnp.asarray(0.3 * rng.standard_normal(leaf.shape), leaf.dtype), shapes
    )


def make_optimizer(env, policy):
    return ucb(SearchSpace(policy.num_slots, env.sample_goal, env.spec.return_range, NUM_EPISODES))


@partial(jax.jit, static_argnames="env")
def adapt_one(params, key, env, task):
    policy = transformer_policy(CONFIG, params)
    return adapt(key, env, policy, make_optimizer(env, policy), task, NUM_EPISODES)


@pytest.fixture(scope="module")
def tasks():
    return jax.jit(jax.vmap(make_env().sample_task))(jax.random.split(jax.random.key(1), 3))


def lane(tree, *index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


@pytest.fixture(scope="module")
def whole(params, tasks):
    return adapt_one(params, jax.random.key(2), make_env(), lane(tasks, 0))


def assert_trees_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_the_log_holds_every_episode(whole, tasks):
    log = whole.log
    assert log.returns.shape == (NUM_EPISODES,)
    np.testing.assert_array_equal(log.greedy, np.arange(NUM_EPISODES) % 2 == 0)
    first = Prompt(*lane(log.prompts, 0))
    np.testing.assert_array_equal(first.mask, [False, False, True])
    np.testing.assert_allclose(first.goals[-1], tasks.goal[0] / 7, rtol=1e-6)
    assert_trees_equal(whole.prompt, lane(log.best, -1))
    assert ((log.returns >= -1.2 - 1e-5) & (log.returns <= 0.9)).all()


def test_two_pieces_equal_the_whole(params, tasks, whole):
    env, task = make_env(), lane(tasks, 0)

    @jax.jit
    def pieces(key):
        policy = transformer_policy(CONFIG, params)
        optimizer = make_optimizer(env, policy)
        state = start_adaptation(key, env, policy, optimizer, task)
        state, first = continue_adaptation(state, env, policy, optimizer, task, 3)
        state, second = continue_adaptation(state, env, policy, optimizer, task, NUM_EPISODES - 3)
        log = jax.tree.map(lambda *parts: jnp.concatenate(parts), first, second)
        return log, optimizer.best(state.optimizer), state.optimizer.episode

    log, prompt, episodes = pieces(jax.random.key(2))
    assert episodes == NUM_EPISODES
    assert_trees_equal(log, whole.log)
    assert_trees_equal(prompt, whole.prompt)


def test_exactly_the_budget_is_spent(params, tasks, whole):
    """Starting costs no episode, and neither does reading the result."""
    CountingMaze.episodes = 0
    env = CountingMaze(name="tiny", side=7, horizon=12)
    result = adapt_one(params, jax.random.key(2), env, lane(tasks, 0))
    jax.effects_barrier()
    assert CountingMaze.episodes == NUM_EPISODES
    assert_trees_equal(result, whole)


def test_tasks_and_seeds_are_lanes(params, tasks):
    """vmap over tasks and seeds equals single runs; all lanes share the clock of their axis."""
    env = make_env()
    keys = jax.random.split(jax.random.key(3), (3, 2))
    num_lanes = 6
    pairs = (keys.reshape(-1), jax.tree.map(lambda leaf: jnp.repeat(leaf, 2, axis=0), tasks))

    @jax.jit
    @partial(jax.vmap, axis_name="lane")
    def run(key, task):
        policy = transformer_policy(CONFIG, params)
        return adapt(key, env, policy, make_optimizer(env, policy), task, NUM_EPISODES, "lane")

    lanes = run(*pairs)
    for index in range(num_lanes):
        single = adapt_one(params, pairs[0][index], make_env(), lane(pairs[1], index))
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-5), lane(lanes, index), single)
    assert len(np.unique(lanes.log.returns)) > 3  # the lanes do differ


def test_equal_worlds_and_other_tasks_share_one_program(params, tasks, whole):
    before = adapt_one._cache_size()
    for index in range(3):
        adapt_one(params, jax.random.key(index), make_env(), lane(tasks, index))
    halved = jax.tree.map(lambda leaf: leaf / 2, params)
    adapt_one(halved, jax.random.key(0), make_env(), lane(tasks, 0))
    assert adapt_one._cache_size() == before


def test_evaluate_is_a_greedy_episode(params, tasks, whole):
    env, task, key = make_env(), lane(tasks, 0), jax.random.key(9)

    @jax.jit
    def both(prompt):
        policy = transformer_policy(CONFIG, params)
        query = Query(prompt, jnp.ones((), bool))
        return evaluate(key, env, policy, task, prompt), rollout(key, env, policy, task, query)

    assert_trees_equal(*both(whole.prompt))
