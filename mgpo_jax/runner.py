"""Adaptation to many tasks at once. All commands and examples that search for prompts use this module.

A run is divided into segments of rounds, each followed by a judgement of the best choice so far
(``mgpo_jax.segments``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from envs.base import Environment, Task
from envs.errors import UsageError
from envs.registry import Judgement, World
from envs.registry import find as find_world
from mgpo_jax.adaptation import Adapter
from mgpo_jax.journal import Journal
from mgpo_jax.lanes import Grid, lay_out
from mgpo_jax.memory import physical_bytes
from mgpo_jax.methods import Method, Setting, find, split_hyper
from mgpo_jax.outcomes import Outcome
from mgpo_jax.policy import LoadedPolicy, check_fits
from mgpo_jax.programs import programs_of
from mgpo_jax.segments import Run, longest_part, run_segments
from mgpo_jax.settings import check_positive
from mgpo_jax.sharding import replicate, split
from mgpo_jax.tasks import num_tasks


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

    Returns:
      The judged returns, the episodes of the searches, and what the method held best after each round.

    Raises:
      UsageError: for a number below 1, no tasks, results that exceed the memory, or a method that cannot be
        used in this setting.
      DataError: if the policy was trained for another world, or a return is not finite.
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
        env, policy, tasks, method, [hyper], seeds=seeds, episodes=episodes, seed=seed,
        eval_every=eval_every, judged=judged, keep_actions=keep_actions,
    )  # fmt: skip
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
      journal: saves finished parts of segments; those that it already holds are not run again.
      begin: called once, after all checks and before anything is compiled.

    Raises:
      UsageError: for a number below 1, no tasks, results that exceed the memory, or an unsuitable method.
      DataError: if the policy was trained for another world, or a return is not finite.
    """
    check_positive(seeds=seeds, episodes=episodes, eval_every=eval_every)
    setting = _checked_setting(env, policy, method, hypers, episodes, judged)
    fixed, numbers = split_hyper(hypers)
    adapter = method.adapter(setting, policy.params, hypers[0])
    segments, num = _segments(adapter, episodes, eval_every), adapter.episodes_per_round
    grid = Grid(variants=len(hypers), seeds=seeds, tasks=num_tasks(tasks))
    _check_room(env, grid, episodes, keep_actions)
    begin()
    layout = lay_out(env, grid.size, _memory_bytes(env, adapter, tasks))
    most = longest_part(segments, num * log_bytes(env, grid.size, 1, keep_actions))
    programs = programs_of(method, setting, fixed, layout, most, keep_actions)
    lanes = grid.lanes(layout, tasks, seed, numbers, ends_early=stop_at is not None)
    lanes, params = split(layout.mesh, lanes), replicate(layout.mesh, policy.params)
    run = Run(programs, lanes, params, segments, most, grid, layout, num, stop_at)
    record, cpu = run_segments(run, journal or Journal())
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


def _check_room(env: Environment, grid: Grid, episodes: int, keep_actions: bool) -> None:
    """Raise ``UsageError`` if there are no tasks, or if the log would not fit into memory."""
    if not grid.size:
        raise UsageError("there are no tasks to adapt to")
    needed = log_bytes(env, grid.size, episodes, keep_actions)
    room = physical_bytes()
    if needed > room:
        raise UsageError(
            f"{grid.size:,} adaptations of {episodes:,} episodes need {needed / 1e9:,.0f} GB of memory, "
            f"this machine has {room / 1e9:.0f} GB; adapt with fewer --seeds, --episodes or tasks at once"
        )


def log_bytes(env: Environment, num_lanes: int, episodes: int, keep_actions: bool = False) -> int:
    """Upper bound of the bytes in the log of ``num_lanes`` adaptations, most of them goals and outcomes."""
    kept = 4 * env.spec.action_dim if keep_actions and not env.spec.discrete else 0
    a_step = 2 * 4 * env.spec.goal_dim + 4 + kept
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
