"""Figure 9 in numbers: prompts of each length come from the best trajectories; short ones do not count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import prompt_lengths
from experiments.prompt_lengths import Length, as_table, best_goals, by_length, draw_prompts
from experiments.store.result_files import load_results
from experiments.store.results import Results
from experiments.store.statistics import SeedSpread
from mgpo_jax.judging import Uncertainty

PUBLISHED = Path("results/maze15/ucb").absolute()
NUM_TASKS = 3


@pytest.fixture(scope="module")
def results() -> Results:
    """The published searches on the first tasks."""
    whole = load_results(PUBLISHED)
    few = replace(
        whole,
        returns=whole.returns[:2, :NUM_TASKS],
        tasks={name: array[:NUM_TASKS] for name, array in whole.tasks.items()},
    )
    object.__setattr__(few, "reached_in", whole.reached_in)
    return few


def test_the_best_episode_of_each_search_is_taken(results: Results) -> None:
    found = best_goals(results)
    assert found.achieved_goals.shape == (2, NUM_TASKS, 64, 2)
    for seed, task in np.ndindex(2, NUM_TASKS):
        best = int(results.returns[seed, task].argmax())
        steps, goals = results.reached_in(seed, task, best)
        assert np.flatnonzero(found.goal_reached[seed, task]).tolist() == steps.tolist()
        np.testing.assert_array_equal(found.achieved_goals[seed, task, steps], goals)
        assert int(found.length[seed, task]) == steps[-1] + 1


def test_prompts_have_the_lengths_asked_for(results: Results) -> None:
    reached, goals = best_goals(results), jnp.asarray(results.task_goals)
    lengths = jnp.array([1, 3, 5])
    drawn = draw_prompts(jax.random.key(0), reached, goals, 5, lengths, 2)
    assert drawn.mask.shape == (3, 2, 2, NUM_TASKS, 5)
    num = np.asarray(drawn.mask).sum(axis=-1)
    assert (num <= np.array([1, 3, 5])[:, None, None, None]).all()
    assert (num[0] == 1).all()
    candidates = np.asarray(reached.goal_reached).sum(axis=2)
    assert (num[2] == 5)[:, candidates > 6].all()
    np.testing.assert_array_equal(
        np.asarray(drawn.goals)[..., -1, :],
        np.broadcast_to(results.task_goals, (3, 2, 2, NUM_TASKS, 2)),
    )


def test_prompts_that_are_too_short_do_not_count(
    results: Results, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One search reached a single goal: none of the long prompts is of its trajectory."""
    reached = best_goals(results)
    few = np.asarray(reached.goal_reached).copy()
    few[0, 0, 1:] = False
    monkeypatch.setattr(
        prompt_lengths,
        "best_goals",
        lambda results: reached._replace(goal_reached=jnp.asarray(few)),
    )

    def uncertainty(env, policy, tasks, query, *, seed):
        assert not np.asarray(query.greedy).any()  # in the paper, episodes are sampled
        num = query.prompt.mask.sum(axis=-1)
        return Uncertainty(1.0 / num, -num * 1.0, num)

    monkeypatch.setattr(prompt_lengths, "uncertainty", uncertainty)
    rows = by_length(results, num_draws=2)
    assert [row.num_goals for row in rows] == [1, 2, 3, 4, 5]
    assert [row.num_prompts for row in rows[2:]] == [2 * (2 * NUM_TASKS - 1)] * 3
    for row in rows:
        assert row.entropy == SeedSpread(pytest.approx(1 / row.num_goals), pytest.approx(0.0))
        assert row.return_ == -row.num_goals


def test_an_unknown_entropy_is_a_dash_with_the_reason() -> None:
    rows = [Length(1, 6, SeedSpread(0.5, 0.1), -1.5, 20.0), Length(2, 6, None, -1.0, 15.25)]
    text = as_table("nowhere", "mixture", rows)
    assert "| 1 | 6 | 0.500 ± 0.100 | -1.500 | 20.0 |" in text
    assert "| 2 | 6 | - | -1.000 | 15.2 |" in text
    assert "- The entropy of the head mixture has no closed form." in text
    assert "closed form" not in as_table("nowhere", "binned", rows[:1])
