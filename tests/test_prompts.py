"""The prompt sampler: order, alignment, candidates and distribution."""

from __future__ import annotations

from itertools import combinations, permutations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from envs.base import Trajectory
from mgpo_jax.prompts import hindsight_outcome, sample_prompt, single_goal, until_reached

NUM_STEPS = 9
NUM_SLOTS = 4
FINAL = jnp.array([-7.0, -8.0])


def make_trajectory(reached, length, ends_at_goal=False):
    """Step t reaches goal (t + 1, 100 + t), so a goal names its step; padding is NaN."""
    reached = np.asarray(reached)
    num_steps = len(reached)
    time = np.arange(num_steps)
    goals = np.stack([time + 1, time + 100], axis=1).astype(np.float32)
    goals[length:] = np.nan
    outcomes = goals.copy() if ends_at_goal else goals + 0.5
    return Trajectory(
        obs=jnp.zeros((num_steps, 3)),
        actions=jnp.zeros(num_steps, jnp.int32),
        achieved_goals=jnp.asarray(goals),
        goal_reached=jnp.asarray(reached),
        outcomes=jnp.asarray(outcomes),
        length=jnp.int32(length),
    )


@jax.jit
def draw(seed, trajectory, max_goals):
    key = jax.random.key(seed)
    return sample_prompt(key, trajectory, FINAL, NUM_SLOTS, max_goals)


@jax.jit
def draw_many(seed, trajectory, max_goals):
    keys = jax.random.split(jax.random.key(seed), 6000)
    return jax.vmap(lambda k: sample_prompt(k, trajectory, FINAL, NUM_SLOTS, max_goals))(keys)


@settings(max_examples=150, deadline=None)
@given(
    reached=st.lists(st.booleans(), min_size=NUM_STEPS, max_size=NUM_STEPS),
    length=st.integers(1, NUM_STEPS),
    max_goals=st.integers(1, NUM_SLOTS),
    ends_at_goal=st.booleans(),
    seed=st.integers(0, 2**31 - 1),
)
def test_every_prompt_is_an_ordered_choice_of_reached_goals(
    reached, length, max_goals, ends_at_goal, seed
):
    trajectory = make_trajectory(reached, length, ends_at_goal)
    prompt = draw(seed, trajectory, jnp.int32(max_goals))
    goals, mask = np.asarray(prompt.goals), np.asarray(prompt.mask)

    count = int(mask.sum())
    assert 1 <= count <= max_goals
    np.testing.assert_array_equal(mask, np.arange(NUM_SLOTS) >= NUM_SLOTS - count)
    assert not goals[~mask].any()
    np.testing.assert_array_equal(goals[-1], FINAL)

    steps = goals[mask][:-1, 0].astype(int) - 1
    np.testing.assert_array_equal(goals[mask][:-1, 1], steps + 100)
    assert (np.diff(steps) > 0).all()
    last = length - 1 if ends_at_goal else length
    eligible = {t for t in range(last) if reached[t]}
    assert set(steps) <= eligible


@pytest.mark.parametrize("max_goals", [1, 2, 4])
def test_length_is_uniform_when_there_are_enough_goals(max_goals):
    trajectory = make_trajectory([True] * NUM_STEPS, NUM_STEPS)
    lengths = np.asarray(draw_many(1, trajectory, jnp.int32(max_goals)).mask.sum(axis=1))
    counts = np.bincount(lengths, minlength=max_goals + 1)[1:]
    assert len(counts) == max_goals
    assert max_goals == 1 or stats.chisquare(counts).pvalue > 1e-3


def test_length_is_clipped_to_the_goals_there_are():
    reached = np.zeros(NUM_STEPS, bool)
    reached[2] = True
    trajectory = make_trajectory(reached, NUM_STEPS)
    lengths = np.asarray(draw_many(2, trajectory, jnp.int32(4)).mask.sum(axis=1))
    counts = np.bincount(lengths, minlength=5)[1:]
    # Draws of 1, 2 and 3 waypoints all become the one there is.
    assert counts[2] == counts[3] == 0
    assert stats.chisquare(counts[:2], np.array([0.25, 0.75]) * counts.sum()).pvalue > 1e-3


def test_every_subset_of_steps_is_equally_likely():
    reached = np.array([1, 0, 1, 1, 0, 0, 1, 1, 1], bool)
    trajectory = make_trajectory(reached, 7)
    prompt = draw_many(3, trajectory, jnp.int32(3))
    pairs = np.asarray(prompt.goals)[np.asarray(prompt.mask.sum(axis=1)) == 3]
    steps = [tuple(row) for row in (pairs[:, 1:3, 0] - 1).astype(int).tolist()]
    expected = list(combinations([0, 2, 3, 6], 2))
    counts = [steps.count(pair) for pair in expected]
    assert sum(counts) == len(steps)
    assert stats.chisquare(counts).pvalue > 1e-3


def test_max_goals_may_differ_from_lane_to_lane():
    trajectory = make_trajectory([True] * NUM_STEPS, NUM_STEPS)
    max_goals = jnp.arange(1, NUM_SLOTS + 1)
    prompts = jax.vmap(lambda k: draw_many(4, trajectory, k))(max_goals)
    longest = np.asarray(prompts.mask.sum(axis=-1).max(axis=1))
    np.testing.assert_array_equal(longest, max_goals)


@pytest.mark.parametrize(("ends_at_goal", "available"), [(True, {1, 2, 3}), (False, {1, 2, 3, 4})])
def test_the_step_that_reaches_the_outcome_is_no_waypoint(ends_at_goal, available):
    trajectory = make_trajectory([True] * NUM_STEPS, 4, ends_at_goal)
    prompt = draw_many(5, trajectory, jnp.int32(4))
    waypoints = np.asarray(prompt.goals)[:, :-1, 0][np.asarray(prompt.mask)[:, :-1]]
    assert set(waypoints.astype(int)) == available


def test_one_step_that_reaches_the_outcome_gives_the_single_goal():
    trajectory = make_trajectory([True] * NUM_STEPS, 1, ends_at_goal=True)
    goal = hindsight_outcome(trajectory)
    prompt = sample_prompt(jax.random.key(0), trajectory, goal, NUM_SLOTS)
    expected = single_goal(goal, NUM_SLOTS)
    np.testing.assert_array_equal(prompt.goals, expected.goals)
    np.testing.assert_array_equal(prompt.mask, expected.mask)


def test_more_slots_than_steps():
    trajectory = make_trajectory([True, True], 2)
    prompts = jax.vmap(lambda k: sample_prompt(k, trajectory, FINAL, 6))(
        jax.random.split(jax.random.key(1), 50)
    )
    assert prompts.goals.shape == (50, 6, 2)
    assert set(np.asarray(prompts.mask.sum(axis=1))) == {1, 2, 3}
    assert not np.asarray(prompts.mask[:, :3]).any()


def test_single_goal_fills_the_last_slot():
    prompt = single_goal(jnp.array([3.0, 4.0]), 3)
    np.testing.assert_array_equal(prompt.goals, [[0, 0], [0, 0], [3, 4]])
    np.testing.assert_array_equal(prompt.mask, [False, False, True])


def test_hindsight_outcome_is_read_at_the_last_real_step():
    trajectory = make_trajectory([True] * NUM_STEPS, 5)
    np.testing.assert_array_equal(hindsight_outcome(trajectory), [5.5, 104.5])


@jax.jit
def draw_kept(seed, trajectory, max_goals, kept):
    keys = jax.random.split(jax.random.key(seed), 600)
    return jax.vmap(lambda k: sample_prompt(k, trajectory, FINAL, NUM_SLOTS, max_goals, kept))(keys)


@pytest.mark.parametrize(
    ("kept", "max_goals", "always", "sizes"),
    [
        ([], 4, [], {1, 2, 3, 4}),
        ([2], 4, [2], {2, 3, 4}),
        ([2, 5], 4, [2, 5], {3, 4}),
        ([2, 5], 3, [2, 5], {3}),
        ([1, 2, 5, 6], 4, [1, 2, 5], {4}),  # no room for all: the first ones
        ([2, 5], 1, [], {1}),
        ([0, 8], 4, [], {1, 2, 3, 4}),  # not reached, and beyond the end
    ],
)
def test_kept_goals_are_in_every_prompt(kept, max_goals, always, sizes):
    trajectory = make_trajectory([False, *[True] * (NUM_STEPS - 1)], length=8)
    drawn = draw_kept(
        0, trajectory, max_goals, jnp.isin(jnp.arange(NUM_STEPS), jnp.array(kept, int))
    )
    steps = np.where(np.asarray(drawn.mask), np.asarray(drawn.goals)[..., 0] - 1, np.nan)
    kept_here = [step for step in kept if 0 < step < 8]
    assert set(np.asarray(drawn.mask).sum(axis=1).tolist()) == sizes
    for row in steps:
        named = row[np.isfinite(row)][:-1]
        assert set(always) <= set(named.tolist())
        settled = named[named <= max(kept_here, default=-1)]
        np.testing.assert_array_equal(named[: len(settled)], np.sort(settled))
    # The other goals are as likely as each other.
    others = [step for step in range(1, 8) if step not in always]
    counts = [(steps == step).sum() for step in others]
    assert max(counts) < 1.5 * max(min(counts), 1)


def test_goals_after_the_last_kept_one_come_in_any_order():
    trajectory = make_trajectory([True] * NUM_STEPS, length=6)
    drawn = draw_kept(3, trajectory, NUM_SLOTS, jnp.arange(NUM_STEPS) == 2)
    rows = np.where(np.asarray(drawn.mask), np.asarray(drawn.goals)[..., 0] - 1, np.nan)[:, :-1]
    rows = [tuple(row[np.isfinite(row)].astype(int)) for row in rows]
    assert {row[row.index(2) + 1 :] for row in rows} == {
        after for size in range(NUM_SLOTS - 1) for after in permutations((3, 4, 5), size)
    }
    assert {row[: row.index(2)] for row in rows} == {(), (0,), (1,), (0, 1)}


def test_a_trajectory_ends_where_it_reaches_the_goal():
    trajectory = make_trajectory([True] * NUM_STEPS, length=7)
    for step, length in ((0, 1), (3, 4), (6, 7), (7, 7)):  # step 7 is padding
        goal = jnp.array([step + 1.5, step + 100.5])
        assert int(until_reached(trajectory.goals, goal).length) == length
    cut = until_reached(trajectory.goals, jnp.array([4.5, 103.5]))
    drawn = draw_many(0, cut, NUM_SLOTS)
    assert np.nanmax(np.where(drawn.mask[:, :-1], drawn.goals[:, :-1, 0], np.nan)) == 4
