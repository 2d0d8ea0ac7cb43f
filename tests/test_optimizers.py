"""Prompt optimizers in a toy world: their contract, oracles in plain Python, statistics of arms."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from envs.base import Episode, Trajectory
from mgpo_jax.optimizers import SearchSpace, bbt, bpe, explore, grips, ucb
from mgpo_jax.optimizers.arms import (
    SHRINKAGE,
    empty_arms,
    estimated_returns,
    insert_arm,
    update_arm,
)
from mgpo_jax.optimizers.bpe import posterior, shortfall
from mgpo_jax.optimizers.grips import edit
from mgpo_jax.optimizers.ucb import upper_confidence_bounds
from mgpo_jax.prompts import Prompt, single_goal
from mgpo_jax.rollout import Query

OPTIMIZERS = {"ucb": ucb, "bpe": bpe, "explore": explore, "grips": grips, "bbt": bbt}
NUM_SLOTS, NUM_STEPS, NUM_EPISODES = 4, 6, 24
TASK_GOAL = jnp.array([0.9, 0.8])
RANGE = (-1.0, 2.0)
BANDITS = ("ucb", "bpe", "explore")
BLANK = Trajectory(
    obs=jnp.zeros((NUM_STEPS, 1)),
    actions=jnp.zeros(NUM_STEPS, jnp.int32),
    achieved_goals=jnp.zeros((NUM_STEPS, 2)),
    goal_reached=jnp.zeros(NUM_STEPS, bool),
    outcomes=jnp.zeros((NUM_STEPS, 2)),
    length=jnp.int32(0),
)


class Case(NamedTuple):
    """One search: K, and how much returns differ (0: never)."""

    key: jax.Array
    max_goals: jax.Array
    spread: jax.Array


class Log(NamedTuple):
    query: Query
    episode: Episode
    best: Prompt


def play(key, query, spread):
    """A toy episode: returns prefer goals near the origin; the goals reached are random."""
    key_goals, key_length, key_noise = jax.random.split(key, 3)
    goals = jax.random.uniform(key_goals, (NUM_STEPS, 2))
    length = jax.random.randint(key_length, (), 1, NUM_STEPS + 1)
    real = jnp.arange(NUM_STEPS) < length
    goals = jnp.where(real[:, None], goals, 0.0)
    trajectory = BLANK._replace(
        achieved_goals=goals,
        goal_reached=real,
        outcomes=jnp.where(real[:, None], 2.0, 0.0),
        length=length,
    )
    mask = query.prompt.mask[:, None]
    distance = jnp.sum(query.prompt.goals * mask) / jnp.sum(2 * mask)
    noise = jnp.where(query.greedy, 0.0, 0.3 * jax.random.normal(key_noise))
    # Greedy returns in tenths, so that some tie.
    return_ = spread * (jnp.round(10 * (1 - distance)) / 10 + noise)
    rewards = jnp.where(real & (goals[:, 0] > 0.6), 0.1, 0.0)
    return Episode(trajectory, rewards, return_, last_obs=jnp.zeros(1))


def search(name, case, **options):
    space = SearchSpace(
        num_slots=NUM_SLOTS,
        horizon=NUM_STEPS,
        return_range=RANGE,
        num_episodes=NUM_EPISODES,
        sample_goal=lambda key: jax.random.uniform(key, (2,)),
        max_goals=case.max_goals,
        **options,
    )
    optimizer = OPTIMIZERS[name](space)
    key_init, key_run = jax.random.split(case.key)

    def episode(state, key):
        key_ask, key_play = jax.random.split(key)
        query, state = optimizer.ask(key_ask, state)
        result = play(key_play, query, case.spread)
        state = optimizer.tell(state, query, result)
        return state, Log(query, result, optimizer.best(state))

    state = optimizer.init(key_init, TASK_GOAL)
    return jax.lax.scan(episode, state, jax.random.split(key_run, NUM_EPISODES))[1]


# K of each case and spread of its returns.
SETTINGS = [(4, 1.0), (4, 1.0), (2, 1.0), (1, 1.0), (4, 0.0)]
CASES = Case(
    jax.random.split(jax.random.key(0), len(SETTINGS)),
    jnp.array([k for k, _ in SETTINGS]),
    jnp.array([spread for _, spread in SETTINGS]),
)


@pytest.fixture(scope="module")
def logs():
    run = {name: jax.jit(jax.vmap(partial(search, name))) for name in OPTIMIZERS}
    return {name: jax.tree.map(np.asarray, run[name](CASES)) for name in OPTIMIZERS}


def lane(tree, index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


def listed(prompt):
    """A prompt as a list of goals."""
    return [tuple(goal) for goal in np.asarray(prompt.goals)[np.asarray(prompt.mask)].tolist()]


GOAL = tuple(np.asarray(TASK_GOAL).tolist())


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_lanes_equal_single_searches(logs, name):
    single = jax.jit(partial(search, name))
    for index in (0, 2):
        jax.tree.map(
            partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4),
            lane(logs[name], index),
            single(lane(CASES, index)),
        )


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_the_first_query_is_the_task_goal_greedily(logs, name):
    for index in range(len(SETTINGS)):
        query = lane(lane(logs[name].query, index), 0)
        assert query.greedy
        assert listed(query.prompt) == [GOAL]


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_prompts_are_well_formed(logs, name):
    for prompts in (logs[name].query.prompt, logs[name].best):
        assert np.isfinite(prompts.goals).all()
        assert not prompts.goals[~prompts.mask].any()
        assert prompts.mask[..., -1].all()
        assert (np.diff(prompts.mask.astype(int), axis=-1) >= 0).all()  # right-aligned
        assert (prompts.mask.sum(axis=-1) <= np.asarray(CASES.max_goals)[:, None]).all()
        if name != "bbt":  # BBT moves every goal
            np.testing.assert_array_equal(
                prompts.goals[..., -1, :],
                np.broadcast_to(TASK_GOAL, prompts.goals[..., -1, :].shape),
            )


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_long_prompts_are_tried(logs, name):
    sizes = logs[name].query.prompt.mask.sum(axis=-1)
    assert (sizes[:2].max() == 4) or name == "bbt"  # BBT draws one length for good
    assert sizes.max() > 1


@pytest.mark.parametrize("name", BANDITS)
def test_algorithm_1_replayed(logs, name):
    """Every query follows from what came before: new prompts from tau*, chosen ones from B."""
    for index in range(len(SETTINGS)):
        log = lane(logs[name], index)
        returns = log.episode.return_.astype(float)
        arms, chosen, newest = [], None, None  # arms: (prompt, greedy return, returns)
        for i in range(NUM_EPISODES):
            query = lane(log.query, i)
            prompt = listed(query.prompt)
            assert query.greedy == (i % 2 == 0)
            if i == 0:
                newest = prompt
            elif query.greedy:
                newest = prompt
                best = np.flatnonzero(returns[:i] == returns[:i].max())[-1]  # ties: the newest
                steps = listed(
                    Prompt(log.episode.trajectory.achieved_goals[best], np.ones(NUM_STEPS, bool))
                )
                steps = steps[: log.episode.trajectory.length[best]]
                at = [steps.index(goal) for goal in prompt[:-1]]
                assert at == sorted(set(at))
                assert prompt[-1] == GOAL
            elif name == "explore":
                assert prompt == newest
            else:
                score = score_ucb if name == "ucb" else score_bpe
                scores = score([history for _, _, history in arms], returns[:i].max())
                chosen = next(k for k in np.argsort(-scores, kind="stable") if arms[k][0] == prompt)
                assert scores[chosen] >= scores.max() - 1e-4
            if query.greedy:
                if not arms or returns[i] > max(np.mean(h) for _, _, h in arms):
                    arms.append((prompt, returns[i], [returns[i]]))
            elif name != "explore":
                arms[chosen][2].append(returns[i])
            leader = max(range(len(arms)), key=lambda k: arms[k][1])
            assert listed(lane(log.best, i)) == arms[leader][0]


def test_a_world_of_chance(logs):
    """New prompts are tried by sampling; the optimized one has many returns behind it."""
    run = jax.jit(jax.vmap(partial(search, "ucb", deterministic=False, keep_rewarded=True)))
    many = jax.tree.map(np.asarray, run(CASES))
    kept = 0
    for index, (max_goals, _) in enumerate(SETTINGS):
        log = lane(many, index)
        returns = log.episode.return_.astype(float)
        np.testing.assert_array_equal(log.query.greedy, np.arange(NUM_EPISODES) == 0)
        histories = {}
        for i in range(NUM_EPISODES):
            prompt = tuple(listed(lane(log.query, i).prompt))
            acted = i % 2 == 1
            if i and not acted:
                best = np.flatnonzero(returns[:i] == returns[:i].max())[-1]
                goals = listed(
                    Prompt(log.episode.trajectory.achieved_goals[best], np.ones(NUM_STEPS, bool))
                )
                rewarded = [
                    goal
                    for goal, reward in zip(goals, log.episode.rewards[best], strict=True)
                    if reward > 0
                ]
                # As many of them as there is room for, the first ones first.
                assert set(rewarded[: max_goals - 1]) <= set(prompt)
                kept += len(rewarded)
            means = [np.mean(history) for history in histories.values()]
            if acted or not means or returns[i] > max(means):
                histories.setdefault(prompt, []).append(returns[i])
        pulls = np.array([len(history) for history in histories.values()])
        mean = np.array([np.mean(history) for history in histories.values()])
        overall = (pulls * mean).sum() / pulls.sum()
        estimates = (pulls * mean + SHRINKAGE * overall) / (pulls + SHRINKAGE)
        chosen = list(histories).index(tuple(listed(lane(log.best, -1))))
        assert estimates[chosen] >= estimates.max() - 1e-4
    assert kept > 20


def score_ucb(histories, best_return):
    """Eq. 3, with c = 1 in units of the return span."""
    n = np.array([len(history) for history in histories])
    mean = np.array([np.mean(history) for history in histories])
    return mean + (RANGE[1] - RANGE[0]) * np.sqrt(np.log(n.sum()) / (2 * n))


def eq4(history, min_std=0.02):
    """Eq. 4; the spread of one return is the prior's, that of more has a floor."""
    mean0, std0 = (RANGE[0] + RANGE[1]) / 2, (RANGE[1] - RANGE[0]) / 2
    n = len(history)
    spread = std0 if n == 1 else max(np.std(history), min_std * std0)
    variance = 1 / (1 / std0**2 + n / spread**2)
    return variance * (mean0 / std0**2 + n * np.mean(history) / spread**2), np.sqrt(variance)


def score_bpe(histories, best_return):
    return np.array([-(best_return - mean) / std for mean, std in map(eq4, histories)])


def test_grips_replays_algorithm_2(logs):
    """All prompts of an iteration are one edit away from p*, which the best of them may replace.

    At the end of an iteration it does so on equal returns, too.
    """
    moves = ties = 0
    for index in range(len(SETTINGS)):
        log = lane(logs["grips"], index)
        returns = log.episode.return_
        incumbent, record = [GOAL], returns[0]
        assert log.query.greedy.all()
        for start in range(1, NUM_EPISODES, 5):
            rows = range(start, min(start + 5, NUM_EPISODES))
            prompts = [listed(lane(log.query.prompt, i)) for i in rows]
            assert all(one_edit_away(incumbent, prompt, SETTINGS[index][0]) for prompt in prompts)
            for end, i in enumerate(rows, start=1):
                leader = int(np.argmax(returns[start : start + end]))
                best_return = returns[start + leader]
                moved = best_return > record or (end == 5 and best_return == record)
                best = prompts[leader] if moved else incumbent
                assert listed(lane(log.best, i)) == best
            if len(rows) == 5 and moved:
                moves, ties = moves + 1, ties + (best_return == record)
                incumbent, record = best, best_return
    assert moves >= 3
    assert ties >= 1


def edits_of(goals, new, max_goals):
    """Every result of Add, Del and Swap on the goals before the last, with its probability."""
    *head, last = goals
    n = len(head)
    operations = []
    if n < max_goals - 1:
        operations.append([[*head[:i], new, *head[i:]] for i in range(n + 1)])
    if n >= 1:
        operations.append([head[:i] + head[i + 1 :] for i in range(n)])
    if n >= 2:
        swaps = []
        for i in range(n):
            for j in range(i):
                swapped = list(head)
                swapped[i], swapped[j] = head[j], head[i]
                swaps.append(swapped)
        operations.append(swaps)
    if not operations:
        return {(*goals,): 1.0}
    return {
        (*result, last): 1 / len(operations) / len(results)
        for results in operations
        for result in results
    }


def one_edit_away(goals, edited, max_goals):
    new = next((goal for goal in edited if goal not in goals), None)
    return tuple(edited) in edits_of(goals, new, max_goals)


@jax.jit
def edit_often(prompt, max_goals):
    keys = jax.random.split(jax.random.key(7), 1500)
    new = jnp.array([99.0, 98.0])
    return jax.vmap(lambda key: edit(key, prompt, new, max_goals))(keys)


@pytest.mark.parametrize(
    ("count", "max_goals"), [(0, 1), (0, 4), (1, 2), (1, 4), (2, 4), (3, 4), (2, 3), (4, 5), (3, 5)]
)
def test_edits_are_those_of_plain_lists(count, max_goals):
    """Every edit is one list operation, every one occurs, each as often as it should."""
    goals = [(float(i), float(10 + i)) for i in range(1, count + 2)]
    empty = 5 - len(goals)
    prompt = Prompt(jnp.asarray([(0.0, 0.0)] * empty + goals), jnp.arange(5) >= empty)
    edited = jax.tree.map(np.asarray, edit_often(prompt, jnp.int32(max_goals)))
    expected = edits_of(goals, (99.0, 98.0), max_goals)
    found = [tuple(listed(lane(edited, i))) for i in range(len(edited.mask))]
    assert set(found) == set(expected)
    counts = [found.count(result) for result in expected]
    probabilities = np.array(list(expected.values()))
    if len(counts) > 1:
        assert stats.chisquare(counts, probabilities * len(found)).pvalue > 1e-3
    assert not edited.goals[~edited.mask].any()
    assert (np.diff(edited.mask.astype(int), axis=-1) >= 0).all()


def arms_of(histories):
    """An arm table with the given returns, filled by the functions under test."""
    arms = empty_arms(len(histories) + 2, 1, 2)
    prompt = single_goal(jnp.zeros(2), 1)
    for row, history in enumerate(histories):
        arms = _insert(arms, prompt, jnp.float32(history[0]))
        for return_ in history[1:]:
            arms = _update(arms, jnp.int32(row), jnp.float32(return_))
    return arms


_insert, _update = jax.jit(insert_arm), jax.jit(update_arm)
HISTORIES = st.lists(
    st.lists(st.floats(-1, 2, width=32), min_size=1, max_size=6), min_size=3, max_size=3
)


@settings(max_examples=40, deadline=None)
@given(HISTORIES)
def test_arm_statistics_against_numpy(histories):
    arms = arms_of(histories)
    np.testing.assert_array_equal(arms.taken, [True, True, True, False, False])
    np.testing.assert_array_equal(arms.pulls[:3], [len(history) for history in histories])
    for row, history in enumerate(histories):
        np.testing.assert_allclose(arms.mean[row], np.mean(history), atol=1e-5)
        np.testing.assert_allclose(arms.std[row], np.std(history), atol=1e-3)


_bounds = jax.jit(upper_confidence_bounds, static_argnums=2)


@settings(max_examples=40, deadline=None)
@given(HISTORIES, st.floats(0, 10))
def test_ucb_against_eq_3(histories, c):
    bounds = np.asarray(_bounds(arms_of(histories), c, 1.0))
    n = np.array([len(history) for history in histories])
    mean = np.array([np.mean(history) for history in histories])
    expected = mean + c * np.sqrt(np.log(n.sum()) / (2 * n))
    np.testing.assert_allclose(bounds[:3], expected, rtol=1e-4, atol=1e-5)
    assert (bounds[3:] == -np.inf).all()


_posterior = jax.jit(lambda arms, min_std: posterior(arms, RANGE, min_std))
_shortfall = jax.jit(lambda arms, best: shortfall(arms, best, RANGE, 0.02))


@settings(max_examples=40, deadline=None)
@given(HISTORIES, st.floats(0.02, 0.5))
def test_bpe_posterior_against_eq_4(histories, min_std):
    mean, std = _posterior(arms_of(histories), min_std)
    expected = np.array([eq4(history, min_std) for history in histories])
    np.testing.assert_allclose(mean[:3], expected[:, 0], rtol=2e-2, atol=1e-3)
    np.testing.assert_allclose(std[:3], expected[:, 1], rtol=2e-2, atol=1e-3)


@settings(max_examples=40, deadline=None)
@given(HISTORIES, st.floats(0, 50))
def test_bpe_chooses_the_largest_tail(histories, beyond):
    """Its choice is the most likely to exceed R*, however far out R* lies."""
    best = max(max(history) for history in histories) + beyond
    values = np.asarray(_shortfall(arms_of(histories), jnp.float32(best)))
    assert (values[3:] == np.inf).all()
    tails = np.array([stats.norm.logsf(best, *eq4(history)) for history in histories])
    chosen = tails[np.argmin(values)]
    assert chosen >= tails.max() - 1e-3 - 0.02 * abs(tails.max())


def test_bpe_tells_apart_what_underflows():
    # 1 - cdf is 0 for both in double precision; only the first has spread.
    histories = [[0.0, 1.0], [0.5, 0.5], [0.5, 0.5]]
    tails = [stats.norm.sf(60.0, *eq4(history)) for history in histories]
    assert tails == [0.0, 0.0, 0.0]
    values = _shortfall(arms_of(histories), jnp.float32(60.0))
    assert np.isfinite(np.asarray(values[:3])).all()
    assert int(np.argmin(values)) == 0
    assert values[1] == values[2]  # equal histories tie


def test_a_full_table_replaces_the_worst_entry_return():
    arms = empty_arms(3, 1, 1)
    for return_ in (0.5, 0.2, 0.9):
        arms = insert_arm(arms, single_goal(jnp.full(1, return_), 1), jnp.float32(return_))
    arms = update_arm(arms, jnp.int32(1), jnp.float32(1.8))  # the mean is not what counts
    arms = insert_arm(arms, single_goal(jnp.full(1, 0.7), 1), jnp.float32(0.7))
    assert int(arms.size) == 3
    np.testing.assert_allclose(arms.entry_return, [0.5, 0.7, 0.9])
    np.testing.assert_allclose(arms.prompts.goals[:, 0, 0], [0.5, 0.7, 0.9])
    np.testing.assert_allclose(arms.mean, [0.5, 0.7, 0.9])
    np.testing.assert_array_equal(arms.pulls, [1, 1, 1])
    np.testing.assert_array_equal(arms.sum_sq, [0, 0, 0])


def test_the_optimized_prompt_is_not_the_luckiest_one():
    """One high return of a world of chance does not beat many good ones; without chance it does."""
    histories = [[0.5, 0.2], [0.82], [0.8, 0.7, 0.8, 0.7, 0.75, 0.75]]
    arms = arms_of(histories)
    overall = np.mean(np.concatenate(histories))
    expected = [
        (np.sum(history) + SHRINKAGE * overall) / (len(history) + SHRINKAGE)
        for history in histories
    ]
    noisy = np.asarray(estimated_returns(arms, deterministic=False))
    np.testing.assert_allclose(noisy[:3], expected, rtol=1e-5)
    assert (noisy[3:] == -np.inf).all()
    assert int(np.argmax(noisy)) == 2
    exact = np.asarray(estimated_returns(arms, deterministic=True))
    np.testing.assert_allclose(exact[:3], [0.5, 0.82, 0.8])
    assert (exact[3:] == -np.inf).all()


def test_hyper_parameters_can_be_swept_by_vmap():
    """The exploration constant is traced: c = 0 exploits, a large c balances the pulls."""
    arms = arms_of([[0.0], [1.0, 1.0, 1.0]])
    space = SearchSpace(
        num_slots=1,
        horizon=NUM_STEPS,
        return_range=(0.0, 1.0),
        num_episodes=8,
        sample_goal=lambda key: jnp.zeros(2),
    )
    state = OPTIMIZERS["ucb"](space).init(jax.random.key(0), TASK_GOAL)

    def choice(c):
        query_state = state._replace(arms=arms, episode=jnp.int32(1))
        return OPTIMIZERS["ucb"](space, c=c).ask(jax.random.key(0), query_state)[1].arm

    np.testing.assert_array_equal(jax.vmap(choice)(jnp.array([0.0, 10.0])), [1, 0])


def test_ucb_regret_grows_slower_than_time():
    means = jnp.array([0.1, 0.3, 0.5, 0.6, 0.9])
    horizon = 1200

    def regret(key):
        arms = empty_arms(len(means), 1, 1)
        for mean in means:
            arms = insert_arm(arms, single_goal(mean[None], 1), mean)

        def pull(arms, key):
            arm = jnp.argmax(upper_confidence_bounds(arms, 1.0, 1.0))
            return_ = means[arm] + 0.25 * jax.random.normal(key)
            return update_arm(arms, arm, return_), means.max() - means[arm]

        return jnp.cumsum(jax.lax.scan(pull, arms, jax.random.split(key, horizon))[1])

    curve = np.asarray(jax.jit(jax.vmap(regret))(jax.random.split(jax.random.key(0), 64))).mean(0)
    uniform = float(means.max() - means.mean()) * horizon
    assert curve[-1] < 0.15 * uniform
    assert curve[-1] - curve[horizon // 2] < 0.5 * curve[horizon // 2]
