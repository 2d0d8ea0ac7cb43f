"""The method ``plan``: its map against networkx, rehearsals against episodes, orders on a handmade task."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest

from envs.base import Episode, Goals, Trajectory
from envs.errors import NotAvailableError
from envs.maze.env import MazeRunner, MazeTask
from mgpo_jax.adaptation import search
from mgpo_jax.distributions import Categorical
from mgpo_jax.optimizers.arms import empty_arms
from mgpo_jax.optimizers.base import SearchSpace
from mgpo_jax.optimizers.methods import prompt_adapter
from mgpo_jax.planning import worths
from mgpo_jax.planning.maps import plan_map
from mgpo_jax.planning.orders import MOVED, NONE, moved_goals, plan_order, without
from mgpo_jax.planning.proposals import changed, random_prompts
from mgpo_jax.planning.rehearsal import ARRIVES, FAILS, LEAVES, Ahead, Seen, _result, rehearse
from mgpo_jax.planning.searching import Features
from mgpo_jax.planning.steering import deficits, lead_along, steer
from mgpo_jax.planning.table import (
    FAR,
    UNKNOWN,
    Table,
    add_episode,
    empty_table,
    find_state,
    goals_on,
    shortest_way,
    steps_from,
    steps_to,
    way_to,
)
from mgpo_jax.planning.trials import mean_steps, most_promising, with_result
from mgpo_jax.planning.worths import (
    SHARE_OF_PROMPT,
    Posterior,
    alike,
    likeness,
    plan_worth,
    posterior,
)
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import Prompt, goals_of, prompt_of, single_goal
from mgpo_jax.rollout import Query, rollout

SIDE, NUM_SLOTS = 9, 5
WORLD = MazeRunner(name="small", side=SIDE, horizon=40)


def compass(num_slots: int = NUM_SLOTS, sharpness: float = 1.0) -> Policy:
    """A policy that needs no training: it steps towards the first goal of its prompt that it has not
    reached, and only where the way is free. It gets stuck in dead ends, so that prompts matter."""
    moves = jnp.array([(0, -1), (-1, 0), (0, 1), (1, 0)]) / SIDE

    def decide(prompt, slot, obs):
        here, free = obs[:2], obs[2:6] > 0
        reached = jnp.all(jnp.abs(prompt.goals[slot] - here) < 1e-3)
        slot = jnp.minimum(slot + reached, num_slots - 1)
        distance = jnp.sum(jnp.abs(here + moves - prompt.goals[slot]), axis=-1)
        logits = -sharpness * SIDE * distance + jnp.where(free, 0.0, -100.0)
        return Categorical(jnp.append(logits, -200.0)), slot

    def prefill(prompt, obs):
        distribution, slot = decide(prompt, jnp.argmax(prompt.mask), obs)
        return distribution, (prompt, slot)

    def decode(carry, action, obs):
        prompt, slot = carry
        distribution, slot = decide(prompt, slot, obs)
        return distribution, (prompt, slot)

    def score(prompt, obs, actions):
        del actions  # it looks at where it is and not at what it did

        def step(slot, obs):
            distribution, slot = decide(prompt, slot, obs)
            return slot, distribution

        return jax.lax.scan(step, jnp.argmax(prompt.mask), obs)[1]

    return Policy(prefill, decode, lambda carry, num_steps: carry, num_slots, score)


POLICY = compass()


@pytest.fixture(scope="module")
def tasks():
    return jax.vmap(WORLD.sample_task)(jax.random.split(jax.random.key(3), 12))


def task_at(tasks, index):
    return jax.tree.map(lambda leaf: leaf[index], tasks)


@jax.jit
def explored(key, task):
    """Five episodes of random actions under random prompts, and the table of them."""

    def another(table, key):
        key_goals, key_run = jax.random.split(key)
        goals = jax.vmap(WORLD.sample_goal)(jax.random.split(key_goals, NUM_SLOTS - 1))
        prompt = single_goal(WORLD.task_goal(task), NUM_SLOTS)
        prompt = prompt._replace(
            goals=prompt.goals.at[:-1].set(goals), mask=jnp.ones(NUM_SLOTS, bool)
        )
        query = Query(prompt, jnp.zeros((), bool))
        episode = rollout(key_run, WORLD, compass(sharpness=0.3), task, query)
        table, start = add_episode(table, episode)
        return table, (episode, start)

    first = empty_table(WORLD.spec, 100)
    return jax.lax.scan(another, first, jax.random.split(key, 5))


def graph_of(episodes):
    """The same as a networkx graph: states are goals, edges what was walked."""
    graph = nx.DiGraph()
    for first, goals, length in zip(
        np.asarray(episodes.first_goal),
        np.asarray(episodes.trajectory.achieved_goals),
        np.asarray(episodes.trajectory.length),
        strict=True,
    ):
        way = [tuple(np.round(row, 4)) for row in (first, *goals[:length])]
        nx.add_path(graph, way)
    return graph


@pytest.mark.parametrize("index", range(4))
def test_known_ways_are_those_of_the_union_of_all_episodes(tasks, index):
    table, (episodes, starts) = explored(jax.random.key(index), task_at(tasks, index))
    graph = graph_of(episodes)
    names = [tuple(np.round(row, 4)) for row in np.asarray(table.goals)[: int(table.size)]]
    assert set(names) == set(graph)
    assert len(set(np.asarray(starts).tolist())) == 1
    start = int(starts[0])
    after = np.asarray(steps_from(table, starts[0]))
    wanted = nx.single_source_shortest_path_length(graph, names[start])
    assert {name: int(after[i]) for i, name in enumerate(names) if after[i] < FAR} == wanted
    for end in (0, len(names) - 1):
        before = np.asarray(steps_to(table, jnp.int32(end)))
        wanted = nx.single_target_shortest_path_length(graph, names[end])
        assert {n: int(before[i]) for i, n in enumerate(names) if before[i] < FAR} == dict(wanted)
        way = shortest_way(jax.random.key(0), table, starts[0], steps_to(table, jnp.int32(end)), 40)
        walked = [start, *[int(i) for i in way if i != UNKNOWN]]
        assert walked[-1] == end
        assert len(walked) - 1 == int(after[end])
        assert all(graph.has_edge(names[a], names[b]) for a, b in pairwise(walked))


def test_a_hand_drawn_way_is_spliced_from_two_episodes():
    # One episode goes 0, 1, 2 and another 1, 3; nobody ever went from 0 to 3.
    def walk(goals, actions):
        rows = jnp.array(goals[1:], jnp.float32)[:, None]
        num = len(actions)
        steps = Trajectory(
            obs=jnp.array(goals[:-1], jnp.float32)[:, None],
            actions=jnp.array(actions),
            achieved_goals=rows,
            goal_reached=jnp.ones(num, bool),
            outcomes=rows,
            length=jnp.int32(num),
        )
        last, first = rows[-1], jnp.array([float(goals[0])])
        return Episode(steps, jnp.zeros(num), jnp.float32(0), last, first)

    spec = WORLD.spec
    table = empty_table(spec, 10)._replace(goals=jnp.zeros((10, 1)), obs=jnp.zeros((10, 1)))
    table, start = add_episode(table, walk([0, 1, 2], [2, 2]))
    table, other = add_episode(table, walk([1, 3], [4]))
    assert (int(start), int(other), int(table.size)) == (0, 1, 4)
    goal = find_state(table, jnp.array([3.0]))
    left = steps_to(table, goal)
    assert left[:4].tolist() == [2, 1, FAR, 0]
    way = shortest_way(jax.random.key(0), table, start, left, 5)
    assert way.tolist() == [1, 3, UNKNOWN, UNKNOWN, UNKNOWN]
    assert goals_on(table, way).achieved_goals[:2, 0].tolist() == [1.0, 3.0]
    assert table.stride == 2.0


def test_a_full_table_keeps_what_it_has():
    task = MazeTask(jnp.zeros((SIDE, SIDE), jnp.int32), jnp.array([1, 1]))
    prompt = single_goal(WORLD.task_goal(task), NUM_SLOTS)
    episode = rollout(jax.random.key(0), WORLD, POLICY, task, Query(prompt, jnp.ones((), bool)))
    assert episode.trajectory.length > 5
    table, start = add_episode(empty_table(WORLD.spec, 4), episode)
    assert (int(start), int(table.size)) == (0, 4)
    assert find_state(table, WORLD.task_goal(task)) == UNKNOWN
    assert int(jnp.max(table.successors)) == 3
    assert int(steps_from(table, start)[3]) == 3


def corridor(num: int) -> Table:
    """A map of states in a row; action 2 leads to the next one."""
    table = empty_table(WORLD.spec, num)
    after = jnp.arange(1, num + 1).at[-1].set(UNKNOWN)
    return table._replace(successors=table.successors.at[:, 2].set(after), size=jnp.int32(num))


def test_no_way_begins_at_an_unknown_state():
    table = corridor(3)
    way = partial(way_to, jax.random.key(0), table, end=jnp.int32(2), longest=4)
    assert int(way(start=jnp.int32(0)).steps) == 2
    assert int(way(start=jnp.int32(UNKNOWN)).steps) == FAR


@pytest.mark.parametrize("num", [200, 400])
def test_long_rehearsals_are_counted_in_full(num):
    table, goal = corridor(num), jnp.int32(num - 1)
    ahead = Ahead(table, jnp.int32(0), goal, steps_to(table, goal), jnp.int32(500))
    along = jnp.concatenate([jnp.arange(1, num), jnp.full(num, UNKNOWN)])
    sure = _result(along, jnp.int32(num - 1), ahead)
    assert (int(sure.ends), int(sure.steps)) == (ARRIVES, num - 1)
    assert int(sure.strays) == int(sure.farthest) == num - 1
    left = _result(along.at[5].set(UNKNOWN), jnp.int32(6), ahead)
    assert int(left.ends) == LEAVES
    assert int(left.steps) >= num - 1
    assert (int(left.strays), int(left.farthest)) == (5, 5)
    assert int(sure.rank) < int(left.rank)


@pytest.mark.parametrize("index", range(6))
def test_what_a_rehearsal_calls_sure_an_episode_does(tasks, index):
    task = task_at(tasks, index)
    table, (_, starts) = explored(jax.random.key(index), task)
    goal = find_state(table, WORLD.task_goal(task))
    end = jnp.where(goal == UNKNOWN, table.size - 1, goal)
    left = steps_to(table, end)
    way = goals_on(table, shortest_way(jax.random.key(1), table, starts[0], left, 40))
    prompts = random_prompts(jax.random.key(index), way, table.goals[end], NUM_SLOTS, NUM_SLOTS, 24)
    ahead = Ahead(table, starts[0], end, left, jnp.int32(40))
    found = jax.jit(partial(rehearse, Seen(WORLD.spec, 40), POLICY))(ahead, prompts)
    query = Query(prompts, jnp.ones(24, bool))
    real = jax.jit(jax.vmap(lambda key, query: rollout(key, WORLD, POLICY, task, query)))(
        jax.random.split(jax.random.key(0), 24), query
    )
    goals = np.asarray(real.trajectory.achieved_goals)
    for i in range(24):
        length = int(real.trajectory.length[i])
        hits = np.flatnonzero((np.abs(goals[i, :length] - table.goals[end]) < 1e-3).all(axis=1))
        if found.ends[i] == ARRIVES:
            assert int(found.steps[i]) == hits[0] + 1
        elif found.ends[i] == FAILS:
            assert not hits.size


def test_steering_moves_a_prompt_onto_a_way(tasks):
    # Led by its last goal alone the compass goes straight; the way goes around.
    task = MazeTask(jnp.zeros((SIDE, SIDE), jnp.int32).at[4, 2:7].set(1), jnp.array([1, 4]))
    around = prompt_of(np.array([[7, 1], [1, 1], [1, 4]]) / SIDE, NUM_SLOTS)
    episode = rollout(jax.random.key(0), WORLD, POLICY, task, Query(around, jnp.ones((), bool)))
    table, start = add_episode(empty_table(WORLD.spec, 100), episode)
    left = steps_to(table, find_state(table, WORLD.task_goal(task)))
    way = shortest_way(jax.random.key(0), table, start, left, 40)
    lead = lead_along(table, start, way, 32)
    assert int(lead.real.sum()) == int(left[start]) == int(episode.trajectory.length)
    assert deficits(POLICY, lead, jax.tree.map(lambda leaf: leaf[None], around))[0] == 0
    beside = prompt_of(np.array([[7.4, 1.9], [1.2, 1.3], [1, 4]]) / SIDE, NUM_SLOTS)
    first = jax.tree.map(lambda leaf: leaf[None], beside)
    before = deficits(POLICY, lead, first)
    steered, after = steer(POLICY, lead, first, table.stride, 50)
    assert after[0] < before[0]
    np.testing.assert_array_equal(steered.goals[0, -1], beside.goals[-1])
    np.testing.assert_array_equal(steered.goals[0, :2], 0)
    np.testing.assert_allclose(deficits(POLICY, lead, steered), after, atol=1e-5)
    cut = lead_along(table, start, way, 4)
    np.testing.assert_array_equal(cut.actions, lead.actions[:4])
    room = lead_along(table, start, way, 64)  # more than the way has
    np.testing.assert_array_equal(room.real[:32], lead.real)
    assert not room.real[32:].any()


def test_changed_prompts_are_prompts_of_the_way():
    way = Goals(
        jnp.arange(20.0).reshape(10, 2),
        jnp.arange(10) < 8,
        jnp.arange(20.0).reshape(10, 2),
        jnp.int32(8),
    )
    prompt = prompt_of([[2.0, 3.0], [8.0, 9.0], [14.0, 15.0]], NUM_SLOTS)
    many = jax.vmap(lambda key: changed(key, prompt, way, 4, jnp.float32(0.01), jnp.int32(3)))(
        jax.random.split(jax.random.key(0), 400)
    )
    counts = set()
    for i in range(400):
        goals = goals_of(jax.tree.map(lambda leaf, i=i: leaf[i], many))
        counts.add(len(goals))
        assert goals[-1].tolist() == [14.0, 15.0]
        places = np.round(goals[:-1, 0] / 2)
        assert (np.diff(places) >= 0).all()  # in the order of the way
        assert (places < 7).all()  # the end of the way is not inserted
        assert np.abs(goals[:-1] - np.round(goals[:-1])).max(initial=0) < 0.1
    assert counts == {2, 3, 4}  # never longer than asked for
    alone = prompt_of([[14.0, 15.0]], NUM_SLOTS)
    same = changed(jax.random.key(0), alone, way, 1, jnp.float32(0.01), jnp.int32(3))
    assert same.mask.tolist() == alone.mask.tolist()


def adapted(
    tasks,
    features=Features(),  # noqa: B008
    num_episodes=30,
    policy=POLICY,
    num_states=100,
    deterministic=True,
    sample_goal=WORLD.sample_goal,
):
    space = SearchSpace(
        num_slots=policy.num_slots,
        horizon=WORLD.horizon,
        return_range=WORLD.spec.return_range,
        num_episodes=num_episodes,
        sample_goal=sample_goal,
        deterministic=deterministic,
    )
    optimizer = plan_map(space, WORLD.spec, policy, num_states, features)
    adapter = prompt_adapter(policy, optimizer)
    keys = jax.random.split(jax.random.key(7), 12)[: len(tasks.goal)]

    def one(key, task):
        result = search(key, WORLD, adapter, task, num_episodes)
        episode = rollout(key, WORLD, policy, task, result.best)
        return result, episode.return_

    return jax.jit(jax.vmap(one))(keys, tasks)


@pytest.fixture(scope="module")
def finals(tasks):
    return adapted(tasks)


def test_the_plan_finds_shortest_ways(tasks, finals):
    optimum = np.asarray(jax.vmap(WORLD.optimal_return)(tasks))
    result, returns = finals
    first = np.asarray(result.log.returns)[:, 0, 0]
    assert np.mean(optimum - first > 0.05) > 0.3  # the policy alone gets stuck
    assert np.mean(optimum - returns < 1e-4) > 0.9


def test_the_best_prompt_is_worth_what_was_seen_of_it(finals):
    result, returns = finals
    log = result.log
    greedy = np.asarray(log.choices.greedy)
    seen = np.where(greedy, np.asarray(log.returns)[..., 0], -np.inf).max(axis=1)
    np.testing.assert_allclose(np.asarray(returns), seen, atol=1e-5)


@pytest.mark.slow
def test_lanes_equal_single_searches(tasks, finals):
    result, _ = finals
    alone, _ = adapted(task_rows(tasks, 1))
    np.testing.assert_array_equal(alone.log.returns[0], result.log.returns[0])


ABLATIONS = (Features(steering=0), Features(splice=False), Features(frontier=False))


@pytest.mark.parametrize(
    "features",
    [
        Features(rounds=0),
        *(pytest.param(case, marks=pytest.mark.slow) for case in ABLATIONS),
    ],
    ids=["no rehearsal", "no steering", "no splicing", "no frontier"],
)
def test_ablations_run_and_are_no_better(tasks, finals, features):
    optimum = np.asarray(jax.vmap(WORLD.optimal_return)(tasks))
    result, returns = adapted(tasks, features)
    prompts, others = (each.log.choices.prompt.goals for each in (result, finals[0]))
    # In these mazes rehearsed prompts suffice, so nothing is left to steer (but see the test of steering).
    assert (prompts != others).any() == bool(features.steering)
    assert np.mean(optimum - returns) >= np.mean(optimum - finals[1]) - 0.02


def test_a_map_without_room_still_adapts(tasks):
    result, returns = adapted(tasks, num_states=3, num_episodes=6)
    gained = returns - np.asarray(result.log.returns)[:, 0, 0]
    assert gained.min() > -1e-5  # the first episode evaluates (g^M)


def test_beyond_a_full_map_prompts_are_those_of_the_best_episode(tasks, finals):
    """Few of the cells on the ways fit in; the best episode still leads on."""
    optimum = np.asarray(jax.vmap(WORLD.optimal_return)(tasks))
    result, returns = adapted(tasks, num_states=6, num_episodes=60)
    gained = returns - np.asarray(result.log.returns)[:, 0, 0]
    assert gained.min() > -1e-5  # the first episode evaluates (g^M)
    first = optimum - np.asarray(finals[0].log.returns)[:, 0, 0]
    assert np.mean(optimum - returns) < 0.5 * np.mean(first)


def test_prompts_of_one_goal_still_adapt(tasks):
    result, returns = adapted(tasks, policy=compass(num_slots=1), num_episodes=4)
    prompts = np.asarray(result.log.choices.prompt.goals)
    np.testing.assert_array_equal(
        prompts, np.broadcast_to(jax.vmap(WORLD.task_goal)(tasks)[:, None, None], prompts.shape)
    )
    np.testing.assert_allclose(returns, result.log.returns[:, 0, 0], atol=1e-5)


def test_a_task_that_cannot_be_solved_ends_like_any_other(tasks):
    """The goal is walled in, so no episode reaches it and no path to it is ever known."""
    first = task_at(tasks, 0)
    row, column = first.goal
    walls = first.maze.at[row - 1 : row + 2, column - 1 : column + 2].set(1)
    assert WORLD.optimal_return(first) > WORLD.spec.return_range[0]
    task = MazeTask(walls.at[row, column].set(0)[None], first.goal[None])
    result, returns = adapted(task, num_episodes=8)
    worst = WORLD.spec.return_range[0]
    np.testing.assert_allclose(result.log.returns, worst, atol=1e-5)
    np.testing.assert_allclose(returns, worst, atol=1e-5)
    # After the first episode each prompt names a goal that no earlier episode reached, then the task goal.
    prompts = result.log.choices.prompt
    np.testing.assert_array_equal(np.asarray(prompts.mask)[0, 1:].sum(axis=-1), 2)
    named = np.asarray(prompts.goals)[0, :, -2]
    reached = np.asarray(result.log.played.goals.achieved_goals)[0, :, 0]
    for turn in range(1, 8):
        assert np.abs(reached[:turn] - named[turn]).sum(axis=-1).min() > 1e-3
    assert len(np.unique(named[1:], axis=0)) > 3


def test_in_a_world_that_draws_no_goals_it_explores_by_those_it_has_seen(tasks):
    def sample_goal(key):
        raise NotAvailableError("this maze draws no goals at random")

    _, returns = adapted(tasks, num_episodes=10, sample_goal=sample_goal)
    assert np.isfinite(returns).all()


class TestTrialsUnderNoise:
    """In a stochastic world the return of one episode is partly luck."""

    def prompts(self, *returns):
        table = empty_arms(4, NUM_SLOTS, 2)
        for index, several in enumerate(returns):
            query = Query(self.prompt(index), jnp.ones((), bool))
            for return_ in several:
                table = with_result(table, query, jnp.float32(return_))
        return table

    def prompt(self, index):
        return prompt_of([[float(index), 1.0]], NUM_SLOTS)

    def test_a_prompt_that_was_lucky_once_is_run_again(self):
        chosen = most_promising(self.prompts([-0.5, -0.6, -0.4], [-0.3]))
        assert chosen.goals[-1, 0] == 1

    def test_a_prompt_that_is_surely_worse_is_not(self):
        chosen = most_promising(self.prompts([-0.1] * 12, [-0.9] * 3))
        assert chosen.goals[-1, 0] == 0

    def test_mean_steps_are_those_of_the_episodes(self):
        table, means = self.prompts(), jnp.full(4, 99.0)
        for index, steps in ((0, 10), (1, 30), (0, 20), (0, 60)):
            prompt = self.prompt(index)
            table = with_result(table, Query(prompt, jnp.ones((), bool)), jnp.float32(-steps))
            means = mean_steps(means, table, prompt, jnp.int32(steps))
        np.testing.assert_allclose(means[:2], [30, 30])

    def test_every_second_episode_repeats_a_prompt(self, tasks):
        """Once a path is known; what is repeated was run greedily before."""
        result, _ = adapted(task_rows(tasks, 4), deterministic=False)
        queries = jax.tree.map(np.asarray, result.log.choices)
        again = 0
        for lane in range(4):
            seen = set()
            for turn in range(30):
                prompt = queries.prompt.goals[lane, turn].tobytes()
                known = prompt in seen
                again += known
                if queries.greedy[lane, turn]:
                    assert known or turn % 2 == 1 or turn == 0 or not solved(result, lane, turn)
                    seen.add(prompt)
        assert again > 30


def solved(result, lane, turn):
    """Whether any episode before this one reached the task goal."""
    worst = WORLD.spec.return_range[0]
    return bool((np.asarray(result.log.returns)[lane, :turn] > worst + 1e-4).any())


def task_rows(tasks, num):
    return jax.tree.map(lambda leaf: leaf[:num], tasks)


NUM_GOALS = 5


def orderly(prompt, hidden, horizon=12):
    """An episode that reaches the goals of a prompt in turn, and is paid for the hidden order's beginning.

    After the first goal that is not the next, nothing more is paid.
    """
    inner, used = prompt.goals[:-1], prompt.mask[:-1]
    order = jnp.argsort(~used)
    reached = jnp.argmax(inner[order], axis=-1)
    num = used.sum()
    right = jnp.cumprod((reached == hidden[: len(reached)]) & (jnp.arange(len(reached)) < num))
    pad = horizon - len(reached)
    goals = jnp.pad(jax.nn.one_hot(reached, NUM_GOALS), ((0, pad), (0, 0)))
    happens = jnp.arange(horizon) < num
    goals = jnp.where(happens[:, None], goals, 0.0)
    rewards = jnp.pad(right / NUM_GOALS, (0, pad))
    steps = Trajectory(
        obs=jnp.zeros((horizon, 1)),
        actions=jnp.zeros(horizon, jnp.int32),
        achieved_goals=goals,
        goal_reached=happens,
        outcomes=goals,
        length=jnp.maximum(num, 1),
    )
    return Episode(steps, rewards, rewards.sum(), jnp.zeros(1), jnp.zeros(NUM_GOALS))


def order_search(key, hidden, num_episodes=40, deterministic=True):
    space = SearchSpace(
        num_slots=NUM_GOALS + 1,
        horizon=12,
        return_range=(0.0, 1.0),
        num_episodes=num_episodes,
        sample_goal=lambda key: jnp.zeros(NUM_GOALS),
        deterministic=deterministic,
    )
    optimizer = plan_order(space)
    task_goal = jnp.ones(NUM_GOALS)

    def another(state, key):
        key, key_prompt = jax.random.split(key)
        query, asked = optimizer.ask(key, state)
        # The first prompt names nothing, and then the agent does something at random.
        at_random = jax.nn.one_hot(jax.random.permutation(key_prompt, NUM_GOALS), NUM_GOALS)
        acted = query.prompt._replace(
            goals=jnp.concatenate([at_random, task_goal[None]]), mask=jnp.ones(NUM_GOALS + 1, bool)
        )
        alone = query.prompt.mask.sum() == 1
        prompt = jax.tree.map(lambda a, b: jnp.where(alone, a, b), acted, query.prompt)
        episode = orderly(prompt, hidden)
        return optimizer.tell(asked, query, episode), (
            query,
            asked.first,
            state.order,
            episode.return_,
        )

    state = optimizer.init(key, task_goal)
    state, log = jax.lax.scan(another, state, jax.random.split(key, num_episodes))
    return orderly(optimizer.best(state), hidden).return_, log


@pytest.fixture(scope="module")
def orders():
    keys = jax.random.split(jax.random.key(1), 8)
    hidden = jax.vmap(lambda key: jax.random.permutation(key, NUM_GOALS))(keys)
    return jax.jit(jax.vmap(order_search))(keys, hidden)


def test_the_hidden_order_is_found(orders):
    best, (_, _, _, returns) = orders
    np.testing.assert_allclose(best, 1.0, atol=1e-5)
    # By elimination a goal of n costs at most n - 1 wrong trials, so all together 1 + 4 + 3 + 2 + 1.
    solved_after = np.argmax(np.asarray(returns) > 1 - 1e-4, axis=1)
    assert solved_after.max() <= 11


def test_searches_of_one_order_draw_plans_of_their_own():
    keys = jax.random.split(jax.random.key(5), 6)
    hidden = jnp.broadcast_to(jnp.arange(NUM_GOALS), (6, NUM_GOALS))
    search = partial(order_search, num_episodes=3, deterministic=False)
    _, (query, *_) = jax.jit(jax.vmap(search))(keys, hidden)
    second = np.asarray(query.prompt.goals)[:, 1].reshape(6, -1)
    assert len(np.unique(second, axis=0)) > 2


def test_what_was_ruled_out_is_never_tried_again(orders):
    _, (_, first, before, _) = orders
    for lane in range(len(first)):
        for episode in range(first.shape[1]):
            number = int(first[lane, episode])
            if number != NONE:
                assert not before.excluded[lane, episode, number]
                assert number not in np.asarray(before.prefix)[lane, episode].tolist()


def test_a_prompt_without_one_of_its_goals():
    prompt = prompt_of([[1.0], [2.0], [3.0], [9.0]], 5)
    assert goals_of(without(prompt, jnp.int32(2)))[:, 0].tolist() == [1.0, 3.0, 9.0]
    assert goals_of(without(prompt, jnp.int32(1)))[:, 0].tolist() == [2.0, 3.0, 9.0]
    assert goals_of(without(prompt, jnp.int32(0)))[:, 0].tolist() == [1.0, 2.0, 3.0, 9.0]


def test_moved_goals_keep_the_task_goal():
    prompt = prompt_of([[1.0], [2.0], [9.0]], 5)
    moved = moved_goals(jax.random.key(0), prompt)
    assert moved.mask.tolist() == prompt.mask.tolist()
    assert float(moved.goals[-1, 0]) == 9.0
    assert (moved.goals[:2] == 0).all()
    many = jax.vmap(lambda key: moved_goals(key, prompt).goals)(
        jax.random.split(jax.random.key(1), 2_000)
    )
    noise = np.asarray(many - prompt.goals)[:, 2:4, 0] / MOVED
    np.testing.assert_allclose(noise.std(axis=0), np.mean([1, 4, 9]) ** 0.5, rtol=0.1)
    sizes = np.abs(noise).max(axis=1)  # of three kinds of prompts, one is moved three times as far
    assert (sizes > 4).mean() > 0.05


def test_likeness_counts_goals_and_orders():
    one, two, three = jnp.eye(3)
    goal = jnp.ones(3)

    def made(*goals):
        return prompt_of(jnp.stack([*goals, goal]), 5)

    shared, in_order = alike(made(one, two), made(one, two))
    np.testing.assert_allclose(
        [shared, in_order], [3, 3], atol=0.2
    )  # the pairs with the task goal too
    shared, in_order = alike(made(one, two), made(two, one))
    np.testing.assert_allclose([shared, in_order], [3, 2], atol=0.2)
    assert likeness(made(one, two), made(one, two)) == pytest.approx(1, abs=1e-6)
    order = likeness(made(one, two), made(two, one))
    assert likeness(made(one), made(three)) < order < 1


CHANCY = SearchSpace(
    num_slots=4,
    horizon=5,
    return_range=(0.0, 1.0),
    num_episodes=8,
    sample_goal=lambda key: jnp.zeros(2),
    deterministic=False,
)
"""A search in a world in which one prompt has many returns."""


def test_a_posterior_is_that_of_a_gaussian_process():
    keys = jax.random.split(jax.random.key(0), 6)
    optimizer = plan_worth(CHANCY)
    state = optimizer.init(keys[0], jnp.ones(2))
    returns = [0.1, 0.9, 0.4, 0.7, 0.2]
    prompts = []
    for key, return_ in zip(keys[1:], returns, strict=True):
        prompt = prompt_of([*np.asarray(jax.random.uniform(key, (2, 2))), [1.0, 1.0]], 4)
        prompts.append(prompt)
        steps = Trajectory(
            jnp.zeros((5, 1)), jnp.zeros(5, jnp.int32), jnp.zeros((5, 2)),
            jnp.zeros(5, bool), jnp.zeros((5, 2)), jnp.int32(1),
        )  # fmt: skip
        episode = Episode(steps, jnp.zeros(5), jnp.float32(return_), jnp.zeros(1), jnp.zeros(2))
        state = optimizer.tell(state, Query(prompt, jnp.zeros((), bool)), episode)
    gram = np.array([[float(likeness(a, b)) for b in prompts] for a in prompts])
    spread = np.std(returns)
    between = (SHARE_OF_PROMPT * spread) ** 2
    inverse = np.linalg.inv(between * gram + spread**2 * np.eye(5))
    wanted = np.mean(returns) + between * gram @ inverse @ (returns - np.mean(returns))
    variance = between - np.diag(between * gram @ inverse @ gram * between)
    found = posterior(state, state.kernel)
    np.testing.assert_allclose(found.mean[:5], wanted, rtol=1e-4)
    np.testing.assert_allclose(found.std[:5] ** 2, variance, rtol=1e-3)
    best = optimizer.best(state)
    np.testing.assert_array_equal(best.goals, prompts[int(np.argmax(wanted))].goals)


@pytest.fixture
def candidates(monkeypatch):
    """16 candidates, and a function that sets the mean and deviation of the worth of some of them."""
    goals = jnp.arange(16.0 * 4 * 2).reshape(16, 4, 2)
    drawn = Prompt(goals, jnp.ones((16, 4), bool))
    monkeypatch.setattr(worths, "random_prompts", lambda *args: drawn)

    def believe(mean, std):
        rows = [jnp.zeros(16).at[jnp.array(list(of))].set(list(of.values())) for of in (mean, std)]
        monkeypatch.setattr(worths, "posterior", lambda state, kernel: Posterior(*rows))

    return drawn, believe


def test_the_candidate_with_the_largest_draw_is_run(candidates):
    """One of known worth, and as often one that may be worth more or less."""
    drawn, believe = candidates
    optimizer = plan_worth(CHANCY)
    state = optimizer.init(jax.random.key(0), jnp.ones(2))._replace(size=jnp.int32(1))
    keys = jax.random.split(jax.random.key(1), 64)

    def run():
        query = jax.jit(jax.vmap(lambda key: optimizer.ask(key, state)[0]))(keys)
        assert not query.greedy.any()
        same = (query.prompt.goals[:, None] == drawn.goals).all(axis=(2, 3))
        assert (same.sum(axis=1) == 1).all()
        return np.bincount(np.argmax(same, axis=1), minlength=16)

    believe({5: 1.0}, {5: 0.0})
    assert run()[5] == 64
    believe({5: 1.0}, {2: 100.0})
    assert run()[[2, 5]].sum() == 64
    assert 16 < run()[2] < 48
