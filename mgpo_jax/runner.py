"""Adaptation to many tasks at once. All commands and examples that search for prompts use this module.

A run is divided into segments of rounds, each followed by a judgement of the best choice so far. All lanes
(``mgpo_jax.lanes``) run a segment together in one compiled program. Finished segments are saved in a
journal, so that an interrupted run can be resumed.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, PRNGKeyArray

from envs.base import Environment, Task
from envs.errors import DataError, UsageError
from envs.registry import Judgement, World
from envs.registry import find as find_world
from mgpo_jax import processes
from mgpo_jax.adaptation import (
    CHECK_RETURNS,
    Adapter,
    AdaptLog,
    Judged,
    proceed,
    start,
)
from mgpo_jax.journal import Journal
from mgpo_jax.lanes import Grid, Lanes, Layout, lay_out, over_lanes
from mgpo_jax.methods import Method, Setting, find, split_hyper, with_numbers
from mgpo_jax.outcomes import Outcome, Record, Segment, without_goals
from mgpo_jax.policy import LoadedPolicy, check_fits
from mgpo_jax.progress import Progress
from mgpo_jax.sharding import fetch, is_key, on_devices, replicate, split
from mgpo_jax.stopping import ended, filled
from mgpo_jax.tasks import num_tasks
from mgpo_jax.trees import numbered_leaves, with_leaves


def adapt(
    world: World | Environment | str,
    policy: LoadedPolicy,
    tasks: Task,
    method: Method | str = "ucb",
    hyper: Any = None,
    *,
    seeds: int = 3,
    episodes: int = 100,
    seed: int = 0,
    eval_every: int = 10,
    judged: Judgement | None = None,
    keep_actions: bool = False,
) -> Outcome:
    """Adapt a policy to every task, with several random seeds.

    Args:
      world: the world, as its record, its name, its place (``module:attribute``), or an environment.
      policy: the policy that every adaptation starts from.
      tasks: N tasks, stacked.
      method: the method that adapts, as a record or by name.
      hyper: the method's hyper-parameters, as an instance of its dataclass or as a dict of those that
        differ from the defaults. A world's record may change the defaults.
      seeds: number S of independent adaptations to each task.
      episodes: the budget of each adaptation, in episodes.
      seed: random seed of the whole run.
      eval_every: number of episodes between judgements of the best choice.
      judged: how the best choice is judged (default: as the world's record says; for an environment
        without a record, one greedy episode).
      keep_actions: whether to keep continuous actions; discrete ones are always kept.

    Raises:
      UsageError: if the method cannot be used in this setting.
    """
    method = find(method) if isinstance(method, str) else method
    if isinstance(world, str):
        world = find_world(world)
    if hyper is None or isinstance(hyper, dict):
        hyper = method.hyper_in(world if isinstance(world, World) else None, hyper or {})
    if isinstance(world, World):
        env, judged = world.make(), judged or world.judged
    else:
        env = world
    (outcome,) = sweep(
        env,
        policy,
        tasks,
        method,
        [hyper],
        seeds=seeds,
        episodes=episodes,
        seed=seed,
        eval_every=eval_every,
        judged=judged,
        keep_actions=keep_actions,
    )
    return outcome


def sweep(
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
    method: Method,
    hypers: Sequence[Any],
    *,
    seeds: int = 3,
    episodes: int = 100,
    seed: int = 0,
    eval_every: int = 10,
    judged: Judgement | None = None,
    keep_actions: bool = False,
    stop_at: float | None = None,
    journal: Journal | None = None,
    begin: Callable[[], object] = lambda: None,
) -> list[Outcome]:
    """Adapt in one compiled program; returns an outcome for each variant of the hyper-parameters.

    Args:
      env: the world.
      policy: the policy that every adaptation starts from.
      tasks: N tasks, stacked.
      method: the method that adapts.
      hypers: the variants of its hyper-parameters. All of them see the same tasks and random keys.
      seeds: number S of independent adaptations to each task.
      episodes: the budget of each adaptation, in episodes.
      seed: random seed of the whole run.
      eval_every: number of episodes between judgements of the best choice.
      judged: how the best choice is judged (default: one greedy episode).
      keep_actions: whether to keep continuous actions; discrete ones are always kept.
      stop_at: a search ends once its best choice is judged at this return or more (``stopping``). The
        episodes it did not need are recorded with no steps and the best return seen before.
      journal: saves finished segments; segments that it already holds are not run again.
      begin: called once, after all checks and before anything is compiled.

    Raises:
      UsageError: for a number below 1, no tasks, results that exceed the memory, or an unsuitable method.
      DataError: if the policy was trained for another world, or a return is not finite.
    """
    _check_positive(seeds=seeds, episodes=episodes, eval_every=eval_every)
    setting = _checked_setting(env, policy, method, hypers, episodes, judged)
    fixed, numbers = split_hyper(hypers)
    adapter = method.adapter(setting, policy.params, hypers[0])
    segments, num = _segments(adapter, episodes, eval_every), adapter.episodes_per_round
    grid = Grid(variants=len(hypers), seeds=seeds, tasks=num_tasks(tasks))
    _check_room(env, grid, episodes)
    begin()
    layout = lay_out(env, grid.size, _memory_bytes(env, adapter, tasks))
    program = _program(method, setting, fixed, layout, max(segments), keep_actions)
    lanes = grid.lanes(layout, tasks, seed, numbers, ends_early=stop_at is not None)
    lanes = split(layout.mesh, lanes)
    params = replicate(layout.mesh, policy.params)
    run = Run(program, lanes, params, segments, grid, layout, num * grid.size, stop_at)
    record, cpu = _run(run, journal or Journal())
    # The judgement of the initial choice is recorded at episode 1, since a search begins by evaluating it.
    after = np.concatenate([[1], np.cumsum(segments) * num])
    per_lane = episodes + (len(segments) + 1) * setting.judged.episodes
    total, cpu = seeds * grid.tasks * per_lane, cpu / grid.variants
    return [record.outcome(i, grid, after, total, cpu) for i in range(grid.variants)]


def _checked_setting(
    env: Environment,
    policy: LoadedPolicy,
    method: Method,
    hypers: Sequence[Any],
    episodes: int,
    judged: Judgement | None,
) -> Setting:
    """The setting that a method works in, after checks that policy, world and method fit together."""
    check_fits(policy.config, env.spec)
    setting = Setting(env, policy.config, episodes, judged or Judgement())
    for hyper in hypers:
        method.check_use(setting, hyper)
    return setting


def _check_positive(**numbers: int) -> None:
    """Raise ``UsageError`` for the first number that is below 1."""
    for name, value in numbers.items():
        if value < 1:
            raise UsageError(f"{name} must be at least 1, found {value}")


def _check_room(env: Environment, grid: Grid, episodes: int) -> None:
    """Raise ``UsageError`` if there are no tasks, or if the log would not fit into memory."""
    if not grid.size:
        raise UsageError("there are no tasks to adapt to")
    needed = log_bytes(env, grid.size, episodes)
    room = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > room:
        raise UsageError(
            f"{grid.size:,} adaptations of {episodes:,} episodes need {needed / 1e9:,.0f} GB of memory, "
            f"this machine has {room / 1e9:.0f} GB; adapt with fewer --seeds, --episodes or tasks at once"
        )


def log_bytes(env: Environment, num_lanes: int, episodes: int) -> int:
    """Upper bound of the bytes in the log of ``num_lanes`` adaptations, most of them goals and outcomes."""
    a_step = 2 * 4 * env.spec.goal_dim + 4
    return num_lanes * episodes * env.spec.horizon * a_step


def _segments(adapter: Adapter, episodes: int, eval_every: int) -> list[int]:
    """The number of rounds in each segment of the budget; the last segment may be shorter."""
    num = adapter.episodes_per_round
    if episodes % num or eval_every % num:
        raise UsageError(
            f"the method runs {num} episodes in a round: the budget of {episodes} episodes and the "
            f"{eval_every} episodes between evaluations must be multiples of {num}"
        )
    whole, rest = divmod(episodes, eval_every)
    return [eval_every // num] * whole + ([rest // num] if rest else [])


def _memory_bytes(env: Environment, adapter: Adapter, tasks: Task) -> int:
    """Bytes of an agent's memory (such as its KV cache) at the end of a full-length episode."""

    def memory(key: PRNGKeyArray, task: Task) -> Any:
        search = adapter.init(key, env.task_goal(task))
        # Of the same structure as what ``ask`` chooses, which takes far longer to trace.
        agent = adapter.agent(search, adapter.best(search))
        _, _, memory = agent.begin(key, task, *env.reset(key, task))
        return agent.grow(memory, env.spec.horizon - 1)

    task = jax.tree.map(lambda leaf: leaf[0], tasks)
    shapes = jax.eval_shape(memory, jax.random.key(0), task)
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))


class Program:
    """A jitted function that is compiled ahead of time, once for each set of argument shapes.

    Separate compilation keeps the compile time out of measured times.
    """

    def __init__(self, jitted: Any) -> None:
        self.jitted = jitted
        self._compiled: dict[Any, Any] = {}

    def compile(self, *args: Any) -> Any:
        """The compiled function for arguments of these shapes."""
        shapes, tree = jax.tree.flatten(jax.tree.map(jax.typeof, args))
        where = (tuple(shapes), tree)
        if where not in self._compiled:
            self._compiled[where] = self.jitted.lower(*args).compile()
        return self._compiled[where]


class Programs(NamedTuple):
    """The two programs of an adaptation."""

    start: Program
    """``(lanes, params) -> state``."""
    advance: Program
    """``((state, lanes), (params, number of rounds, index of the segment)) -> (state, log, judged)``."""


@cache
def _program(
    method: Method,
    setting: Setting,
    fixed: Any,
    layout: Layout,
    max_rounds: int,
    keep_actions: bool,
) -> Programs:
    """The programs of an adaptation; calls with equal arguments share them within a process."""
    env = setting.env

    def begin(own: Lanes, params: Any) -> Any:
        adapter = method.adapter(setting, params, with_numbers(fixed, own.numbers))
        return start(own.key, env, adapter, own.task)

    def advance(own: tuple[Any, Lanes], shared: tuple[Any, Array, Array]) -> Any:
        state, lane = own
        params, num_rounds, number = shared
        return proceed(
            state,
            env,
            method.adapter(setting, params, with_numbers(fixed, lane.numbers)),
            lane.task,
            num_rounds,
            max_rounds=max_rounds,
            judge_key=jax.random.fold_in(lane.key, number),
            num_judged=setting.judged.episodes,
            keep_actions=keep_actions,
            stopped=lane.stopped,
        )

    return Programs(
        Program(over_lanes(env, layout, begin)),
        Program(over_lanes(env, layout, advance)),
    )


class Run(NamedTuple):
    """The inputs of an adaptation, ready to be run."""

    programs: Programs
    lanes: Lanes
    params: Any
    segments: Sequence[int]
    """Rounds between judgements; the first judgement comes before all of them."""
    grid: Grid
    layout: Layout
    per_round: int
    """Number of episodes in a round, summed over the lanes of the grid."""
    stop_at: float | None
    """Judged return at which a search ends early; None if none does."""

    def without(self, stopped: np.ndarray) -> Lanes:
        """The lanes with the given ones marked as ended; lanes that pad the grid repeat its first ones."""
        index = np.arange(self.layout.num_lanes) % self.grid.size
        return self.lanes._replace(stopped=split(self.layout.mesh, jnp.asarray(stopped[index])))


def _run(run: Run, journal: Journal) -> tuple[Record, float]:
    """Run all segments of an adaptation, each followed by a judgement.

    Segments that the journal holds are not run again.

    Returns:
      The record of the run, and its CPU time in seconds without compilation.
    """
    programs, lanes, params, segments, grid, layout, per_round, stop_at = run
    state = programs.start.compile(lanes, params)(lanes, params)
    # If the initial state holds NaN, the method uses NaN on purpose, and it is no sign of divergence.
    watched = bool(_float_leaves(state.search)) and not _has_nan(state.search, layout.mesh).any()
    shared = (params, jnp.int32(0), jnp.int32(0))
    advance = programs.advance.compile((state, lanes), shared)
    done: list[Segment] = []
    if (saved := journal.read("state")) is not None:
        shapes = jax.eval_shape(programs.advance.jitted, (state, lanes), shared)
        done, state = _resumed(journal, saved, grid, layout, state, shapes[1:])
    rounds = [0, *segments]
    before = sum(rounds[: len(done)])
    with Progress(sum(rounds) * per_round, "episode", before * per_round) as progress:
        for number in range(len(done), len(rounds)):
            num = rounds[number]
            stopped = np.zeros(grid.size, bool)
            if stop_at is not None and done:
                stopped = ended([segment.judged for segment in done], stop_at)
                lanes = run.without(stopped)
            cpu = time.process_time()
            shared = (params, jnp.int32(num), jnp.int32(number))
            state, log, judged = advance((state, lanes), shared)
            log, judged = fetch((log, judged))
            cpu = processes.total(time.process_time() - cpu)
            log = jax.tree.map(lambda rows, n=num: rows[: grid.size, :n], log)
            judged = jax.tree.map(lambda rows: rows[: grid.size], judged)
            if stopped.any():
                log, judged = filled(log, judged, stopped, [(s.log, s.judged) for s in done])
            _check_finite(log, judged, grid, before)
            if watched:
                _check_sound(state.search, run, before + num)
            done.append(Segment(log, judged, cpu))
            _save_segment(journal, number, done[-1], state, grid)
            progress.update(num * per_round)
            progress.show({"return": f"{judged.return_.mean():.3f}"})
            before += num
    logs = [segment.log for segment in done[1:]]
    goals = [log.played.goals for log in logs]
    whole = jax.tree.map(lambda *rows: np.concatenate(rows, axis=1), *map(without_goals, logs))
    judged = jax.tree.map(lambda *rows: np.stack(rows, axis=-1), *(s.judged for s in done))
    return Record(whole, judged, goals), sum(segment.cpu_seconds for segment in done)


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
    seed, task = divmod(int(lane) % (grid.seeds * grid.tasks), grid.tasks)
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
        seed, task = divmod(int(np.argmax(broken)) % (grid.seeds * grid.tasks), grid.tasks)
        raise DataError(
            f"the search on task {task} with seed number {seed} has diverged: what it learned holds NaN "
            f"after {rounds} rounds; lower its learning rate"
        )


def _save_segment(journal: Journal, number: int, segment: Segment, state: Any, grid: Grid) -> None:
    """Write a finished segment to the journal, and then the state from which the next segment starts."""
    if not journal.keeps:
        return
    journal.write(f"segment{number:04}", numbered_leaves(segment))
    own = jax.tree.map(lambda rows: rows[: grid.size], fetch(state))
    journal.write("state", {**numbered_leaves(own), "segments": np.array(number + 1)})


def _resumed(
    journal: Journal,
    saved: dict[str, np.ndarray],
    grid: Grid,
    layout: Layout,
    state: Any,
    shapes: tuple[Any, Any],
) -> tuple[list[Segment], Any]:
    """The finished segments in a journal, and the state after them.

    If any segment is missing, the run starts again: no segments are returned, with the initial ``state``.
    """
    records = [journal.read(f"segment{i:04}") for i in range(int(saved.pop("segments")))]
    like = Segment(*jax.tree.map(lambda leaf: 0, shapes), cpu_seconds=0.0)
    done = [with_leaves(like, record) for record in records if record is not None]
    if len(done) < len(records):
        return [], state
    # The lanes that pad the grid repeat its first ones.
    index = np.arange(layout.num_lanes) % grid.size

    def placed(rows: Any, like: Any) -> Any:
        rows = jnp.asarray(rows[index])
        return jax.random.wrap_key_data(rows) if is_key(like) else rows

    state = split(layout.mesh, jax.tree.map(placed, with_leaves(state, saved), state))
    return [s._replace(cpu_seconds=float(s.cpu_seconds)) for s in done], state
