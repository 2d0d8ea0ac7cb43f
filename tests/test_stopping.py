"""``--stop-at``: a stopped search has the same episodes until its end, and none after it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_runner import MAZE, Point, tasks_of, untrained

from envs.registry import WORLDS, Judgement, World
from experiments.store.result_files import load_results, save_results
from experiments.store.results import results_of
from experiments.store.summary import summarize
from experiments.store.summary_text import printed
from mgpo_jax.methods import UCB
from mgpo_jax.runner import sweep

EPISODES, EVERY = 9, 3
SAMPLED = Judgement(mode="sample", episodes=3)  # returns that vary


def run(env, stop_at):
    (found,) = sweep(
        env, untrained(env), tasks_of(env), UCB, [UCB.hyper()], seeds=2, episodes=EPISODES,
        eval_every=EVERY, judged=SAMPLED, stop_at=stop_at,
    )  # fmt: skip
    return found


def stops(outcome, stop_at):
    """[S, N]: the judgement at which each search ends, or that after its last episode."""
    enough = outcome.eval_returns >= stop_at
    return np.where(enough.any(-1), enough.argmax(-1), enough.shape[-1] - 1)


@pytest.mark.optimized
@pytest.mark.parametrize("env", [MAZE, Point()])
def test_a_search_that_ends_early_is_the_same_until_then(env):
    whole = run(env, None)
    values = np.unique(whole.eval_returns)
    assert len(values) > 2, values
    stop_at = float(values[len(values) // 2])
    early = run(env, stop_at)
    last = stops(whole, stop_at)
    assert 0 < (last < whole.eval_returns.shape[-1] - 1).sum() < last.size
    for place in np.ndindex(last.shape):
        used = 0 if last[place] == 0 else EVERY * last[place]
        np.testing.assert_array_equal(early.returns[place][:used], whole.returns[place][:used])
        np.testing.assert_array_equal(early.lengths[place][:used], whole.lengths[place][:used])
        assert (early.lengths[place][used:] == 0).all()
        best = whole.returns[place][:used].max() if used else whole.eval_returns[place][0]
        np.testing.assert_array_equal(early.returns[place][used:], best)
        kept = np.minimum(np.arange(whole.eval_returns.shape[-1]), last[place])
        np.testing.assert_array_equal(early.eval_returns[place], whole.eval_returns[place][kept])
        assert early.actions is None or (early.actions[place][used:] == 255).all()


def test_what_is_never_reached_ends_nothing():
    whole, same = run(MAZE, None), run(MAZE, 1e6)
    np.testing.assert_array_equal(whole.returns, same.returns)
    np.testing.assert_array_equal(whole.eval_returns, same.eval_returns)


def test_saved_episodes_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(
        WORLDS._registered, "tiny", World(name="tiny", make=lambda: MAZE, judged=SAMPLED)
    )
    stop_at = float(np.median(run(MAZE, None).eval_returns[:, :, 1:]))
    outcome = run(MAZE, stop_at)
    settings = {"env": "tiny", "method": "ucb", "stop_at": stop_at}
    tasks = tasks_of(MAZE)
    results = results_of(outcome, settings, MAZE, tasks, np.ones(3))
    used = EVERY * stops(outcome, stop_at)
    np.testing.assert_array_equal(results.episodes_used, used)
    summary = summarize(
        results, policy_sha256="0" * 64, num_episodes=1, num_failed=0, cpu_seconds=1.0
    )
    assert summary["episodes_used"] == used.mean() < EPISODES
    assert f"{used.mean():.1f} in a search" in printed(summary)
    save_results(tmp_path / "run", replace(results, summary=summary))
    assert load_results(tmp_path / "run").summary["episodes_used"] == used.mean()
