"""The loop over the segments of an adaptation.

A segment is some rounds of all searches, followed by a judgement of their best choices. It is run in parts
of about half a minute, each of which is one call of a compiled program that runs all lanes
(``mgpo_jax.lanes``). Finished parts are saved in a journal, so that an interrupted run loses little.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool

from envs.base import is_key
from envs.errors import DataError
from mgpo_jax import processes
from mgpo_jax.adaptation import CHECK_RETURNS, AdaptLog, Judged
from mgpo_jax.journal import Journal
from mgpo_jax.lanes import Grid, Lanes, Layout
from mgpo_jax.outcomes import Part, Record, without_goals
from mgpo_jax.programs import Programs
from mgpo_jax.progress import Progress
from mgpo_jax.sharding import fetch, on_devices, split
from mgpo_jax.stopping import ended, filled
from mgpo_jax.trees import numbered_leaves, with_leaves

PART_SECONDS = 30.0
"""The wall time, in seconds, that a part should take; one round may take longer."""
MIN_ROOM, LOG_BYTES = 10, 1 << 28
"""The log of a part has room on the devices for at least ``MIN_ROOM`` rounds, and for more as long as they
take at most ``LOG_BYTES`` bytes."""
SAVING_SHARE = 0.05
"""The largest share of the time that saving may take within a segment. At its end everything is saved,
however long that takes."""


class Run(NamedTuple):
    """The inputs of an adaptation, ready to be run."""

    programs: Programs
    lanes: Lanes
    params: Any
    segments: Sequence[int]
    """Rounds between judgements; the first judgement comes before all of them."""
    max_rounds: int
    """Largest number of rounds in a part."""
    grid: Grid
    layout: Layout
    round_episodes: int
    """Number of episodes in a round of one lane."""
    stop_at: float | None
    """Judged return at which a search ends early; None if none does."""

    def without(self, stopped: np.ndarray) -> Lanes:
        """The lanes with the given ones marked as ended; lanes that pad the grid repeat its first ones."""
        index = self.grid.padded(self.layout)
        return self.lanes._replace(stopped=split(self.layout.mesh, jnp.asarray(stopped[index])))


def longest_part(segments: Sequence[int], round_bytes: int) -> int:
    """The largest number of rounds in a part of these segments, of which one leaves so many bytes."""
    return min(max(segments), max(MIN_ROOM, LOG_BYTES // round_bytes))


def run_segments(run: Run, journal: Journal) -> tuple[Record, float]:
    """Run all segments of an adaptation, except for the parts that the journal holds.

    Returns:
      The record of the run, and its CPU time in seconds without compilation.
    """
    programs, lanes, params, grid = run.programs, run.lanes, run.params, run.grid
    state = programs.start.compile(lanes, params)(lanes, params)
    # If the initial state holds NaN, the method uses NaN on purpose, and it is no sign of divergence.
    watched = (
        bool(_float_leaves(state.search)) and not _has_nan(state.search, run.layout.mesh).any()
    )
    shared = (params, jnp.int32(0), jnp.array(True), jnp.int32(0))
    advance = programs.advance.compile((state, lanes), shared)
    shapes = jax.eval_shape(programs.advance.jitted, (state, lanes), shared)
    done, state = _resumed(journal, run, state, shapes[1:])
    keeper = _Keeper(journal, grid, len(done))
    rounds, pace = [0, *run.segments], None
    per_round = run.round_episodes * grid.size
    with Progress(sum(rounds) * per_round, "episode", _num_rounds(done) * per_round) as progress:
        while (number := sum(part.ends_segment for part in done)) < len(rounds):
            before = _num_rounds(done)
            left = sum(rounds[: number + 1]) - before
            num = processes.from_first(lambda: _part_rounds(run, left, pace))  # noqa: B023
            stopped = np.zeros(grid.size, bool)
            if run.stop_at is not None and done:
                stopped = ended([part.judged for part in done], run.stop_at)
                lanes = run.without(stopped)
            cpu, wall = time.process_time(), time.monotonic()
            shared = (params, jnp.int32(num), jnp.array(num == left), jnp.int32(number))
            state, *results = advance((state, lanes), shared)
            log, judged = fetch(tuple(results))
            wall = time.monotonic() - wall
            cpu = processes.total(time.process_time() - cpu)
            # Judging alone says little: methods that learn spend most of their time on learning.
            pace = wall / num if num else None
            # Copied, since a view would keep the memory of all the rows that the log has room for.
            log = jax.tree.map(lambda rows, n=num: rows[: grid.size, :n].copy(), log)
            judged = jax.tree.map(lambda rows: rows[: grid.size], judged)
            part = _finished(Part(log, judged, num == left, cpu), done, stopped)
            _check_finite(part.log, part.judged, grid, before)
            if watched:
                _check_sound(state.search, run, before + num)
            done.append(part)
            keeper.keep(done, state)
            progress.update(num * per_round)
            progress.show({"return": f"{part.judged.return_.mean():.3f}"})
    return _record(done), sum(part.cpu_seconds for part in done)


def _finished(part: Part, before: Sequence[Part], stopped: np.ndarray) -> Part:
    """The part with the latest judgement, and with the results of stopped lanes filled in."""
    log, judged = part.log, part.judged if part.ends_segment else before[-1].judged
    if stopped.any():
        log, judged = filled(log, judged, stopped, [(one.log, one.judged) for one in before])
    return part._replace(log=log, judged=judged)


def _part_rounds(run: Run, left: int, pace: float | None) -> int:
    """The number of rounds in the next part.

    Args:
      run: the run.
      left: rounds that are left in the segment.
      pace: seconds that a round of all lanes took in the last part; None if it had no rounds.
    """
    if left <= 1:
        return left
    if pace is None:
        return 1
    fits = int(min(PART_SECONDS / max(pace, 1e-9), run.max_rounds))
    num_parts = -(-left // max(fits, 1))
    return -(-left // num_parts)  # parts of nearly equal length: 4, 3, 3 rather than 4, 4, 2


def _num_rounds(done: Sequence[Part]) -> int:
    """The number of rounds in finished parts."""
    return sum(part.log.returns.shape[1] for part in done)


def _record(done: Sequence[Part]) -> Record:
    """Join the results of all parts, of which the first has only a judgement."""
    logs = [part.log for part in done[1:]]
    whole = jax.tree.map(lambda *rows: np.concatenate(rows, axis=1), *map(without_goals, logs))
    judgements = [part.judged for part in done if part.ends_segment]
    judged = jax.tree.map(lambda *rows: np.stack(rows, axis=-1), *judgements)
    return Record(whole, judged, [log.played.goals for log in logs])


def _check_finite(log: AdaptLog, judged: Judged, grid: Grid, rounds_before: int) -> None:
    """Raise ``DataError`` for the first return that is not finite."""
    searched, judging = np.isfinite(log.returns), np.isfinite(judged.return_)
    if not searched.all():
        lane, index, episode = np.argwhere(~searched)[0]
        value, what = log.returns[lane, index, episode], f"round {rounds_before + index + 1}"
    elif not judging.all():
        lane = np.argmin(judging)
        value, what = judged.return_[lane], "an evaluation episode"
    else:
        return
    seed, task = grid.place(lane)
    raise DataError(
        f"the return of {what} on task {task} with seed number {seed} is {value}; {CHECK_RETURNS}"
    )


def _float_leaves(searches: Any) -> list[Array]:
    """The floating-point arrays in the states of searches."""
    leaves = jax.tree.leaves(searches)
    return [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]


def _has_nan(searches: Any, mesh: Mesh) -> np.ndarray:
    """Whether the state of each search holds NaN, bool [lanes]."""
    return fetch(_breaking(mesh)(_float_leaves(searches)))


@cache
def _breaking(mesh: Mesh) -> Any:
    """The compiled test for NaN: ``(arrays [lanes, ..]) -> bool [lanes]``."""

    def has_nan(leaves: list[Array]) -> Bool[Array, "lanes"]:
        found = [jnp.isnan(leaf).reshape(len(leaf), -1).any(axis=1) for leaf in leaves]
        return jnp.any(jnp.stack(found), axis=0)

    return on_devices(mesh, has_nan, [True], True)


def _check_sound(searches: Any, run: Run, rounds: int) -> None:
    """Raise ``DataError`` for the first search whose state holds NaN, such as weights that diverged."""
    grid = run.grid
    if (broken := _has_nan(searches, run.layout.mesh)[: grid.size]).any():
        seed, task = grid.place(int(np.argmax(broken)))
        raise DataError(
            f"the search on task {task} with seed number {seed} has diverged: what it learned holds NaN "
            f"after {rounds} rounds; lower its learning rate"
        )


class _Keeper:
    """Saves finished parts and the state after them, unless that would take too much of the time."""

    def __init__(self, journal: Journal, grid: Grid, num_kept: int) -> None:
        self.journal, self.grid, self.num_kept = journal, grid, num_kept
        self.saved_at, self.seconds = time.monotonic(), 0.0

    def keep(self, done: Sequence[Part], state: Any) -> None:
        """Save the parts that are not saved yet, and then the state from which the next part starts."""
        if not self.journal.keeps:
            return
        start = time.monotonic()
        due = self.seconds <= SAVING_SHARE * (start - self.saved_at)
        if not done[-1].ends_segment and not processes.from_first(lambda: due):
            return
        for index in range(self.num_kept, len(done)):
            self.journal.write(f"part{index:06}", numbered_leaves(done[index]))
        own = jax.tree.map(lambda rows: rows[: self.grid.size], fetch(state))
        self.journal.write("state", {**numbered_leaves(own), "parts": np.array(len(done))})
        self.num_kept, self.saved_at = len(done), time.monotonic()
        self.seconds = self.saved_at - start


def _resumed(
    journal: Journal, run: Run, state: Any, shapes: tuple[Any, Any]
) -> tuple[list[Part], Any]:
    """The finished parts in a journal, and the state after them.

    If a part is missing or of another form, the run starts again: no parts are returned, with the initial
    ``state``.
    """
    saved = journal.read("state")
    if saved is None:
        lost = journal.read("part000000") is not None
        return _anew("the saved state of the adaptation is lost" if lost else None, state)
    num_parts = int(saved.pop("parts", 0))  # older versions saved whole segments
    records = [journal.read(f"part{i:06}") for i in range(num_parts)]
    log, judged = jax.tree.map(lambda leaf: 0, shapes)
    like = Part(log, judged, ends_segment=False, cpu_seconds=0.0)
    found = [record for record in records if record is not None]
    if not num_parts or len(found) < num_parts:
        return _anew("the saved part of the adaptation is incomplete", state)
    try:
        done, kept = [with_leaves(like, record) for record in found], with_leaves(state, saved)
    except ValueError:
        return _anew("the saved part of the adaptation was written by another version", state)
    index = run.grid.padded(run.layout)

    def placed(rows: Any, like: Any) -> Any:
        rows = jnp.asarray(rows[index])
        return jax.random.wrap_key_data(rows) if is_key(like) else rows

    state = split(run.layout.mesh, jax.tree.map(placed, kept, state))
    return [
        part._replace(ends_segment=bool(part.ends_segment), cpu_seconds=float(part.cpu_seconds))
        for part in done
    ], state


def _anew(why: str | None, state: Any) -> tuple[list[Part], Any]:
    """No parts and the initial state, after a word on why what was saved cannot be used."""
    if why is not None and processes.is_first():
        print(f"{why}: it starts again", file=sys.stderr)
    return [], state
