"""BBT: evosax's CMA-ES with rank weights against pycma, and Algorithm 3 replayed."""

from __future__ import annotations

import cma
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evosax.algorithms import CMA_ES
from scipy import stats

from envs.base import Episode, Trajectory
from mgpo_jax.optimizers import SearchSpace, bbt
from mgpo_jax.optimizers.bbt import rank_weights

DIM, POPULATION, NUM_RUNS, NUM_PYCMA = 5, 10, 60, 20
SCALES = {"sphere": np.ones(DIM), "ellipsoid": 10 ** np.linspace(0, 3, DIM)}
TARGET = 1e-4

NUM_SLOTS, NUM_STEPS, NUM_EPISODES = 3, 5, 31
STD_INIT = 0.3
TASK_GOAL = jnp.array([0.9, 0.8])
BLANK = Trajectory(
    obs=jnp.zeros((NUM_STEPS, 1)),
    actions=jnp.zeros(NUM_STEPS, jnp.int32),
    achieved_goals=jnp.zeros((NUM_STEPS, 2)),
    goal_reached=jnp.zeros(NUM_STEPS, bool),
    outcomes=jnp.zeros((NUM_STEPS, 2)),
    length=jnp.int32(0),
)


def evolve(key, scales, num_generations, **options):
    """Best fitness and step size of each generation of evosax's CMA-ES from (1, .., 1)."""
    start = jnp.ones(DIM)
    strategy = CMA_ES(POPULATION, start, **options)
    params = strategy.default_params.replace(std_init=jnp.float32(0.5))
    state = jax.tree.map(jnp.asarray, strategy.init(key, start, params))

    def generation(state, key):
        population, state = strategy.ask(key, state, params)
        fitness = jnp.sum(scales * population**2, axis=1)
        new, _ = strategy.tell(key, population, fitness, state, params)
        state = jax.tree.map(lambda a, b: a.astype(b.dtype), new, state)
        return state, (fitness.min(), state.std)

    return jax.lax.scan(generation, state, jax.random.split(key, num_generations))[1]


@pytest.fixture(scope="module")
def strict():
    """Runs with rank weights, one for each key and each row of scales."""
    run = lambda key, scales: evolve(key, scales, 180, fitness_shaping_fn=rank_weights)  # noqa: E731
    return jax.jit(jax.vmap(run))


def keys(seed):
    return jax.random.split(jax.random.key(seed), NUM_RUNS)


def pycma(seed):
    options = {"popsize": POPULATION, "seed": seed, "verbose": -9}
    return cma.CMAEvolutionStrategy(np.ones(DIM), 0.5, options)


@pytest.mark.parametrize("function", SCALES)
def test_rank_weights_search_like_pycma(strict, function):
    scales = SCALES[function]
    fitness, _ = strict(keys(1), jnp.tile(jnp.asarray(scales, jnp.float32), (NUM_RUNS, 1)))
    reached = np.asarray(fitness) < TARGET
    assert reached.any(axis=1).all()
    ours = np.median(reached.argmax(axis=1) + 1)

    theirs = []
    for seed in range(1, NUM_PYCMA + 1):
        strategy, generations, best = pycma(seed), 0, np.inf
        while best >= TARGET:
            population = strategy.ask()
            values = [float(scales @ x**2) for x in population]
            strategy.tell(population, values)
            generations, best = generations + 1, min(values)
        theirs.append(generations)
    assert 0.75 < ours / np.median(theirs) < 1.33


def test_step_size_survives_ties(strict):
    """With all returns equal the step size does what pycma's does; evosax's own shaping loses it."""
    zeros = jnp.zeros((NUM_RUNS, DIM))
    ours = np.asarray(strict(keys(2), zeros)[1][:, 9])
    theirs = []
    for seed in range(1, NUM_RUNS + 1):
        strategy = pycma(seed)
        for _ in range(10):
            strategy.tell(strategy.ask(), [0.0] * POPULATION)
        theirs.append(strategy.sigma)
    default = jax.jit(jax.vmap(lambda key, scales: evolve(key, scales, 10)))(keys(2), zeros)
    assert stats.ks_2samp(ours, theirs).pvalue > 1e-3
    assert float(np.median(default[1][:, 9])) < 0.6 * np.median(ours)


def test_rank_weights_order_ties_and_put_nan_last():
    class Params:
        weights = jnp.array([0.5, 0.3, 0.2, -0.1, -0.4])

    fitness = jnp.array([2.0, jnp.nan, 1.0, 2.0, 0.0])
    weights = rank_weights(None, fitness, None, Params)
    np.testing.assert_allclose(weights, [0.2, -0.4, 0.3, -0.1, 0.5])


def play(key, query):
    """Returns in tenths, the better the nearer the goals lie to the origin."""
    key_goals, key_length = jax.random.split(key)
    length = jax.random.randint(key_length, (), 2, NUM_STEPS + 1)
    real = jnp.arange(NUM_STEPS) < length
    trajectory = BLANK._replace(
        achieved_goals=jnp.where(real[:, None], jax.random.uniform(key_goals, (NUM_STEPS, 2)), 0.0),
        goal_reached=real,
        outcomes=jnp.where(real[:, None], 2.0, 0.0),
        length=length,
    )
    return_ = jnp.round(-10 * jnp.sum(query.prompt.goals**2)) / 10
    return Episode(trajectory, jnp.zeros(NUM_STEPS), return_, last_obs=jnp.zeros(1))


def search(key):
    space = SearchSpace(
        num_slots=NUM_SLOTS,
        horizon=NUM_STEPS,
        return_range=(-10.0, 0.0),
        num_episodes=NUM_EPISODES,
        sample_goal=lambda key: jnp.zeros(2),
    )
    optimizer = bbt(space, POPULATION, 4, std_init=STD_INIT)
    key_init, key_run = jax.random.split(key)

    def episode(state, key):
        key_ask, key_play = jax.random.split(key)
        query, asked = optimizer.ask(key_ask, state)
        result = play(key_play, query)
        told = optimizer.tell(asked, query, result)
        # The states are logged, but for their key, which is no number.
        states = (state._replace(start_key=jnp.int32(0)) for state in (asked, told))
        return told, (query, result, *states, optimizer.best(told))

    state = optimizer.init(key_init, TASK_GOAL)
    return jax.lax.scan(episode, state, jax.random.split(key_run, NUM_EPISODES))[1]


SEARCH_KEYS = jax.random.split(jax.random.key(4), 4)


@pytest.fixture(scope="module")
def logs():
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(search))(SEARCH_KEYS))


def lane(tree, index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


def test_lanes_equal_single_searches(logs):
    single = jax.jit(search)
    for index in (0, 3):
        queries, results, *_ = single(SEARCH_KEYS[index])
        expected = lane(logs, index)
        np.testing.assert_allclose(queries.prompt.goals, expected[0].prompt.goals, atol=1e-3)
        np.testing.assert_allclose(results.return_, expected[1].return_, atol=0.11)


def test_prompts_are_p0_plus_a_z_in_order(logs):
    sizes = set()
    for index in range(len(SEARCH_KEYS)):
        queries, results, asked, _, _ = lane(logs, index)
        assert queries.greedy.all()
        np.testing.assert_allclose(queries.prompt.goals[0], [[0, 0], [0, 0], TASK_GOAL])
        start = lane(asked.start, 1)
        sizes.add(int(start.mask.sum()))
        steps = results.trajectory.achieved_goals[0][: results.trajectory.length[0]].tolist()
        at = [steps.index(goal) for goal in start.goals[start.mask][:-1].tolist()]
        assert at == sorted(set(at))
        np.testing.assert_array_equal(start.goals[-1], TASK_GOAL)
        for i in range(1, NUM_EPISODES):
            z = asked.population[i, (i - 1) % POPULATION]
            moved = start.goals + (asked.projection[i] @ z).reshape(NUM_SLOTS, 2)
            moved[~start.mask] = 0
            np.testing.assert_allclose(queries.prompt.goals[i], moved, atol=1e-5)
            np.testing.assert_array_equal(queries.prompt.mask[i], start.mask)
            if i % POPULATION != 1:  # one population, member by member
                np.testing.assert_array_equal(asked.population[i], asked.population[i - 1])
            assert len(np.unique(asked.population[i], axis=0)) == POPULATION
    assert len(sizes) > 1


def test_a_generation_moves_the_mean_to_its_best_half(logs):
    params = CMA_ES(POPULATION, jnp.zeros(4)).default_params
    weights = np.maximum(np.asarray(params.weights), 0)
    for index in range(len(SEARCH_KEYS)):
        _, results, asked, told, _ = lane(logs, index)
        for first in (1, 11, 21):
            last = first + POPULATION - 1
            returns = results.return_[first : last + 1]
            np.testing.assert_array_equal(told.returns[last], returns)
            order = np.argsort(-returns, kind="stable")
            expected = weights @ asked.population[first][order]
            np.testing.assert_allclose(told.cma.mean[last], expected, atol=1e-5)
            np.testing.assert_array_equal(told.cma.mean[first], asked.cma.mean[first])


def test_the_best_prompt_is_the_first_of_the_highest_return(logs):
    for index in range(len(SEARCH_KEYS)):
        queries, results, _, _, best = lane(logs, index)
        for i in range(NUM_EPISODES):
            leader = int(np.argmax(results.return_[: i + 1]))
            np.testing.assert_array_equal(best.goals[i], queries.prompt.goals[leader])


def test_step_size_is_where_the_search_starts(logs):
    _, _, asked, _, _ = logs
    np.testing.assert_allclose(asked.cma.std[:, 0], STD_INIT, rtol=1e-6)
