"""The parts of a segment: they change when results are saved, and no result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from test_runner import MAZE, Point, tasks_of, untrained

from envs.base import Environment
from envs.registry import Judgement
from mgpo_jax import segments
from mgpo_jax.journal import Journal
from mgpo_jax.methods import UCB, Method, find
from mgpo_jax.outcomes import Outcome
from mgpo_jax.runner import sweep
from mgpo_jax.segments import Run, longest_part

EPISODES, EVERY = 10, 5
SAMPLED = Judgement(mode="sample", episodes=3)  # returns that vary


def run(
    env: Environment,
    journal: Journal | None = None,
    stop_at: float | None = None,
    method: Method = UCB,
    eval_every: int = EVERY,
) -> Outcome:
    (found,) = sweep(
        env, untrained(env), tasks_of(env), method, [method.hyper()], seeds=2, episodes=EPISODES,
        eval_every=eval_every, judged=SAMPLED, stop_at=stop_at, journal=journal,
    )  # fmt: skip
    return found


@pytest.fixture
def in_single_rounds(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """A function from whose call on every part has one round, and is saved however long that takes."""

    def shorten() -> None:
        monkeypatch.setattr(segments, "PART_SECONDS", 0.0)
        monkeypatch.setattr(segments, "SAVING_SHARE", np.inf)

    return shorten


def assert_same_bits(one: Outcome, other: Outcome) -> None:
    one, other = one._replace(cpu_seconds=0.0), other._replace(cpu_seconds=0.0)
    jax.tree.map(np.testing.assert_array_equal, one, other)


class Killed(Exception):
    """What ends a run here in place of a signal."""


class Fragile(Journal):
    """A journal whose process is killed before its ``last`` record is written."""

    def __init__(self, folder: Path, last: int) -> None:
        super().__init__(folder)
        self.left = last

    def write(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        self.left -= 1
        if self.left < 0:
            raise Killed
        super().write(name, arrays)


@pytest.mark.parametrize("env", [MAZE, Point()])
@pytest.mark.parametrize("early", [False, True])
def test_parts_of_one_round_change_no_bit(
    env: Environment,
    early: bool,
    in_single_rounds: Callable[[], None],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    stop_at = float(np.median(run(env).eval_returns)) if early else None
    monkeypatch.setattr(segments, "PART_SECONDS", np.inf)
    whole = run(env, Journal(tmp_path / "whole"), stop_at)
    in_single_rounds()
    parts = run(env, Journal(tmp_path / "parts"), stop_at)
    assert_same_bits(parts, whole)
    num = {name: len(list((tmp_path / name).glob("part*"))) for name in ("whole", "parts")}
    # The first round of all is a part of its own, since nothing is known of the speed before it.
    assert num == {"whole": 1 + 1 + EPISODES // EVERY, "parts": 1 + EPISODES}


def test_parts_of_a_method_with_several_episodes_in_a_round(
    in_single_rounds: Callable[[], None],
) -> None:
    def learned() -> Outcome:
        return run(MAZE, method=find("reinforce"), eval_every=EPISODES)

    whole = learned()
    in_single_rounds()
    assert_same_bits(learned(), whole)


@pytest.mark.parametrize("last", [0, 2, 5, 14])
@pytest.mark.parametrize("early", [False, True])
def test_a_run_that_is_killed_goes_on_within_a_segment(
    last: int, early: bool, in_single_rounds: Callable[[], None], tmp_path: Path
) -> None:
    """Each part writes two records, itself and the state after it; the kill comes before either."""
    stop_at = float(np.median(run(MAZE).eval_returns)) if early else None
    whole = run(MAZE, stop_at=stop_at)
    in_single_rounds()
    with pytest.raises(Killed):
        run(MAZE, Fragile(tmp_path / "pieces", last), stop_at)
    again = Fragile(tmp_path / "pieces", 1000)
    assert_same_bits(run(MAZE, again, stop_at), whole)
    num_new, num_finished = (1000 - again.left) // 2, last // 2
    assert num_new == 1 + EPISODES - num_finished


def test_parts_whose_saving_takes_long_are_saved_at_the_end_of_a_segment(
    in_single_rounds: Callable[[], None], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    whole = run(MAZE)
    in_single_rounds()
    monkeypatch.setattr(segments, "SAVING_SHARE", 0.0)
    # The first judgement and its state, the first five parts and the state after them, one more part.
    with pytest.raises(Killed):
        run(MAZE, Fragile(tmp_path / "pieces", 9))
    names = {path.stem for path in (tmp_path / "pieces").glob("*.npz")}
    assert names == {"state", *(f"part{index:06}" for index in range(7))}
    again = Fragile(tmp_path / "pieces", 1000)
    assert_same_bits(run(MAZE, again), whole)
    # The first part and its state, since nothing is known of how long saving takes; and the other four.
    assert 1000 - again.left == 2 + 5


@pytest.mark.parametrize(
    "damage", ["missing part", "missing state", "no number of parts", "another version"]
)
def test_a_journal_that_does_not_fit_is_not_used(
    damage: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = run(MAZE, Journal(tmp_path / "pieces"))
    journal = Journal(tmp_path / "pieces")
    if damage == "missing part":
        (tmp_path / "pieces" / "part000001.npz").unlink()
    elif damage == "missing state":
        (tmp_path / "pieces" / "state.npz").unlink()
    else:
        dropped = "parts" if damage == "no number of parts" else "leaf00000"
        state = journal.read("state")
        assert state is not None
        journal.write("state", {name: rows for name, rows in state.items() if name != dropped})
    assert_same_bits(run(MAZE, journal), whole)
    assert (tmp_path / "pieces" / "part000001.npz").exists()
    assert "it starts again" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("left", "seconds", "rounds"),
    [
        (0, None, 0),  # only a judgement
        (1, 1000.0, 1),
        (10, None, 1),  # nothing is known of the speed
        (10, 0.001, 10),
        (10, 15.0, 2),  # two rounds fit into half a minute
        (10, 7.0, 4),  # four fit; three parts of 4, 3 and 3 rather than 4, 4 and 2
        (6, 7.0, 3),
        (10, 1000.0, 1),
        (50, 0.0, 10),  # as many as the log has room for
        (12, 0.0, 6),
    ],
)
def test_a_part_lasts_about_half_a_minute(left: int, seconds: float | None, rounds: int) -> None:
    nothing: Any = None
    run = Run(nothing, nothing, nothing, [50], 10, nothing, nothing, 1, None)
    assert segments._part_rounds(run, left, seconds) == rounds


def test_a_log_has_room_for_the_longest_part_only() -> None:
    assert longest_part([2, 2, 1], 1 << 30) == 2
    assert longest_part([50, 50], 1 << 30) == segments.MIN_ROOM == 10
    assert longest_part([50, 20], 1 << 24) == segments.LOG_BYTES >> 24 == 16
    assert longest_part([50, 20], 1) == 50


def test_parts_keep_only_their_own_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """A view would keep the memory of all the rows that the log has room for."""
    kept: list[segments.Part] = []
    join = segments._record
    monkeypatch.setattr(segments, "_record", lambda done: kept.extend(done) or join(done))
    run(MAZE)
    for leaf in jax.tree.leaves([part.log for part in kept]):
        assert leaf.base is None or leaf.base.nbytes == leaf.nbytes
