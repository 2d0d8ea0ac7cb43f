"""GridWorld: handwritten episodes, and many more against the rules in plain Python."""

from __future__ import annotations

from functools import cache, partial
from itertools import permutations
from math import perm

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import envs
from envs.base import TimeStep
from envs.gridworld.env import EAST, FLIP, NORTH, SOUTH, STAY, WEST, GridState, GridTask, GridWorld

WORLD = envs.make("gridworld")
HORIZON = 90
NUM_STEPS = 96  # of every walk below, to beyond the horizon
NUM_TASKS = 13_650
NUM_WALKS = 400
# The numbers of the actions are their places here: west, north, east, south, none, flip.
ACTIONS = "WNES.F"
MOVES = ((0, -1), (-1, 0), (0, 1), (1, 0), (0, 0), (0, 0))
PLACES = ((9, 1), (8, 4), (1, 9), (3, 7), (3, 9), (6, 1), (8, 6))
MAP = """
    ..........
    .........2
    ..........
    .......3.4
    ..........
    ..........
    .5........
    ..........
    ....1.6...
    .0........
"""


class Oracle:
    """The rules of the world, one step at a time."""

    def __init__(self, start, order):
        self.cell, self.order = tuple(start), list(order)
        self.on, self.visited = set(), []
        self.num_paid = self.time = 0
        self.last = self._timestep()

    def ended(self) -> bool:
        return self.num_paid == len(self.order) or self.time == HORIZON

    def step(self, action: int) -> TimeStep:
        if self.ended():
            return self.last._replace(reward=0.0)
        reached = None
        self.time += 1
        if action == 5 and self.cell in PLACES:
            switched = PLACES.index(self.cell)
            self.on ^= {switched}
            if switched in self.on and switched not in self.visited:
                self.visited.append(switched)
                reached = switched
        row, column = (a + b for a, b in zip(self.cell, MOVES[action], strict=True))
        if 0 <= row < 10 and 0 <= column < 10:
            self.cell = row, column
        # Of the task's objects, those in front of the next one and that one itself, but no more.
        pays = self.on & set(self.order) == set(self.order[: self.num_paid + 1])
        self.num_paid += pays
        self.last = self._timestep(reached, pays / len(self.order))
        return self.last

    def _timestep(self, reached=None, reward=0.0) -> TimeStep:
        complete = self.num_paid == len(self.order)
        return TimeStep(
            obs=np.array([*multi_hot(self.on), *self.cell]),
            achieved_goal=multi_hot([] if reached is None else [reached]),
            goal_reached=reached is not None,
            outcome=multi_hot(self.visited),
            reward=reward,
            terminated=complete,
            truncated=self.time == HORIZON and not complete,
        )


def multi_hot(objects) -> np.ndarray:
    return np.isin(np.arange(7), list(objects)).astype(np.float32)


def padded(order) -> np.ndarray:
    return np.array([*order, *[-1] * (7 - len(order))], np.int32)


def walk(env, key, order, actions):
    """The time steps of the reset and after each action."""
    state, first = env.reset(key, GridTask(order))
    return first, jax.lax.scan(env.step, state, actions)[1]


walk_one = jax.jit(walk, static_argnums=0)
walk_many = jax.jit(jax.vmap(partial(walk, WORLD)))


@cache
def starts():
    """Many keys and the cells that they start from."""
    keys = jax.random.split(jax.random.key(5), 20_000)
    task = GridTask(jnp.asarray(padded([0, 1, 2])))
    first = jax.jit(jax.vmap(lambda key: WORLD.reset(key, task)[1]))(keys)
    return keys, np.asarray(first.obs[:, 7:]).astype(int)


@cache
def key_from(start: tuple[int, int]):
    """A key of an episode that starts there."""
    keys, cells = starts()
    return keys[int(np.flatnonzero((cells == start).all(axis=1))[0])]


def walk_from(start, order, actions):
    """A walk from this cell; filled up to one length so that it compiles once."""
    actions = np.array([*actions, *[4] * (NUM_STEPS - len(actions))], np.int32)
    return jax.tree.map(np.asarray, walk_one(WORLD, key_from(start), padded(order), actions))


def coded(actions: str) -> list[int]:
    return [ACTIONS.index(one) for one in actions]


def toward(cell, target) -> int | None:
    """The action of a shortest way, rows first; none at the target."""
    down, right = target[0] - cell[0], target[1] - cell[1]
    if down:
        return 3 if down > 0 else 1
    if right:
        return 2 if right > 0 else 0
    return None


def assert_same_episode(steps: TimeStep, expected: list[TimeStep]) -> None:
    for field in TimeStep._fields:
        rows = np.stack([getattr(timestep, field) for timestep in expected])
        np.testing.assert_allclose(getattr(steps, field), rows, atol=1e-6, err_msg=field)


def test_sizes():
    spec = WORLD.spec
    assert (spec.obs.shape, spec.goal_dim, spec.action_dim) == ((9,), 7, 6)
    assert spec.discrete
    assert spec.horizon == HORIZON
    assert spec.return_range == (0, 1)
    assert not spec.truncate_in_hindsight
    assert not spec.deterministic  # the start is random
    assert (WEST, NORTH, EAST, SOUTH, STAY, FLIP) == (0, 1, 2, 3, 4, 5)


def test_objects_are_where_the_map_has_them():
    """Flipping on every cell of the grid, one walk a row."""
    drawn = {
        (row, column): int(cell)
        for row, line in enumerate(MAP.split())
        for column, cell in enumerate(line)
        if cell != "."
    }
    assert [cell for cell, _ in sorted(drawn.items(), key=lambda item: item[1])] == list(PLACES)
    for row in range(10):
        start = (row, 0)
        _, steps = walk_from(start, [0, 1, 2, 3, 4, 5, 6], coded("FE" * 9 + "F"))
        flipped = {
            (row, time // 2): int(np.argmax(steps.achieved_goal[time]))
            for time in np.flatnonzero(steps.goal_reached)
        }
        assert flipped == {cell: index for cell, index in drawn.items() if cell[0] == row}


# One line a step: the action; then the objects that are on, row, column, whether a share of the reward
# was paid, the goal, and the goals visited so far.
IN_ORDER = """
    E  .......  3 7  0  -  .......
    F  ...3...  3 7  1  3  ...3...
    E  ...3...  3 8  0  -  ...3...
    .  ...3...  3 8  0  -  ...3...
    E  ...3...  3 9  0  -  ...3...
    F  ...34..  3 9  1  4  ...34..
    N  ...34..  2 9  0  -  ...34..
    F  ...34..  2 9  0  -  ...34..
    N  ...34..  1 9  0  -  ...34..
    F  ..234..  1 9  1  2  ..234..
"""
REVERSE_ORDER = """
    F  ..2....  1 9  0  2  ..2....
    S  ..2....  2 9  0  -  ..2....
    S  ..2....  3 9  0  -  ..2....
    F  ..2.4..  3 9  0  4  ..2.4..
    W  ..2.4..  3 8  0  -  ..2.4..
    W  ..2.4..  3 7  0  -  ..2.4..
    F  ..234..  3 7  0  3  ..234..
"""
# Object 2 comes last but is switched on second: 4 pays only when 2 is off again.
LATER_ONE_TOO_EARLY = """
    F  ...3...  3 7  1  3  ...3...
    E  ...3...  3 8  0  -  ...3...
    E  ...3...  3 9  0  -  ...3...
    N  ...3...  2 9  0  -  ...3...
    N  ...3...  1 9  0  -  ...3...
    F  ..23...  1 9  0  2  ..23...
    S  ..23...  2 9  0  -  ..23...
    S  ..23...  3 9  0  -  ..23...
    F  ..234..  3 9  0  4  ..234..
    N  ..234..  2 9  0  -  ..234..
    N  ..234..  1 9  0  -  ..234..
    F  ...34..  1 9  1  -  ..234..
    F  ..234..  1 9  1  -  ..234..
"""
# Object 3 pays once; without it 4 does not pay, and nobody pays for taking 4 back.
EARLIER_ONE_OFF = """
    F  ...3...  3 7  1  3  ...3...
    F  .......  3 7  0  -  ...3...
    F  ...3...  3 7  0  -  ...3...
    F  .......  3 7  0  -  ...3...
    E  .......  3 8  0  -  ...3...
    E  .......  3 9  0  -  ...3...
    F  ....4..  3 9  0  4  ...34..
    W  ....4..  3 8  0  -  ...34..
    W  ....4..  3 7  0  -  ...34..
    F  ...34..  3 7  1  -  ...34..
    E  ...34..  3 8  0  -  ...34..
    E  ...34..  3 9  0  -  ...34..
    F  ...3...  3 9  0  -  ...34..
    F  ...34..  3 9  0  -  ...34..
"""
# Object 5 is not of the task: it is a goal like others, but neither pays nor blocks.
ANOTHER_OBJECT = """
    F  .....5.  6 1  0  5  .....5.
    S  .....5.  7 1  0  -  .....5.
    S  .....5.  8 1  0  -  .....5.
    S  .....5.  9 1  0  -  .....5.
    F  0....5.  9 1  1  0  0....5.
    E  0....5.  9 2  0  -  0....5.
    E  0....5.  9 3  0  -  0....5.
    N  0....5.  8 3  0  -  0....5.
    E  0....5.  8 4  0  -  0....5.
    F  01...5.  8 4  1  1  01...5.
    E  01...5.  8 5  0  -  01...5.
    E  01...5.  8 6  0  -  01...5.
    F  01...56  8 6  1  6  01...56
"""
GOLDEN = {
    "in order": ((3, 6), [3, 4, 2], IN_ORDER, True),
    "in reverse order": ((1, 9), [3, 4, 2], REVERSE_ORDER, False),
    "a later one too early": ((3, 7), [3, 4, 2], LATER_ONE_TOO_EARLY, True),
    "an earlier one off": ((3, 7), [3, 4, 2, 0], EARLIER_ONE_OFF, False),
    "an object outside the task": ((6, 1), [0, 1, 6], ANOTHER_OBJECT, True),
    "that object in a longer task": ((6, 1), [0, 1, 6, 3], ANOTHER_OBJECT, False),
}


def drawn_objects(drawing: str) -> np.ndarray:
    return np.array([cell == str(place) for place, cell in enumerate(drawing)], float)


class TestGolden:
    @pytest.mark.parametrize("name", GOLDEN)
    def test_episode(self, name):
        start, order, table, completes = GOLDEN[name]
        lines = [line.split() for line in table.strip().splitlines()]
        first, steps = walk_from(start, order, coded("".join(line[0] for line in lines)))
        assert first.obs.tolist() == [0] * 7 + list(start)
        for time, (action, on, row, column, paid, goal, visited) in enumerate(lines):
            say = f"step {time}, {action}"
            obs = [*drawn_objects(on), int(row), int(column)]
            np.testing.assert_array_equal(steps.obs[time], obs, err_msg=say)
            assert steps.reward[time] == pytest.approx(int(paid) / len(order)), say
            assert steps.goal_reached[time] == (goal != "-"), say
            expected = multi_hot([] if goal == "-" else [int(goal)])
            np.testing.assert_array_equal(steps.achieved_goal[time], expected, err_msg=say)
            np.testing.assert_array_equal(steps.outcome[time], drawn_objects(visited), err_msg=say)
        num = len(lines)
        assert not steps.terminated[: num - 1].any()
        assert not steps.truncated[:num].any()
        assert steps.terminated[num - 1] == completes
        # And nothing is paid for doing nothing.
        assert (steps.reward[num:] == 0).all()

    @pytest.mark.parametrize("name", GOLDEN)
    def test_the_oracle_agrees(self, name):
        start, order, table, _ = GOLDEN[name]
        actions = coded("".join(line.split()[0] for line in table.strip().splitlines()))
        oracle = Oracle(start, order)
        expected = [oracle.step(action) for action in actions]
        _, steps = walk_from(start, order, actions)
        assert_same_episode(jax.tree.map(lambda rows: rows[: len(actions)], steps), expected)

    def test_reset(self):
        first, _ = walk_from((0, 9), [5, 4, 3, 2, 1], [])
        assert first.obs.tolist() == [0] * 7 + [0, 9]
        assert not first.goal_reached
        assert not first.terminated
        assert not first.truncated
        assert first.reward == 0
        assert (first.achieved_goal == 0).all()
        assert (first.outcome == 0).all()

    @pytest.mark.parametrize(
        ("start", "actions", "cells"),
        [
            ((0, 0), "WNES", [(0, 0), (0, 0), (0, 1), (1, 1)]),
            ((0, 9), "NEWS", [(0, 9), (0, 9), (0, 8), (1, 8)]),
            ((9, 0), "SWNE", [(9, 0), (9, 0), (8, 0), (8, 1)]),
            ((9, 9), "ESWN", [(9, 9), (9, 9), (9, 8), (8, 8)]),
            ((5, 5), ".F.F", [(5, 5)] * 4),
        ],
    )
    def test_the_grid_ends_at_its_border(self, start, actions, cells):
        _, steps = walk_from(start, [0, 1, 2], coded(actions))
        np.testing.assert_array_equal(steps.obs[:4, 7:], cells)
        assert (steps.obs[:, :7] == 0).all()

    def test_walking_over_objects_switches_none(self):
        _, steps = walk_from((3, 7), [3, 4, 2], coded("EENNSS.WW"))
        assert (steps.obs[:, :7] == 0).all()
        assert not steps.goal_reached.any()
        assert (steps.reward == 0).all()


class TestEnd:
    # 8 steps that solve the task (3, 4, 2) from (3, 6).
    WAY = "EFEEFNNF"

    def test_completion_terminates_and_absorbs(self):
        _, steps = walk_from((3, 6), [3, 4, 2], coded(self.WAY + "SSFWWF"))
        assert steps.terminated.tolist() == [False] * 7 + [True] * (NUM_STEPS - 7)
        assert not steps.truncated.any()
        assert steps.reward.sum() == pytest.approx(1)
        assert (steps.obs[7:] == [0, 0, 1, 1, 1, 0, 0, 1, 9]).all()
        assert (steps.outcome[7:] == multi_hot([2, 3, 4])).all()

    def test_completion_at_the_last_step_terminates(self):
        _, steps = walk_from((3, 6), [3, 4, 2], coded("." * 82 + self.WAY))
        assert steps.reward[89] == pytest.approx(1 / 3)
        assert steps.terminated.tolist() == [False] * 89 + [True] * 7
        assert not steps.truncated.any()

    def test_the_horizon_truncates_and_absorbs(self):
        """One step too late for the last object."""
        _, steps = walk_from((3, 6), [3, 4, 2], coded("." * 83 + self.WAY + "FFFF"))
        assert steps.truncated.tolist() == [False] * 89 + [True] * 7
        assert not steps.terminated.any()
        assert steps.reward.sum() == pytest.approx(2 / 3)
        assert (steps.obs[89:] == [0, 0, 0, 1, 1, 0, 0, 1, 9]).all()


def wander(rng: np.random.Generator, start, order):
    """Actions between the demonstrator's and random ones, and what the rules make of them."""
    oracle = Oracle(start, order)
    obedience, care = rng.choice([0.3, 0.6, 0.9, 1.0]), rng.choice([0.7, 0.9, 1.0])
    actions, expected, target = [], [], None
    while len(actions) < NUM_STEPS:
        if target is None:
            following = order[min(oracle.num_paid, len(order) - 1)]
            target = following if rng.random() < obedience else rng.integers(7)
        action = toward(oracle.cell, PLACES[target])
        if action is None:
            action, target = 5, None
        elif rng.random() > care:
            action = int(rng.integers(6))
        actions.append(action)
        expected.append(oracle.step(action))
    return actions, expected


@pytest.fixture(scope="module")
def walks():
    """Orders, what the world made of many walks, and what the rules say."""
    rng = np.random.default_rng(0)
    keys, cells = starts()
    orders = [rng.permutation(7)[: rng.integers(3, 8)].tolist() for _ in range(NUM_WALKS)]
    wanders = [wander(rng, *one) for one in zip(cells, orders, strict=False)]
    actions, expected = zip(*wanders, strict=True)
    rows = np.stack([padded(order) for order in orders])
    _, steps = walk_many(keys[:NUM_WALKS], rows, np.array(actions, np.int32))
    return orders, jax.tree.map(np.asarray, steps), expected


class TestOracle:
    def test_every_step_follows_the_rules(self, walks):
        _, steps, expected = walks
        for index, rows in enumerate(expected):
            assert_same_episode(jax.tree.map(lambda leaf, index=index: leaf[index], steps), rows)

    def test_returns_are_the_parts_that_were_done(self, walks):
        orders, steps, expected = walks
        rows = jnp.asarray(np.stack([padded(order) for order in orders]))
        parts = np.asarray(jax.vmap(WORLD.num_parts)(GridTask(rows)))
        np.testing.assert_array_equal(parts, [len(order) for order in orders])
        paid = [sum(step.reward > 0 for step in walk) for walk in expected]
        np.testing.assert_allclose(steps.reward.sum(axis=1) * parts, paid, atol=1e-4)
        assert len(set(paid)) == 8

    def test_everything_occurs_in_them(self, walks):
        """The comparison above sees each rule at work, and not only once."""
        orders, steps, _ = walks
        lengths = np.array([len(order) for order in orders])
        ended = steps.terminated[:, -1]
        assert set(lengths[ended]) == {3, 4, 5, 6, 7}
        assert 40 < ended.sum() < NUM_WALKS - 40
        assert (ended != steps.truncated[:, -1]).all()
        paid = steps.reward > 0
        assert paid.sum() > 500
        on = steps.obs[..., :7]
        change = np.diff(on, axis=1, prepend=0).sum(axis=2)
        for event in (
            paid & (change < 0),  # a later one was switched off again
            paid & (change > 0) & ~steps.goal_reached,  # one was switched on again
            (change > 0) & steps.goal_reached & ~paid,
            (change > 0) & ~steps.goal_reached & ~paid,
            (change < 0) & ~paid,
        ):
            assert event.sum() >= 10
        # Some complete the task with other objects on.
        others = on[ended, -1].sum(axis=1) - lengths[ended]
        assert (others > 0).sum() > 20


@settings(max_examples=100, deadline=None)
@given(
    start=st.tuples(st.integers(0, 9), st.integers(0, 9)),
    objects=st.permutations(range(7)),
    num_objects=st.integers(3, 7),
    plan=st.lists(
        st.one_of(
            st.sampled_from(range(6)),
            st.sampled_from(range(7)).map(lambda index: PLACES[index]),
        ),
        max_size=NUM_STEPS,
    ),
)
def test_returns_are_shares_of_one(start, objects, num_objects, plan):
    """Of any actions: single ones mixed with whole trips to an object and a flip there."""
    order = objects[:num_objects]
    oracle = Oracle(start, order)
    expected, actions = [], []

    def act(action):
        actions.append(action)
        expected.append(oracle.step(action))

    for item in plan:
        if isinstance(item, int):
            act(item)
        else:
            while (action := toward(oracle.cell, item)) is not None and not oracle.ended():
                act(action)
            act(5)
    actions, expected = actions[:NUM_STEPS], expected[:NUM_STEPS]
    _, steps = walk_from(start, order, actions)
    return_ = steps.reward.sum()
    assert 0 <= return_ <= 1 + 1e-6
    assert return_ * num_objects == pytest.approx(round(return_ * num_objects), abs=1e-5)
    assert (return_ > 1 - 1e-6) == steps.terminated[-1]
    # Each object is a goal once, and the outcome is their set.
    num = int(np.argmax(steps.terminated | steps.truncated)) + 1
    goals = steps.achieved_goal[:num][steps.goal_reached[:num]]
    np.testing.assert_array_equal(goals.sum(axis=0), steps.outcome[-1])
    assert (goals.sum(axis=1) == 1).all()
    if expected:
        assert_same_episode(jax.tree.map(lambda rows: rows[: len(expected)], steps), expected)


@pytest.fixture(scope="module")
def all_tasks():
    """Every ordered task, and a few that come round again."""
    indices = jnp.arange(NUM_TASKS + 10)
    orders = jax.jit(jax.vmap(WORLD.task))(indices).order
    return np.asarray(orders)


class TestTasks:
    def test_all_orders_once(self, all_tasks):
        assert WORLD.num_tasks == sum(perm(7, num) for num in range(3, 8)) == NUM_TASKS
        expected = {order for num in range(3, 8) for order in permutations(range(7), num)}
        found = [tuple(row[row >= 0].tolist()) for row in all_tasks[:NUM_TASKS]]
        assert len(found) == len(expected)
        assert set(found) == expected

    def test_all_are_valid(self, all_tasks):
        WORLD.check_task(GridTask(all_tasks))

    def test_they_come_round_again(self, all_tasks):
        np.testing.assert_array_equal(all_tasks[NUM_TASKS:], all_tasks[:10])

    def test_shorter_ones_come_first(self, all_tasks):
        lengths = (all_tasks[:NUM_TASKS] >= 0).sum(axis=1)
        assert (np.diff(lengths) >= 0).all()
        assert np.bincount(lengths).tolist() == [0, 0, 0, 210, 840, 2520, 5040, 5040]

    def test_the_goal_is_the_set_and_the_fingerprint_the_order(self, all_tasks):
        tasks = GridTask(jnp.asarray(all_tasks[:NUM_TASKS]))
        goals = np.asarray(jax.vmap(WORLD.task_goal)(tasks))
        for order, goal in zip(all_tasks[:NUM_TASKS:37], goals[::37], strict=True):
            assert goal.tolist() == multi_hot(order[order >= 0]).tolist()
        # 99 sets of 3 to 7 of the 7 objects.
        assert len(np.unique(goals, axis=0)) == 99
        prints = np.asarray(jax.vmap(WORLD.fingerprint)(tasks))
        assert len(np.unique(prints, axis=0)) == NUM_TASKS
        assert (np.asarray(jax.vmap(WORLD.optimal_return)(tasks)) == 1).all()

    def test_random_tasks_are_uniform(self):
        num = 20_000
        keys = jax.random.split(jax.random.key(0), num)
        order = np.asarray(jax.jit(jax.vmap(WORLD.sample_task))(keys).order)
        WORLD.check_task(GridTask(order[:1000]))
        counts = np.bincount((order >= 0).sum(axis=1))
        for length in range(3, 8):
            chance = perm(7, length) / NUM_TASKS
            assert abs(counts[length] - num * chance) < 4 * np.sqrt(num * chance), length
        # 20,000 draws with replacement leave a share of exp(-20000 / 13650) undrawn.
        drawn = len(np.unique(order, axis=0)) / NUM_TASKS
        assert drawn == pytest.approx(1 - np.exp(-num / NUM_TASKS), abs=0.01)

    def test_prompt_goals_are_single_objects(self):
        keys = jax.random.split(jax.random.key(0), 700)
        goals = np.asarray(jax.jit(jax.vmap(WORLD.sample_goal))(keys))
        assert set(np.unique(goals)) == {0, 1}
        assert (goals.sum(axis=1) == 1).all()
        assert (abs(goals.sum(axis=0) - 100) < 40).all()


def test_starts_are_uniform():
    """Every cell of the grid, objects' cells too, as often as chance has it."""
    _, cells = starts()
    counts = np.zeros((10, 10))
    np.add.at(counts, tuple(cells.T), 1)
    expected = len(cells) / 100
    assert (abs(counts - expected) < 4.5 * np.sqrt(expected)).all()
    # Chi-squared with 99 degrees of freedom: mean 99, standard deviation 14.
    assert 50 < ((counts - expected) ** 2 / expected).sum() < 160


class TestCheckTask:
    def good(self) -> np.ndarray:
        return np.array([[3, 4, 2, -1, -1, -1, -1], [6, 5, 4, 3, 2, 1, 0]])

    def test_accepts_good_tasks(self):
        WORLD.check_task(GridTask(self.good()))
        WORLD.check_task(GridTask(self.good().astype(np.int8)))
        WORLD.check_task(GridTask(jnp.asarray(self.good())))

    @pytest.mark.parametrize(
        ("row", "message"),
        [
            ([0, 1, 7, -1, -1, -1, -1], r"objects 0\.\.6, or -1 at the end"),
            ([0, 1, -2, -1, -1, -1, -1], r"objects 0\.\.6, or -1 at the end"),
            ([0, 1, -1, -1, -1, -1, -1], "task 1: 2 objects, an order has at least 3"),
            ([-1] * 7, "task 1: 0 objects, an order has at least 3"),
            ([0, -1, 1, 2, -1, -1, -1], "task 1: -1 may only fill the end of an order"),
            ([-1, -1, -1, -1, 0, 1, 2], "task 1: -1 may only fill the end of an order"),
            ([0, 1, 0, -1, -1, -1, -1], r"task 1: an object occurs twice in \[0, 1, 0\]"),
            ([0, 1, 2, 3, 4, 5, 5], r"task 1: an object occurs twice in \[0, 1, 2, 3, 4, 5, 5\]"),
        ],
    )
    def test_bad_orders(self, row, message):
        order = self.good()
        order[1] = row
        with pytest.raises(ValueError, match=message):
            WORLD.check_task(GridTask(order))

    def test_bad_shapes_and_types(self):
        order = self.good()
        for bad, message in (
            (order[0], r"order must have shape \[N, 7\] \(filled up with -1\), found \[7\]"),
            (order[:, :3], r"found \[2, 3\]"),
            (order[None], r"found \[1, 2, 7\]"),
            (order.astype(np.float32), "order must hold integers, found float32"),
            (order > 0, "order must hold integers, found bool"),
        ):
            with pytest.raises(ValueError, match=message):
                WORLD.check_task(GridTask(bad))


def test_the_horizon_is_a_setting():
    """A shorter world cuts where it says."""
    short = GridWorld(name="short", horizon=3)
    _, steps = walk_one(short, jax.random.key(0), padded([0, 1, 2]), np.full(5, STAY))
    assert steps.truncated.tolist() == [False, False, True, True, True]
    assert short.spec.horizon == 3


# From object 3 to object 4 and to object 2: two ways of 2 steps, and 3 flips.
SHORT_ORDER, SHORTEST = (3, 4, 2), [FLIP, EAST, EAST, FLIP, NORTH, NORTH, FLIP]


def test_orders_that_no_episode_has_room_for_are_refused():
    order = padded(SHORT_ORDER)
    exact, short = (GridWorld(name="short", horizon=horizon) for horizon in (7, 6))
    exact.check_solvable(GridTask(order[None]))
    short.check_task(GridTask(order[None]))  # an order all the same
    message = "task 0: the order takes at least 7 steps, an episode of short has 6"
    with pytest.raises(ValueError, match=message):
        short.check_solvable(GridTask(order[None]))
    assert [bool(env.solvable(GridTask(jnp.asarray(order)))) for env in (exact, short)] == [
        True,
        False,
    ]


@pytest.mark.parametrize(("horizon", "solved"), [(7, True), (6, False)])
def test_the_fewest_steps_are_enough_from_the_first_object(horizon, solved):
    env = GridWorld(name="short", horizon=horizon)
    state, timestep = env.reset(jax.random.key(0), GridTask(jnp.asarray(padded(SHORT_ORDER))))
    state = state._replace(position=jnp.array(PLACES[3]))
    for action in SHORTEST:
        state, timestep = env.step(state, jnp.int32(action))
    assert bool(timestep.terminated) == solved
    assert int(state.num_solved) == (3 if solved else 2)


def test_every_order_of_the_world_can_be_solved(all_tasks):
    assert np.asarray(jax.jit(jax.vmap(WORLD.solvable))(GridTask(jnp.asarray(all_tasks)))).all()


def test_the_expert_goes_for_the_next_object():
    """After the last object of the order it stays with that one."""
    nothing = GridState(*[None] * len(GridState._fields))
    state = nothing._replace(task=GridTask(jnp.asarray(padded((5, 2, 6)))))
    for solved, thing in ((0, 5), (1, 2), (2, 6), (3, 6)):
        goal = WORLD.expert_goal(state._replace(num_solved=jnp.int32(solved)), 10)
        np.testing.assert_array_equal(goal, np.eye(7)[thing])
