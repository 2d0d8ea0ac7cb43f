"""Runs many episodes and adaptations at once. Everything that commands and examples run goes through here.

Every task, seed and variant of a method is a *lane* of one compiled program. Lanes are spread over the
devices of all processes that work together and, on each, run in *groups*: the lanes of a group share one
clock, so that a group's episode ends with its slowest lane. On a CPU a group is as large as the memories of
its agents fit into the cache near a core, or as large as a step of the world needs to be worth its call.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import Environment, Episode, Goals, Task
from envs.errors import DataError, NotAvailableError, UsageError
from envs.registry import Judgement, World
from envs.registry import find as find_world
from mgpo_jax import processes
from mgpo_jax.adaptation import (
    Adapter,
    AdaptLog,
    Judged,
    achieved_goals,
    judge,
    proceed,
    start,
)
from mgpo_jax.journal import Journal
from mgpo_jax.methods import Method, Setting, find, split_hyper, with_numbers
from mgpo_jax.policy import LoadedPolicy, check_fits, transformer_policy
from mgpo_jax.progress import Progress
from mgpo_jax.rollout import Query, rollout
from mgpo_jax.sharding import fetch, is_key, mesh_of_all, on_devices, replicate, split
from mgpo_jax.stopping import ended, filled
from mgpo_jax.tasks import num_tasks
from mgpo_jax.transformer import GoalTransformer, TransformerConfig
from mgpo_jax.trees import numbered_leaves, with_leaves

# Bytes of the agents' memories (key-value caches) in a group: what fits into the cache of a CPU's core, or
# into the memory of an accelerator.
GROUP_BYTES, GROUP_BYTES_ACCELERATOR = 3 << 20, 4 << 30


class Reached(NamedTuple):
    """The goals that episodes reached, of all episodes one after another."""

    counts: np.ndarray
    """``[S, N, E]``: how many goals each episode reached."""
    steps: np.ndarray
    """``[total]``: in which step each was reached, counted from 0."""
    goals: np.ndarray
    """``[total, G]``."""


class Outcome(NamedTuple):
    """Raw results of one method, axes S seeds, N tasks, E episodes, R rounds, C judgements."""

    returns: np.ndarray
    """``[S, N, E]`` returns of the search's episodes."""
    failed: np.ndarray
    """``[S, N, E]``: whether the world broke down."""
    choices: Any
    """Who acted, leaves ``[S, N, R, ..]``."""
    best: Any
    """The best choice after each round, leaves ``[S, N, R, ..]``."""
    lengths: np.ndarray
    """``[S, N, E]``: steps of the episodes."""
    keys: np.ndarray
    """``[S, N, E, 2]``: raw random keys of the episodes."""
    actions: np.ndarray | None
    """``[S, N, E, T]`` small integers (``adaptation.small_actions``); None if they were not kept."""
    reached: Reached
    eval_episodes: np.ndarray
    """``[C]``: after how many episodes the best choice was judged."""
    eval_returns: np.ndarray
    """``[S, N, C]``: mean return of the judging episodes. The first is that of the initial choice."""
    num_episodes: int
    """All episodes that were run: those of the search and those that judged."""
    num_failed: int
    """Those that the world ended because it broke down."""
    cpu_seconds: float
    """CPU time of all of them, without compilation."""
    eval_achieved: np.ndarray | None = None
    """``[S, N, C, M]``: share of the judging episodes that achieved each of the world's M named goals; None
    in worlds without any (``Environment.goal_names``)."""
    num_scored: np.ndarray | None = None
    """``[S, N, R]``: prompts scored without an episode until the end of each round; None for methods that
    learn by episodes alone."""


def together(env: Environment, function: Callable, in_axes: Any = 0) -> Any:
    """A compiled ``function`` over many episodes, which share one clock on one device."""
    options = dict(env.engine.compiler_options)
    return jax.jit(jax.vmap(function, in_axes=in_axes), compiler_options=options)


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
    """Adapt a policy to every task with every seed.

    Args:
      world: the world, as its record, its name or place, or as an environment.
      policy: who starts.
      tasks: N tasks, stacked.
      method: who adapts, as a record or by name.
      hyper: the method's hyper-parameters, as its record or as a dict of those that differ from the
        defaults, which a world's record may change.
      seeds: independent adaptations to each task.
      episodes: the budget of each.
      seed: seed of all of them.
      eval_every: episodes between judgements of the best choice.
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
    """One outcome for each variant of a method's hyper-parameters, all from one program.

    Args:
      env: the world.
      policy: who starts.
      tasks: N tasks, stacked.
      method: who adapts.
      hypers: the variants, which see the same tasks and random keys and share one program.
      seeds: independent adaptations to each task.
      episodes: the budget of each.
      seed: seed of all of them.
      eval_every: episodes between judgements of the best choice.
      judged: how the best choice is judged (default: one greedy episode).
      keep_actions: whether to keep continuous actions; discrete ones are always kept.
      stop_at: a search ends when its best choice is judged at this return or more (``stopping``); the
        episodes that it did not need have the best return that it had seen, and no steps.
      journal: where finished segments are kept; those that it holds are not run again.
      begin: called once, when everything was found right and before anything is compiled.

    Raises:
      UsageError: for a number below 1, no tasks, results beyond the memory, or a method that does not fit.
      DataError: if the policy was made for another world, or a return is not finite.
    """
    _check_positive(seeds=seeds, episodes=episodes, eval_every=eval_every)
    setting = _checked_setting(env, policy, method, hypers, episodes, judged)
    fixed, numbers = split_hyper(hypers)
    adapter = method.adapter(setting, policy.params, hypers[0])
    segments, num = _segments(adapter, episodes, eval_every), adapter.episodes_per_round
    grid = Grid(variants=len(hypers), seeds=seeds, tasks=num_tasks(tasks))
    _check_room(env, grid, episodes)
    begin()
    layout = _lay_out(env, grid.size, _memory_bytes(env, adapter, tasks))
    program = _program(method, setting, fixed, layout, max(segments), keep_actions)
    lanes = grid.lanes(layout, tasks, seed, numbers, ends_early=stop_at is not None)
    lanes = split(layout.mesh, lanes)
    params = replicate(layout.mesh, policy.params)
    run = Run(program, lanes, params, segments, grid, layout, num * grid.size, stop_at)
    record, cpu = _run(run, journal or Journal())
    # The search, too, begins with one evaluation of the initial choice.
    after = np.concatenate([[1], np.cumsum(segments) * num])
    per_lane = episodes + (len(segments) + 1) * setting.judged.episodes
    total, cpu = round(layout.num_lanes * per_lane / grid.variants), cpu / grid.variants
    return [record.outcome(i, grid, after, total, cpu) for i in range(grid.variants)]


def _checked_setting(
    env: Environment,
    policy: LoadedPolicy,
    method: Method,
    hypers: Sequence[Any],
    episodes: int,
    judged: Judgement | None,
) -> Setting:
    """What a method may know before it sees a task, if it can be used there."""
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
    """Raise ``UsageError`` for an adaptation without tasks, or whose log does not fit into memory."""
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
    """Bytes of the log of so many adaptations at most: achieved goals and outcomes are most of it."""
    a_step = 2 * 4 * env.spec.goal_dim + 4
    return num_lanes * episodes * env.spec.horizon * a_step


def _segments(adapter: Adapter, episodes: int, eval_every: int) -> list[int]:
    """The budget as numbers of rounds between judgements; the last one is what is left."""
    num = adapter.episodes_per_round
    if episodes % num or eval_every % num:
        raise UsageError(
            f"the method runs {num} episodes in a round: the budget of {episodes} episodes and the "
            f"{eval_every} episodes between evaluations must be multiples of {num}"
        )
    whole, rest = divmod(episodes, eval_every)
    return [eval_every // num] * whole + ([rest // num] if rest else [])


class Lanes(NamedTuple):
    """What each lane has of its own."""

    task: Task
    key: PRNGKeyArray
    numbers: dict[str, Array]
    """Hyper-parameters that are data."""
    stopped: Bool[Array, "*lanes"] | None = None
    """Whether the search has ended; None where none ends early."""


class Layout(NamedTuple):
    """How lanes are spread: over devices, and on each in groups that share a clock."""

    mesh: Mesh
    group: int
    num_lanes: int
    """With those that only fill up the last groups."""


@dataclass(frozen=True)
class Grid:
    """How lanes are numbered: variants, then seeds, then tasks."""

    variants: int
    seeds: int
    tasks: int

    @property
    def size(self) -> int:
        return self.variants * self.seeds * self.tasks

    def lanes(
        self,
        layout: Layout,
        tasks: Task,
        seed: int,
        numbers: dict[str, list[int | float]],
        ends_early: bool = False,
    ) -> Lanes:
        """The lanes; those beyond the last variant repeat the first ones to fill up a group.

        With ``ends_early`` each says whether it has stopped.
        """
        index = np.arange(layout.num_lanes)
        runs = self.seeds * self.tasks
        which = index // runs % self.variants
        return Lanes(
            task=jax.tree.map(lambda leaf: jnp.asarray(leaf)[index % self.tasks], tasks),
            key=jax.random.split(jax.random.key(seed), runs)[index % runs],
            numbers={name: jnp.array(values)[which] for name, values in numbers.items()},
            stopped=jnp.zeros(layout.num_lanes, bool) if ends_early else None,
        )

    def shape(self, rows: np.ndarray) -> np.ndarray:
        """Rows of lanes as ``[variants, S, N, ..]``, without the lanes that only fill up groups."""
        return rows[: self.size].reshape(self.variants, self.seeds, self.tasks, *rows.shape[1:])


def _memory_bytes(env: Environment, adapter: Adapter, tasks: Task) -> int:
    """Bytes of an agent's memory at the end of an episode."""

    def memory(key: PRNGKeyArray, task: Task) -> Any:
        search = adapter.init(key, env.task_goal(task))
        choice, search = adapter.ask(key, search)
        agent = adapter.agent(search, choice)
        _, _, memory = agent.begin(key, task, *env.reset(key, task))
        return agent.grow(memory, env.spec.horizon - 1)

    task = jax.tree.map(lambda leaf: leaf[0], tasks)
    shapes = jax.eval_shape(memory, jax.random.key(0), task)
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))


def lanes_together(env: Environment, memory_bytes: int) -> int:
    """How many lanes share a clock."""
    limit = GROUP_BYTES if jax.default_backend() == "cpu" else GROUP_BYTES_ACCELERATOR
    return max(env.engine.worlds_together, limit // max(memory_bytes, 1), 1)


def _lay_out(env: Environment, num_lanes: int, memory_bytes: int) -> Layout:
    """Spread at least ``num_lanes`` lanes evenly."""
    mesh = mesh_of_all()
    on_each = -(-num_lanes // mesh.devices.size)
    num_groups = -(-on_each // lanes_together(env, memory_bytes))
    group = -(-on_each // num_groups)
    return Layout(mesh, group, mesh.devices.size * num_groups * group)


def _over_lanes(env: Environment, layout: Layout, function: Callable) -> Any:
    """A jitted ``function(own, shared)`` over all lanes."""

    def on_device(own: Any, shared: Any) -> Any:
        grouped = jax.tree.map(lambda leaf: leaf.reshape(-1, layout.group, *leaf.shape[1:]), own)
        done = jax.lax.map(lambda own: jax.vmap(function, in_axes=(0, None))(own, shared), grouped)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), done)

    options = dict(env.engine.compiler_options)
    return on_devices(layout.mesh, on_device, [True, False], True, compiler_options=options)


class Program:
    """A jitted function that is compiled once for each set of shapes, outside of any measured time."""

    def __init__(self, jitted: Any) -> None:
        self.jitted = jitted
        self._compiled: dict[Any, Any] = {}

    def compile(self, *args: Any) -> Any:
        """The program for arguments of these shapes."""
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
    """``((state, lanes), (params, number of rounds, number of the judgement)) -> (state, log, judged)``."""


@cache
def _program(
    method: Method,
    setting: Setting,
    fixed: Any,
    layout: Layout,
    max_rounds: int,
    keep_actions: bool,
) -> Programs:
    """The programs that search with a method; equal arguments share them within a process."""
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
        Program(_over_lanes(env, layout, begin)),
        Program(_over_lanes(env, layout, advance)),
    )


class Record(NamedTuple):
    """What an adaptation left behind, rows of lanes; the log is without the goals that were reached."""

    log: AdaptLog
    judged: Judged
    reached: list[Goals]
    """The goals of each segment's episodes, ``[lanes, R, K, T, ..]``."""

    def outcome(
        self, variant: int, grid: Grid, after: np.ndarray, num_episodes: int, cpu_seconds: float
    ) -> Outcome:
        """The results of one variant."""

        def of_variant(rows: Any) -> np.ndarray:
            return grid.shape(rows)[variant]

        def by_episode(rows: Any) -> np.ndarray:
            rows = of_variant(rows)
            return rows.reshape(*rows.shape[:2], -1, *rows.shape[4:])

        failed = by_episode(self.log.failed)
        num_failed = failed.sum() + of_variant(self.judged.num_failed).sum()
        return Outcome(
            returns=by_episode(self.log.returns),
            failed=failed,
            choices=jax.tree.map(of_variant, self.log.choices),
            best=jax.tree.map(of_variant, self.log.best),
            lengths=np.concatenate([by_episode(goals.length) for goals in self.reached], axis=2),
            keys=by_episode(self.log.played.key),
            actions=jax.tree.map(by_episode, self.log.played.actions),
            reached=_reached([jax.tree.map(by_episode, goals) for goals in self.reached]),
            eval_episodes=after,
            eval_returns=of_variant(self.judged.return_),
            num_episodes=num_episodes,
            num_failed=int(num_failed),
            cpu_seconds=cpu_seconds,
            eval_achieved=_by_judgement(jax.tree.map(of_variant, self.judged.achieved)),
            num_scored=jax.tree.map(of_variant, self.log.num_scored),
        )


def _by_judgement(achieved: np.ndarray | None) -> np.ndarray | None:
    """Shares [S, N, M, C] as [S, N, C, M]."""
    return None if achieved is None else np.moveaxis(achieved, -1, -2)


class Segment(NamedTuple):
    """What a finished segment leaves behind, rows of lanes."""

    log: AdaptLog
    judged: Judged
    cpu_seconds: float


class Run(NamedTuple):
    """What an adaptation is made of."""

    programs: Programs
    lanes: Lanes
    params: Any
    segments: Sequence[int]
    """Rounds between judgements; the first judgement comes before all of them."""
    grid: Grid
    layout: Layout
    per_round: int
    """Episodes that all lanes together run in a round."""
    stop_at: float | None

    def without(self, stopped: np.ndarray) -> Lanes:
        """The lanes, of which some have ended; those beyond the grid repeat the first ones."""
        index = np.arange(self.layout.num_lanes) % self.grid.size
        return self.lanes._replace(stopped=split(self.layout.mesh, jnp.asarray(stopped[index])))


def _run(run: Run, journal: Journal) -> tuple[Record, float]:
    """Run all segments of an adaptation, each followed by a judgement.

    Segments that the journal holds are not run again. Also returns the CPU time, without compilation.
    """
    programs, lanes, params, segments, grid, layout, per_round, stop_at = run
    state = programs.start.compile(lanes, params)(lanes, params)
    # A method whose first state holds NaN means something by it.
    watched = bool(_learns(state.search)) and not _broken(state.search, layout.mesh).any()
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
            _keep(journal, number, done[-1], state, grid)
            progress.update(num * per_round)
            progress.show({"return": f"{judged.return_.mean():.3f}"})
            before += num
    logs = [segment.log for segment in done[1:]]
    goals = [log.played.goals for log in logs]
    whole = jax.tree.map(lambda *rows: np.concatenate(rows, axis=1), *map(_without_goals, logs))
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
        value, what = judged.return_[lane], "a judging episode"
    else:
        return
    seed, task = divmod(int(lane) % (grid.seeds * grid.tasks), grid.tasks)
    raise DataError(
        f"the return of {what} on task {task} with seed number {seed} is {value}; the world or the policy "
        "is broken"
    )


def _learns(searches: Any) -> list[Array]:
    """The numbers in the states of searches."""
    leaves = jax.tree.leaves(searches)
    return [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]


def _broken(searches: Any, mesh: Mesh) -> np.ndarray:
    """Which searches [lanes] hold NaN in their states."""
    return fetch(_breaking(mesh)(_learns(searches)))


@cache
def _breaking(mesh: Mesh) -> Any:
    def broken(leaves: list[Array]) -> Bool[Array, "lanes"]:
        found = [jnp.isnan(leaf).reshape(len(leaf), -1).any(axis=1) for leaf in leaves]
        return jnp.any(jnp.stack(found), axis=0)

    return on_devices(mesh, broken, [True], True)


def _check_sound(searches: Any, run: Run, rounds: int) -> None:
    """Raise ``DataError`` for the first search whose state holds NaN, such as weights that diverged."""
    grid = run.grid
    if (broken := _broken(searches, run.layout.mesh)[: grid.size]).any():
        seed, task = divmod(int(np.argmax(broken)) % (grid.seeds * grid.tasks), grid.tasks)
        raise DataError(
            f"the search on task {task} with seed number {seed} has diverged: what it learned holds NaN "
            f"after {rounds} rounds; lower its learning rate"
        )


def _keep(journal: Journal, number: int, segment: Segment, state: Any, grid: Grid) -> None:
    """Write a finished segment to the journal, and then the state that the next one starts from."""
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
    """The finished segments in a journal and the state after them.

    If any of them is missing, there are none, and the state is the first one.
    """
    records = [journal.read(f"segment{i:04}") for i in range(int(saved.pop("segments")))]
    like = Segment(*jax.tree.map(lambda leaf: 0, shapes), cpu_seconds=0.0)
    done = [with_leaves(like, record) for record in records if record is not None]
    if len(done) < len(records):
        return [], state
    # The lanes beyond the grid repeat the first ones.
    index = np.arange(layout.num_lanes) % grid.size

    def placed(rows: Any, like: Any) -> Any:
        rows = jnp.asarray(rows[index])
        return jax.random.wrap_key_data(rows) if is_key(like) else rows

    state = split(layout.mesh, jax.tree.map(placed, with_leaves(state, saved), state))
    return [s._replace(cpu_seconds=float(s.cpu_seconds)) for s in done], state


def _without_goals(log: AdaptLog) -> AdaptLog:
    """The log without the goals that were reached, which take most of its memory."""
    nothing: Any = None
    return log._replace(played=log.played._replace(goals=nothing))


def _reached(segments: Sequence[Goals]) -> Reached:
    """The goals reached in the episodes of consecutive segments, ``[S, N, E, T, ..]`` each."""
    real = [
        goals.goal_reached & (np.arange(goals.goal_reached.shape[-1]) < goals.length[..., None])
        for goals in segments
    ]
    counts = np.concatenate([which.sum(axis=-1) for which in real], axis=2)
    reached = np.concatenate(real, axis=2)
    steps = np.nonzero(reached)[-1]
    achieved = np.concatenate([goals.achieved_goals for goals in segments], axis=2)
    small = np.min_scalar_type(reached.shape[-1])
    return Reached(counts.astype(np.int32), steps.astype(small), achieved[reached])


def evaluate(
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
    queries: Query,
    *,
    episodes: int,
    seed: int = 0,
) -> tuple[np.ndarray, int]:
    """Mean returns ``[S, N]`` of queries with leaves ``[S, N, ..]``, one for each seed and task.

    The second result is how many episodes a broken world ended. ``evaluate_fully`` tells more.

    Raises:
      DataError: if the policy was made for another world, or a return is not finite.
    """
    judged = evaluate_fully(env, policy, tasks, queries, episodes=episodes, seed=seed)
    return np.asarray(judged.return_), int(judged.num_failed.sum())


def evaluate_fully(
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
    queries: Query,
    *,
    episodes: int,
    seed: int = 0,
) -> Judged:
    """Judge queries in fresh episodes.

    Args:
      env: the world.
      policy: who acts.
      tasks: N tasks, stacked.
      queries: with leaves ``[S, N, ..]``, one for each seed and task.
      episodes: how many each query is judged in.
      seed: seed of the episodes.

    Returns:
      Numpy arrays: ``return_`` [S, N], ``num_failed`` [S, N] and, in worlds with M named goals,
      ``achieved`` [S, N, M].

    Raises:
      DataError: if the policy was made for another world, or a return is not finite.
    """
    run = partial(_measurement, num_episodes=episodes)
    return _of_queries(run, env, policy, tasks, queries, seed)


class Uncertainty(NamedTuple):
    """How sure a policy was of its actions in its own episodes."""

    entropy: Float[Array, "*batch"]
    """Of the distributions that it acted from, in nats, mean over the steps of the episode; NaN where the
    policy's head has no closed form of it."""
    return_: Float[Array, "*batch"]
    num_steps: Int[Array, "*batch"]


def uncertainty(
    env: Environment, policy: LoadedPolicy, tasks: Task, queries: Query, *, seed: int = 0
) -> Uncertainty:
    """How sure a policy is of its actions under each query, in one fresh episode of it.

    Args:
      env: the world.
      policy: who acts.
      tasks: N tasks, stacked.
      queries: with leaves ``[S, N, ..]``.
      seed: seed of the episodes.

    Returns:
      Numpy arrays [S, N].

    Raises:
      DataError: if the policy was made for another world, or a return is not finite.
    """
    return _of_queries(_uncertainty, env, policy, tasks, queries, seed)


@cache
def _uncertainty(env: Environment, network: TransformerConfig, layout: Layout) -> Any:
    """``((lanes, queries), params) -> uncertainty``, compiled once a process."""

    def measure(own: tuple[Lanes, Query], params: Any) -> Uncertainty:
        lane, query = own
        done = rollout(lane.key, env, transformer_policy(network, params), lane.task, query)
        # One pass over the whole episode gives the same distributions as the steps did.
        episode = done.trajectory
        distribution: Any = GoalTransformer(network).apply(
            params, query.prompt, episode.obs, episode.actions
        )
        real = jnp.arange(len(episode.obs)) < episode.length
        try:
            entropy = jnp.sum(jnp.where(real, distribution.entropy(), 0.0)) / episode.length
        except NotAvailableError:
            entropy = jnp.float32(jnp.nan)
        return Uncertainty(entropy, done.return_, episode.length)

    return _over_lanes(env, layout, measure)


def _of_queries(
    program: Callable,
    env: Environment,
    policy: LoadedPolicy,
    tasks: Task,
    queries: Query,
    seed: int,
) -> Any:
    """What a program finds for queries with leaves ``[S, N, ..]``, as numpy arrays with these axes.

    ``program(env, network, layout)`` is a function ``((lanes, queries), params) -> found`` over all lanes;
    what it finds has a field ``return_``.
    """
    check_fits(policy.config, env.spec)
    seeds, num = queries.prompt.mask.shape[:2]
    grid = Grid(variants=1, seeds=seeds, tasks=num)
    layout = _lay_out(env, grid.size, cache_bytes(policy.config))
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), queries)
    index = np.arange(layout.num_lanes) % grid.size
    own = (
        grid.lanes(layout, tasks, seed, {}),
        jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], flat),
    )
    run = program(env, policy.config, layout)
    found = fetch(run(split(layout.mesh, own), replicate(layout.mesh, policy.params)))
    found = jax.tree.map(lambda rows: grid.shape(rows)[0], found)
    if not (finite := np.isfinite(found.return_)).all():
        which, task = np.argwhere(~finite)[0]
        raise DataError(
            f"a return on task {task} with seed number {which} is {found.return_[which, task]}; the world "
            "or the policy is broken"
        )
    return found


@cache
def _measurement(
    env: Environment, network: TransformerConfig, layout: Layout, num_episodes: int
) -> Any:
    """``((lanes, queries), params) -> judged``, compiled once a process."""

    def measure(own: tuple[Lanes, Query], params: Any) -> Judged:
        lane, query = own
        policy = transformer_policy(network, params)

        def episode(key: PRNGKeyArray) -> tuple[Array, Array, Array | None]:
            done = rollout(key, env, policy, lane.task, query)
            achieved = achieved_goals(env, done.trajectory)
            return done.return_, jnp.asarray(done.failed), achieved

        return judge(*jax.lax.map(episode, jax.random.split(lane.key, num_episodes)))

    return _over_lanes(env, layout, measure)


def cache_bytes(network: TransformerConfig) -> int:
    """Bytes of the key-value cache of an episode."""
    num_tokens = network.max_prompt_length + network.num_step_tokens(network.horizon)
    return 4 * 2 * network.num_layers * network.embed_dim * num_tokens


@cache
def _player(env: Environment, network: TransformerConfig) -> Any:
    def episode(key: PRNGKeyArray, params: Any, task: Task, query: Query) -> Episode:
        return rollout(key, env, transformer_policy(network, params), task, query)

    return together(env, episode, in_axes=(0, None, None, None))


def play(
    key: PRNGKeyArray, env: Environment, policy: LoadedPolicy, task: Task, query: Query, num: int
) -> Episode:
    """``num`` episodes of a policy on one task, numpy leaves ``[num, ..]``."""
    keys = jax.random.split(key, num)
    return fetch(_player(env, policy.config)(keys, policy.params, task, query))
