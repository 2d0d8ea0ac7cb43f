"""Adaptation: segments against whole runs, lanes against single runs, one compilation, any adapter."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs.episodes
from envs.agents import Agent
from envs.episodes import replay, run_episode
from envs.gridworld.env import GridWorld
from envs.maze.env import MazeRunner
from mgpo_jax.adaptation import Adapter, proceed, search, start
from mgpo_jax.network_configs import TransformerConfig
from mgpo_jax.optimizers import SearchSpace, ucb
from mgpo_jax.optimizers.methods import prompt_adapter
from mgpo_jax.policy import transformer_policy
from mgpo_jax.prompts import Prompt
from mgpo_jax.rollout import Query, rollout
from mgpo_jax.transformer import GoalTransformer

NUM_EPISODES = 7
KEY = jax.random.split(jax.random.key(3), 16)[0]
CONFIG = TransformerConfig(
    obs_shape=(6,), goal_dim=2, action_dim=5, horizon=12, max_prompt_length=3,
    embed_dim=16, num_layers=1, dropout=0.0,
)  # fmt: skip
GRID_CONFIG = TransformerConfig(
    obs_shape=(9,), goal_dim=7, action_dim=6, horizon=20, max_prompt_length=3,
    embed_dim=8, num_layers=1, dropout=0.0,
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def two_segments():
    """An episode as short as these would run in one segment; two are enough to cross a border."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(envs.episodes, "SEGMENT_STEPS", 6)
        yield


def make_env():
    return MazeRunner(name="tiny", side=7, horizon=12)


GRID = GridWorld(name="tiny", horizon=20)


class CountingMaze(MazeRunner):
    """Counts the episodes that are really run."""

    episodes = 0

    def reset(self, key, task):
        def count():
            CountingMaze.episodes += 1

        jax.debug.callback(count)
        return super().reset(key, task)


def params_of(config, scale=0.5):
    prompt = Prompt(jnp.zeros((3, config.goal_dim)), jnp.ones(3, bool))
    inputs = (prompt, jnp.zeros((2, *config.obs_shape)), jnp.zeros(2, jnp.int32))
    shapes = jax.eval_shape(GoalTransformer(config).init, jax.random.key(0), *inputs)
    rng = np.random.default_rng(1)
    return jax.tree.map(
        lambda leaf: jnp.asarray(scale * rng.standard_normal(leaf.shape), leaf.dtype), shapes
    )


@pytest.fixture(scope="module")
def params():
    return params_of(CONFIG)


def make_adapter(env, params, config=CONFIG):
    space = SearchSpace(
        num_slots=config.max_prompt_length,
        horizon=env.spec.horizon,
        return_range=env.spec.return_range,
        num_episodes=NUM_EPISODES,
        sample_goal=env.sample_goal,
        deterministic=env.spec.deterministic,
    )
    return prompt_adapter(transformer_policy(config, params), ucb(space))


@partial(jax.jit, static_argnames="env")
def adapt_one(params, key, env, task):
    return search(key, env, make_adapter(env, params), task, NUM_EPISODES)


@pytest.fixture(scope="module")
def tasks():
    return jax.jit(jax.vmap(make_env().sample_task))(jax.random.split(jax.random.key(1), 3))


def lane(tree, *index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


@pytest.fixture(scope="module")
def whole(params, tasks):
    return adapt_one(params, KEY, make_env(), lane(tasks, 1))


def without_keys(tree):
    """Random keys as their raw data, which numpy can compare."""
    is_key = lambda leaf: jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)  # noqa: E731
    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if is_key(leaf) else leaf, tree)


def assert_trees_equal(a, b):
    a, b = without_keys(a), without_keys(b)
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_the_log_holds_every_episode(whole, tasks):
    log = whole.log
    assert log.returns.shape == log.failed.shape == log.played.key.shape == (NUM_EPISODES, 1)
    np.testing.assert_array_equal(log.choices.greedy, np.arange(NUM_EPISODES) % 2 == 0)
    first = lane(log.choices.prompt, 0)
    np.testing.assert_array_equal(first.mask, [False, False, True])
    np.testing.assert_allclose(first.goals[-1], tasks.goal[1] / 7, rtol=1e-6)
    assert_trees_equal(whole.best, lane(log.best, -1))
    assert ((log.returns >= -1.2 - 1e-5) & (log.returns <= 0.9)).all()
    assert not log.failed.any()


def test_two_pieces_equal_the_whole(params, tasks, whole):
    env = make_env()

    @jax.jit
    def pieces(key, task):
        adapter = make_adapter(env, params)
        go_on = partial(proceed, env=env, adapter=adapter, task=task, max_rounds=4)
        state = start(key, env, adapter, task)
        state, first, _ = go_on(state, num_rounds=3)
        state, second, _ = go_on(state, num_rounds=NUM_EPISODES - 3)
        parts = lane(first, slice(3)), second  # what lies beyond the rounds says nothing
        log = jax.tree.map(lambda *parts: jnp.concatenate(parts), *parts)
        return log, adapter.best(state.search), state.search.episode

    log, best, episodes = pieces(KEY, lane(tasks, 1))
    assert episodes == NUM_EPISODES
    assert_trees_equal(log, whole.log)
    assert_trees_equal(best, whole.best)


def test_exactly_the_budget_is_spent(params, tasks, whole):
    """Starting costs no episode, and neither does reading the result."""
    CountingMaze.episodes = 0
    env = CountingMaze(name="tiny", side=7, horizon=12)
    result = adapt_one(params, KEY, env, lane(tasks, 1))
    jax.effects_barrier()
    assert CountingMaze.episodes == NUM_EPISODES
    assert_trees_equal(result, whole)


def test_tasks_and_seeds_are_lanes(params, tasks):
    """vmap over tasks and seeds equals single runs; all lanes share one clock."""
    env = make_env()
    keys = jax.random.split(jax.random.key(3), 6)
    pairs = (keys, jax.tree.map(lambda leaf: jnp.repeat(leaf, 2, axis=0), tasks))
    run = jax.vmap(
        lambda key, task: search(key, env, make_adapter(env, params), task, NUM_EPISODES)
    )
    lanes = jax.jit(run)(*pairs)
    for index in range(6):
        single = adapt_one(params, keys[index], make_env(), lane(pairs[1], index))
        found = without_keys((lane(lanes, index), single))
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-5), *found)
    assert len(np.unique(lanes.log.returns)) > 3  # the lanes do differ


def test_equal_worlds_and_other_tasks_share_one_program(params, tasks, whole):
    before = adapt_one._cache_size()
    for index in range(3):
        adapt_one(params, jax.random.key(index), make_env(), lane(tasks, index))
    halved = jax.tree.map(lambda leaf: leaf / 2, params)
    adapt_one(halved, jax.random.key(0), make_env(), lane(tasks, 1))
    assert adapt_one._cache_size() == before


@partial(jax.jit, static_argnames=("env", "num_judged", "max_rounds", "adapter"))
def judged_search(params, key, env, task, num_rounds, max_rounds, num_judged, adapter=None):
    adapter = adapter or make_adapter(env, params)
    state = start(key, env, adapter, task)
    judge_key = jax.random.key(9) if num_judged else None
    return proceed(
        state, env, adapter, task, num_rounds,
        max_rounds=max_rounds, judge_key=judge_key, num_judged=num_judged,
    )  # fmt: skip


def test_judging_runs_greedy_episodes(params, tasks):
    """Of the best prompt, whether any was tried or not, with keys of their own."""
    env, task = make_env(), lane(tasks, 1)

    @jax.jit
    def expected(prompt, task):
        policy = transformer_policy(CONFIG, params)
        query = Query(prompt, jnp.ones((), bool))
        play = jax.vmap(lambda key: rollout(key, env, policy, task, query).return_)
        return play(jax.random.split(jax.random.key(9), 3)).mean()

    returns = []
    for num_rounds in (0, NUM_EPISODES):
        state, _, judged = judged_search(params, KEY, env, task, num_rounds, NUM_EPISODES, 3)
        prompt = make_adapter(env, params).best(state.search).prompt
        np.testing.assert_allclose(judged.return_, expected(prompt, task), rtol=1e-6)
        assert judged.num_failed == 0
        returns.append(float(judged.return_))
    assert returns[0] != returns[1]  # the search found something


def test_judging_changes_nothing_of_the_search(params, tasks, whole):
    env, task, key = make_env(), lane(tasks, 1), KEY
    run = partial(judged_search, params, key, env, task, NUM_EPISODES, NUM_EPISODES)
    state, log, judged = run(3)
    other, plain, nothing = run(0)
    assert_trees_equal(log, plain)
    assert_trees_equal(log, whole.log)
    assert_trees_equal(state, other)
    assert np.isfinite(judged.return_)
    assert np.isnan(nothing.return_)


def test_judging_episodes_are_run_once_each(params, tasks):
    """Two rounds of the search and three episodes that judge, whatever room the log has."""
    CountingMaze.episodes = 0
    env = CountingMaze(name="tiny", side=7, horizon=12)
    judged_search(params, KEY, env, lane(tasks, 1), 2, NUM_EPISODES, 3)
    jax.effects_barrier()
    assert CountingMaze.episodes == 2 + 3


def test_judging_episodes_choose_nothing(params, tasks):
    """A method may search for long before it chooses, so it is only asked in rounds of the search."""
    env, asked = make_env(), []
    adapter = make_adapter(env, params)

    def ask(key, state):
        jax.debug.callback(lambda: asked.append(True))
        return adapter.ask(key, state)

    counting = adapter._replace(ask=ask)
    judged_search(params, KEY, env, lane(tasks, 1), 2, NUM_EPISODES, 3, counting)
    jax.effects_barrier()
    assert len(asked) == 2


def test_actions_in_the_log_are_bytes(params, tasks, whole):
    played = whole.log.played
    assert played.actions.dtype == np.uint8
    assert played.actions.shape == (NUM_EPISODES, 1, 12)
    time = np.arange(12)
    for actions, length in zip(played.actions[:, 0], played.goals.length[:, 0], strict=True):
        assert (actions[time < length] < 5).all()
        assert (actions[time >= length] == 255).all()
    assert played.goals.length.min() < 12  # some episodes do end


def test_searches_keep_no_observations(params, tasks):
    """What a state holds beside prompts are goals, of which there are few."""
    env = GRID
    task = env.sample_task(jax.random.key(0))
    adapter = make_adapter(env, params_of(GRID_CONFIG), GRID_CONFIG)
    state = jax.eval_shape(lambda key: start(key, env, adapter, task), jax.random.key(0))
    (size,) = env.spec.obs.shape
    assert all(size not in leaf.shape for leaf in jax.tree.leaves(state))
    assert any(leaf.shape == (20, 7) for leaf in jax.tree.leaves(state))  # goals


class Tally(NamedTuple):
    """What a learner was told so far."""

    goal: Any
    num: Any
    total: Any
    last_asked: Any


def walker(rate):
    """Moves at random, quits with a probability; its decisions are how often it moved and a number."""

    def act(key, memory):
        key_action, key_quit = jax.random.split(key)
        quits = jax.random.bernoulli(key_quit, rate)
        return jax.random.randint(key_action, (), 0, 5), quits, memory + 1

    return Agent(
        begin=lambda key, task, state, timestep: act(key, jnp.int32(0)),
        proceed=lambda key, memory, state, timestep: act(key, memory),
        decisions=lambda memory: {"asked": memory, "rate": jnp.asarray(rate)},
    )


def learner(num=3, probe=lambda total: total, gain=1.0, tell_in_turn=False):
    """Adapts its rate of quitting; is asked once for ``num`` episodes."""

    def tell(key, state, choice, episodes):
        assert episodes.return_.shape == (num,)
        assert episodes.rewards.shape == (num, 12)
        assert episodes.trajectory.obs.shape == (num, 12, 6)
        total = probe(state.total + gain * episodes.return_.sum())
        noise = 1e-3 * jax.random.uniform(key)
        return Tally(state.goal, state.num + num, total + noise, episodes.decisions["asked"])

    def ask(key, state):
        rate = 0.2 * jax.random.uniform(key)
        return rate, state._replace(total=state.total + 0.25)

    return Adapter(
        init=lambda key, goal: Tally(goal, jnp.int32(0), jnp.zeros(()), jnp.zeros(num, jnp.int32)),
        ask=ask,
        agent=lambda state, rate: walker(rate),
        tell=tell,
        best=lambda state: 0.01 * jnp.abs(state.total),
        episodes_per_round=num,
        tell_in_turn=tell_in_turn,
    )


def run_learner(key, task, adapter, env=None, num_episodes=9):
    env = env or make_env()
    state = start(key, env, adapter, task)
    rounds = num_episodes // adapter.episodes_per_round
    return proceed(state, env, adapter, task, rounds, max_rounds=rounds)


def test_a_choice_is_asked_for_several_episodes(tasks):
    CountingMaze.episodes = 0
    env, task = CountingMaze(name="tiny", side=7, horizon=12), lane(tasks, 0)
    run = jax.jit(lambda key: run_learner(key, task, learner(3), env))
    state, log, _ = run(jax.random.key(0))
    jax.effects_barrier()
    assert CountingMaze.episodes == 9
    assert state.search.num == 9
    assert log.returns.shape == log.failed.shape == log.played.key.shape == (3, 3)
    assert log.played.actions.shape == (3, 3, 12)
    assert log.choices.shape == log.best.shape == (3,)
    assert len(np.unique(without_keys(log.played.key).reshape(9, 2), axis=0)) == 9
    # Told are the episodes of the log, with what the agent decided in them.
    np.testing.assert_allclose(state.search.total, log.returns.sum() + 3 * 0.25, atol=3e-3 + 1e-4)
    length = np.asarray(log.played.goals.length[-1])
    asked = np.asarray(state.search.last_asked)
    assert (asked >= length).all()
    assert (asked >= 1).all()
    again = jax.jit(jax.vmap(lambda *one: replay(one[0], make_env(), task, *one[1:])))
    flat = jax.tree.map(lambda leaf: leaf.reshape(9, *leaf.shape[2:]), log.played)
    np.testing.assert_array_equal(
        again(flat.key, flat.actions, flat.goals.length).return_, log.returns.reshape(9)
    )


def test_judging_runs_single_episodes(tasks):
    """Also where a round has several, and without telling anyone."""
    CountingMaze.episodes = 0
    env, task = CountingMaze(name="tiny", side=7, horizon=12), lane(tasks, 0)

    @jax.jit
    def run(key, judge_key):
        adapter = learner(3)
        state = start(key, env, adapter, task)
        return proceed(
            state, env, adapter, task, 2, max_rounds=2, judge_key=judge_key, num_judged=4
        )

    state, log, judged = run(jax.random.key(0), jax.random.key(8))
    jax.effects_barrier()
    assert CountingMaze.episodes == 2 * 3 + 4
    plain = jax.jit(lambda key: run_learner(key, task, learner(3), num_episodes=6))
    other, expected, _ = plain(jax.random.key(0))
    assert_trees_equal(state, other)
    assert_trees_equal(log, expected)

    @jax.jit
    @jax.vmap
    def judge(key):
        agent = walker(learner().best(state.search))
        return run_episode(key, make_env(), agent, task).return_

    returns = judge(jax.random.split(jax.random.key(8), 4))
    np.testing.assert_allclose(judged.return_, returns.mean(), rtol=1e-5)
    assert len(np.unique(returns)) > 1


@pytest.mark.parametrize("num_episodes", [0, 2, 10])
def test_budgets_are_whole_rounds(tasks, num_episodes):
    with pytest.raises(ValueError, match=f"{num_episodes} episodes are not a whole number .* of 3"):
        search(jax.random.key(0), make_env(), learner(3), lane(tasks, 0), num_episodes)


def counting_probe():
    """An identity that writes down for how many lanes at once it is computed."""
    sizes = []

    @jax.custom_batching.custom_vmap
    def probe(total):
        return total

    @probe.def_vmap
    def of_lanes(size, batched, total):
        sizes.append(size)
        return total, batched[0]

    return probe, sizes


def test_updates_in_turn(tasks):
    """They are the same, and see one lane at a time; what a lane has of its own is its own there, too."""
    keys, gains = jax.random.split(jax.random.key(6), 3), jnp.array([0.5, 1.0, 2.0])
    found = {}
    for in_turn in (False, True):
        probe, sizes = counting_probe()

        @jax.jit
        @jax.vmap
        def run(key, task, gain, probe=probe, in_turn=in_turn):
            adapter = learner(3, probe, gain, tell_in_turn=in_turn)
            state, log, _ = run_learner(key, task, adapter)
            return state, log

        found[in_turn] = run(keys, tasks, gains)
        assert sizes == ([] if in_turn else [3] * len(sizes))
        assert bool(sizes) != in_turn
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5), *map(without_keys, found.values()))
    totals = found[True][0].search.total
    returns = found[True][1].returns.sum(axis=(1, 2))
    np.testing.assert_allclose(totals, gains * returns + 0.75, atol=4e-3)


def chooser(rate):
    """Moves as it decided some steps before; its decisions are rows by step, zero where there was none."""

    def act(key, memory):
        key_action, key_quit = jax.random.split(key)
        time, chosen = memory
        old = chosen[jnp.maximum(time - 1, 0)]
        action = jnp.where(time % 3 == 0, jax.random.randint(key_action, (), 0, 5), old)
        chosen = chosen.at[time].set(action)
        return action, jax.random.bernoulli(key_quit, rate), (time + 1, chosen)

    blank = jnp.int32(0), jnp.zeros(12, jnp.int32)
    return Agent(
        begin=lambda key, task, state, timestep: act(key, blank),
        proceed=lambda key, memory, state, timestep: act(key, memory),
        decisions=lambda memory: {"chosen": memory[1]},
    )


def test_decisions_arrive_in_what_is_told(tasks):
    """Episode by episode; those of real steps are the same whether others still play or not."""
    num = 2

    def tell(key, state, choice, episodes):
        real = jnp.arange(12) < episodes.trajectory.length[:, None]
        chosen = episodes.decisions["chosen"]
        assert chosen.shape == (num, 12)
        taken = jnp.where(real, chosen == episodes.trajectory.actions, True).all()
        return state[0] + 1, state[1] & taken, jnp.where(real, chosen, -1)

    adapter = Adapter(
        init=lambda key, goal: (jnp.int32(0), jnp.array(True), jnp.zeros((num, 12), jnp.int32)),
        ask=lambda key, state: ((), state),
        agent=lambda state, choice: chooser(0.15),
        tell=tell,
        best=lambda state: (),
        episodes_per_round=num,
    )
    keys = jax.random.split(jax.random.key(3), 3)
    run = lambda key, task: run_learner(key, task, adapter, num_episodes=6)[:2]  # noqa: E731
    lanes = jax.jit(jax.vmap(run))(keys, tasks)
    (rounds, taken, chosen), log = lanes[0].search, lanes[1]
    np.testing.assert_array_equal(rounds, 3)
    assert taken.all()
    lengths = np.asarray(log.played.goals.length[:, -1])
    np.testing.assert_array_equal((np.asarray(chosen) >= 0).sum(axis=-1), lengths)
    assert len(np.unique(lengths)) > 2
    single = jax.jit(run)
    for index in range(3):
        assert_trees_equal(lane(lanes, index), single(keys[index], lane(tasks, index)))
