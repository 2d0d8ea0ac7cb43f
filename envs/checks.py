"""Checks that a world fulfills the contract of every world: ``envs.check_world(world)``.

The rules are those of ``envs/base.py``. A few episodes are run beyond their horizon, half of them with the
world's first demonstrator, if it has one, and the others with random actions. Each violation becomes a
sentence that names the step which shows it. Rules that depend on a violated one are skipped.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

import envs.registry
from envs.base import Box, Demonstrator, Discrete, Environment, EnvSpec, Task, TimeStep
from envs.episodes import run_episode
from envs.errors import NotAvailableError, UsageError, shown
from envs.registry import World

LANES = 6
"""Number of episodes that are run."""
AFTER_END = 4
"""Number of steps beyond the horizon."""
EAGER_STEPS = 3
"""Number of steps without ``jit``, which take long in some worlds."""
CLOSE = 1e-5
"""Tolerance between results of the same computation compiled in different ways."""


@dataclass(frozen=True)
class Report:
    """The result of a check."""

    name: str
    """The name of the world."""
    faults: tuple[str, ...]
    """The violations of the contract, a sentence each."""
    notes: tuple[str, ...] = ()
    """Remarks on what is allowed but may be unintended, and on what could not be checked, a sentence
    each."""
    facts: Mapping[str, float] = field(default_factory=dict)
    """Measurements: ``steps_per_cpu_second`` in running episodes, ``compile_seconds`` (CPU time) of a
    program with a reset and a step, and the numbers of ``episodes``, ``steps`` and ``tasks`` that were
    checked."""

    def __str__(self) -> str:
        lines = [f"{self.name}: {_count(len(self.faults), 'fault')}"]
        lines += [f"- {text}" for text in self.faults]
        lines += [f"note: {text}" for text in self.notes]
        if self.facts:
            lines.append(
                "checked {episodes:.0f} episodes with {steps:.0f} steps and {tasks:.0f} tasks; "
                "{steps_per_cpu_second:,.0f} steps per CPU-second, compilation took "
                "{compile_seconds:.1f} CPU-seconds".format(**self.facts)
            )
        return "\n".join(lines)


class _Played(NamedTuple):
    """The output of L episodes, as numpy leaves ``[L, ..]`` or ``[L, T, ..]``."""

    first: Any
    """The ``TimeStep`` of the reset."""
    steps: Any
    """The ``TimeStep`` of every step."""
    unchanged: Any
    """Whether a step left the whole state unchanged."""


@dataclass(frozen=True)
class _Case:
    """The episodes that the rules are checked on."""

    env: Environment
    tasks: Task
    """The tasks of the episodes, leaves ``[L, ..]``."""
    keys: Any
    actions: Any
    shown: int
    """The number of episodes that are demonstrations; they come first."""
    play: Any
    """``(keys, tasks, actions) -> _Played``, compiled."""
    played: _Played
    ends: np.ndarray
    """The last step of each episode, counted from 0; -1 for an episode that did not end."""

    def place(self, lane: int, step: int) -> str:
        """An episode and a step (counted from 1) as text for a message."""
        who = "the demonstrator's actions" if lane < self.shown else "random actions"
        return f"step {step + 1} of episode {lane} ({who})"


def check_world(world: World | Environment | str, seed: int = 0) -> Report:
    """Check a world of your own before you train on it.

    Args:
      world: its record, its name or place (``my_package.my_world:WORLD``), or its environment.
      seed: random seed of tasks, episodes and random actions.

    Returns:
      The report, which ``print`` shows as text.

    Raises:
      UsageError: if there is no such world, or packages that it needs are not installed.
    """
    record: Any = envs.registry.find(world) if isinstance(world, str) else world
    notes: list[str] = []
    if isinstance(record, World):
        name = record.name
        try:
            env: Any = record.make()
        except ImportError as error:
            raise UsageError(str(error)) from None
    else:
        name, env, record = type(record).__name__, record, None
    faults = [*_record_faults(env)]
    if not faults:
        name = name if record else env.spec.name
        faults += _trace_faults(env)
    if not faults:
        faults += _shape_faults(env)
    if faults:
        return Report(name, tuple(faults), tuple(notes))
    num_test_tasks = record.num_test_tasks if record else 0
    tasks, again = _draw(env, seed, max(2 * num_test_tasks, 64))
    faults += _task_faults(env, tasks, again, num_test_tasks)
    demonstrator = _first_demonstrator(record, env, notes)
    case, repeated, facts = _episodes(env, demonstrator, tasks, seed)
    facts["tasks"] = float(len(jax.tree.leaves(tasks)[0]))
    impure = [*_repetition_faults(case, repeated)]
    faults += impure
    if not impure:  # otherwise no other observation would be reliable
        for rule in (_end_faults, _absorbing_faults, _reward_faults, _goal_faults, _program_faults):
            faults += rule(case)
        faults += _chance_faults(case, notes)
    return Report(name, tuple(faults), tuple(notes), facts)


def _count(num: int, what: str) -> str:
    return f"{num or 'no'} {what}{'' if num == 1 else 's'}"


def _reason(error: BaseException) -> str:
    """The first line of an error."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def _record_faults(env: Any) -> Iterator[str]:
    """Faults of the type and the spec of an environment, before anything runs."""
    if not isinstance(env, Environment):
        yield f"make() returns a {type(env).__name__}; derive the world from envs.Environment"
        return
    try:
        hash(env)
    except TypeError as error:
        yield (
            f"the environment cannot be hashed ({error}); make it a frozen dataclass whose fields are "
            "numbers, texts and tuples"
        )
    spec = env.spec
    if not isinstance(spec, EnvSpec):
        yield f"spec is a {type(spec).__name__}; it must be an envs.EnvSpec"
        return
    if not isinstance(spec.actions, Discrete | Box):
        yield f"spec.actions is {shown(spec.actions)}; it must be envs.Discrete or envs.Box"
    for what, value in (("horizon", spec.horizon), ("goal_dim", spec.goal_dim)):
        if not (isinstance(value, int) and value >= 1):
            yield f"spec.{what} is {shown(value)}; it must be an integer from 1 on"
    low, high = spec.return_range
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        yield f"spec.return_range is ({low}, {high}); it must be two finite numbers, the smaller one first"


def _trace_faults(env: Environment) -> Iterator[str]:
    """Functions that cannot be traced, that leak tracers, or that give different programs each time."""
    key = jax.random.key(0)
    kept: dict[str, Any] = {}

    def shape_of(name: str, function: Any, *args: Any) -> Iterator[str]:
        try:
            with jax.checking_leaks():
                # A new function object each time, since jax caches traces by function.
                traces = [
                    jax.make_jaxpr(partial(function), return_shape=True)(*args) for _ in range(2)
                ]
        except Exception as error:
            if "leaked" in str(error).lower():
                yield (
                    f"{name} leaks a tracer: it keeps a value of one call for later, in an attribute or a "
                    "global variable; put it into the state"
                )
            elif isinstance(error, NotAvailableError | NotImplementedError):
                yield f"{name} is not defined ({_reason(error)})"
            else:
                yield f"{name} cannot be compiled ({_reason(error)})"
            return
        kept[name] = traces[0][1]
        if not _same_programs(traces[0][0], traces[1][0]):
            yield (
                f"{name} is not pure: tracing it twice gave two different programs, so it depends on "
                "something beside its arguments, such as a counter or a random number of numpy"
            )

    yield from shape_of("sample_task", env.sample_task, key)
    if "sample_task" not in kept:
        return
    task = kept["sample_task"]
    yield from shape_of("task_goal", env.task_goal, task)
    yield from shape_of("reset", env.reset, key, task)
    if "reset" in kept:
        state, _ = kept["reset"]
        action = jax.eval_shape(env.spec.zero_action)
        yield from shape_of("step", env.step, state, action)


def _same_programs(a: Any, b: Any) -> bool:
    """Whether two traces are the same program with the same constants."""
    texts = [re.sub(r"0x[0-9a-f]+", "", str(one)) for one in (a, b)]  # without memory addresses
    if texts[0] != texts[1] or len(a.consts) != len(b.consts):
        return False
    return all(np.array_equal(x, y) for x, y in zip(a.consts, b.consts, strict=True))


def _shape_faults(env: Environment) -> Iterator[str]:
    """Wrong shapes and dtypes in the outputs of a world."""
    spec, key = env.spec, jax.random.key(0)
    task = jax.eval_shape(env.sample_task, key)
    wanted = {
        "obs": (spec.obs.shape, spec.obs.dtype),
        "achieved_goal": ((spec.goal_dim,), "float32"),
        "goal_reached": ((), "bool"),
        "outcome": ((spec.goal_dim,), "float32"),
        "reward": ((), "float32"),
        "terminated": ((), "bool"),
        "truncated": ((), "bool"),
        "failed": ((), "bool"),
    }
    goal = jax.eval_shape(env.task_goal, task)
    yield from _misfit("task_goal", goal, *wanted["achieved_goal"])
    state, first = jax.eval_shape(env.reset, key, task)
    after, timestep = jax.eval_shape(env.step, state, jax.eval_shape(spec.zero_action))
    for name, told in (("reset", first), ("step", timestep)):
        if not isinstance(told, TimeStep):
            yield f"{name} returns a {type(told).__name__} in second place; it must be an envs.TimeStep"
            continue
        for part, (shape, dtype) in wanted.items():
            yield from _misfit(f"{part} of {name}", getattr(told, part), shape, dtype)
    old_fields: Any = jax.tree.structure(state)
    if old_fields != jax.tree.structure(after):
        yield (
            "the state returned by step has different fields from the state returned by reset; both must "
            "have the same structure"
        )
        return
    for (path, old), new in zip(
        jax.tree_util.tree_leaves_with_path(state), jax.tree.leaves(after), strict=True
    ):
        where = f"the state's {jax.tree_util.keystr(path, simple=True) or 'array'}"
        if (old.shape, old.dtype) != (new.shape, new.dtype):
            yield (
                f"{where} is {old.dtype}{list(old.shape)} after reset and {new.dtype}{list(new.shape)} "
                "after step; a state keeps its shapes and dtypes"
            )


def _misfit(what: str, found: Any, shape: tuple[int, ...], dtype: str) -> Iterator[str]:
    """A sentence about an array whose shape or dtype is wrong."""
    found = jax.eval_shape(lambda: jnp.asarray(found)) if isinstance(found, bool) else found
    if not hasattr(found, "dtype"):
        yield f"{what} is a {type(found).__name__}; it must be an array {dtype}{list(shape)}"
    elif (tuple(found.shape), str(found.dtype)) != (tuple(shape), dtype):
        yield f"{what} is {found.dtype}{list(found.shape)}; it must be {dtype}{list(shape)}"


def _draw(env: Environment, seed: int, num: int) -> tuple[Task, Task]:
    """``num`` random tasks, drawn twice with the same keys."""
    keys, program = jax.random.split(jax.random.key(seed), num), jax.jit(jax.vmap(env.sample_task))
    return program(keys), program(keys)


def _task_faults(env: Environment, tasks: Task, again: Task, num_test_tasks: int) -> Iterator[str]:
    """Tasks that are invalid, not diverse enough, or not determined by their key."""
    num = len(jax.tree.leaves(tasks)[0])
    if not _equal(tasks, again):
        yield "sample_task is not pure: the same key drew two different tasks"
    try:
        env.check_task(jax.tree.map(np.asarray, tasks))
    except ValueError as error:
        yield f"check_task refuses a task that sample_task drew ({error})"
    prints = np.asarray(jax.vmap(env.fingerprint)(tasks)).reshape(num, -1)
    different = len(np.unique(prints, axis=0))
    if different < 2:
        yield f"all of {num} sampled tasks are the same; sample_task must use its key"
    elif different < num_test_tasks:
        yield (
            f"{num} draws gave only {different} different tasks, but the world's record needs "
            f"{num_test_tasks} test tasks; make tasks more diverse, or lower num_test_tasks"
        )
    goals = np.asarray(jax.vmap(env.task_goal)(tasks))
    if not np.isfinite(goals).all():
        yield f"task_goal of sampled task {_first(~np.isfinite(goals))[0]} is not finite"


def _first_demonstrator(
    record: World | None, env: Environment, notes: list[str]
) -> Demonstrator | None:
    """The demonstrator whose episodes are checked; None if there is none."""
    known = record.demonstrators(env) if record else {}
    for name, demonstrator in known.items():
        if demonstrator.env in (None, env):
            return demonstrator
        notes.append(
            f"the demonstrator {name} acts in another world, so its episodes are not checked"
        )
    return None


def _episodes(
    env: Environment, demonstrator: Demonstrator | None, tasks: Task, seed: int
) -> tuple[_Case, _Played, dict[str, float]]:
    """Run the episodes twice; returns the case, the repeated episodes, and measurements."""
    horizon = env.spec.horizon
    keys = jax.random.split(jax.random.key(seed + 1), LANES)
    tasks = jax.tree.map(lambda leaf: leaf[:LANES], tasks)
    actions = jax.vmap(partial(_random_actions, env.spec, horizon + AFTER_END))(keys)
    num_shown = 0
    if demonstrator is not None:
        num_shown = LANES // 2
        tasks, actions = _demonstrated(env, demonstrator, keys[:num_shown], tasks, actions)
    # The episode loop of the project splits its key; here the world is given the same key as there.
    keys = jax.vmap(lambda key: jax.random.split(key, 3)[0])(keys)
    compiled = jax.jit(
        jax.vmap(partial(_play, env)), compiler_options=dict(env.engine.compiler_options)
    )
    start = time.process_time()
    program = compiled.lower(keys, tasks, actions).compile()
    compiling = time.process_time() - start
    played = _numpy(program(keys, tasks, actions))
    start = time.process_time()
    repeated = _numpy(program(keys, tasks, actions))
    running = time.process_time() - start
    over = played.steps.terminated | played.steps.truncated
    ends = np.where(over.any(axis=1), over.argmax(axis=1), -1)
    live = int(np.where(ends < 0, over.shape[1], ends + 1).sum())
    facts = {
        "episodes": float(LANES),
        "steps": float(live),
        "steps_per_cpu_second": live / max(running, 1e-6),
        "compile_seconds": compiling,
    }
    case = _Case(env, tasks, keys, actions, num_shown, program, played, ends)
    return case, repeated, facts


def _random_actions(spec: EnvSpec, num: int, key: PRNGKeyArray) -> Array:
    if spec.discrete:
        return jax.random.randint(key, (num,), 0, spec.action_dim)
    return jax.random.uniform(key, (num, spec.action_dim), minval=-1.0, maxval=1.0)


def _demonstrated(
    env: Environment, demonstrator: Demonstrator, keys: Any, tasks: Task, actions: Array
) -> tuple[Task, Array]:
    """Replace the first tasks and actions by those of demonstrations."""

    def demonstrate(key: PRNGKeyArray, index: Array, weights: Any) -> tuple[Task, Array, Array]:
        task = demonstrator.sample_task(key, index)
        episode = run_episode(key, env, demonstrator.agent(weights), task)
        return task, episode.trajectory.actions, episode.trajectory.length

    program = jax.jit(
        jax.vmap(demonstrate, in_axes=(0, 0, None)),
        compiler_options=dict(env.engine.compiler_options),
    )
    num, horizon = len(keys), env.spec.horizon
    own, shown_actions, lengths = program(keys, jnp.arange(num), demonstrator.weights)
    real = jnp.arange(horizon) < lengths[:, None]
    real = real.reshape(*real.shape, *(1,) * (actions.ndim - 2))
    mixed = jnp.where(real, shown_actions, actions[:num, :horizon])
    tasks = jax.tree.map(lambda a, b: jnp.concatenate([a, b[num:]]), own, tasks)
    return tasks, actions.at[:num, :horizon].set(mixed.astype(actions.dtype))


def _play(env: Environment, key: PRNGKeyArray, task: Task, actions: Array) -> _Played:
    """Run one episode with given actions, beyond its end."""
    state, first = env.reset(key, task)

    def step(state: Any, action: Array) -> Any:
        after, timestep = env.step(state, action)
        return after, (timestep, _all_equal(state, after))

    _, (steps, unchanged) = jax.lax.scan(step, state, actions)
    # ``failed`` may be the constant False.
    filled = jnp.broadcast_to(jnp.asarray(steps.failed), steps.reward.shape)
    return _Played(first, steps._replace(failed=filled), unchanged)


def _raw(leaf: Any) -> Any:
    """The raw data of random keys; any other array unchanged."""
    is_key = jnp.issubdtype(jnp.result_type(leaf), jax.dtypes.prng_key)
    return jax.random.key_data(leaf) if is_key else leaf


def _all_equal(a: Any, b: Any) -> Array:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    same = [jnp.all(jnp.equal(_raw(x), _raw(y))) for x, y in pairs]
    return jnp.all(jnp.stack(same)) if same else jnp.ones((), bool)


def _numpy(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(_raw(leaf)), tree)


def _equal(a: Any, b: Any) -> bool:
    leaves = zip(jax.tree.leaves(_numpy(a)), jax.tree.leaves(_numpy(b)), strict=True)
    return all(np.array_equal(x, y) for x, y in leaves)


def _first(mask: np.ndarray) -> tuple[int, ...]:
    """The index of the first true entry of a mask."""
    return tuple(int(i) for i in np.argwhere(mask)[0])


def _end_faults(case: _Case) -> Iterator[str]:
    """Episodes that are over at their start, end in two ways at once, or do not end at the horizon."""
    first, steps, horizon = case.played.first, case.played.steps, case.env.spec.horizon
    begun = np.asarray(first.terminated | first.truncated)
    if begun.any():
        yield f"reset of episode {_first(begun)[0]} returns an episode that is over before any action"
    if (both := steps.terminated & steps.truncated).any():
        yield (
            f"{case.place(*_first(both))} is terminated and truncated at once; an episode that its task "
            "ends is not truncated"
        )
    for lane, end in enumerate(case.ends.tolist()):
        if not 0 <= end < horizon:
            yield (
                f"{case.place(lane, horizon - 1)} is the last one of the horizon of {horizon} steps, and "
                "the episode is neither terminated nor truncated"
            )
            return
        if steps.truncated[lane, end] and not steps.terminated[lane, end] and end < horizon - 1:
            yield (f"{case.place(lane, end)} is truncated before the horizon of {horizon} steps")
            return


def _absorbing_faults(case: _Case) -> Iterator[str]:
    """Changes or rewards after the end of an episode."""
    steps = case.played.steps
    for lane, end in enumerate(case.ends.tolist()):
        if end < 0:
            continue
        changed = False
        paid = steps.reward[lane, end + 1 :] != 0
        if paid.any():
            step = end + 1 + _first(paid)[0]
            yield (
                f"{case.place(lane, step)} pays a reward of {steps.reward[lane, step]:g} after the end of "
                f"the episode at step {end + 1}; terminal states must give reward 0"
            )
        moved = ~case.played.unchanged[lane, end + 1 :]
        if moved.any():
            step = end + 1 + _first(moved)[0]
            yield (
                f"{case.place(lane, step)} changes the state after the end of the episode at step "
                f"{end + 1}; terminal states must stay as they are"
            )
        # ``goal_reached`` refers to a single step, so it need not stay the same after the end.
        for name in ("obs", "achieved_goal", "outcome", "terminated", "truncated"):
            rows = getattr(steps, name)[lane, end:]
            differs = np.array([not np.array_equal(row, rows[0]) for row in rows])
            if differs.any():
                step = end + _first(differs)[0]
                yield (
                    f"{case.place(lane, step)} has a different {name} from that at the end of the episode, "
                    f"step {end + 1}; terminal states must stay as they are"
                )
                changed = True
        if changed or paid.any() or moved.any():
            return


def _reward_faults(case: _Case) -> Iterator[str]:
    """Rewards that are not finite, and returns outside of the stated range."""
    rewards, (low, high) = case.played.steps.reward, case.env.spec.return_range
    if not np.isfinite(rewards).all():
        place = _first(~np.isfinite(rewards))
        yield f"{case.place(*place)} pays {rewards[place]}; rewards must be finite"
        return
    slack = CLOSE * max(1.0, abs(low), abs(high))
    for lane, end in enumerate(case.ends.tolist()):
        sums = np.cumsum(rewards[lane, : end + 1 or None], dtype=np.float64)
        if not low - slack <= sums[-1] <= high + slack:
            beyond = (sums < low - slack) if sums[-1] < low else (sums > high + slack)
            yield (
                f"{case.place(lane, _first(beyond)[0])} takes the return outside of the stated range: "
                f"{sums[-1]:g} at the end, spec.return_range is ({low:g}, {high:g})"
            )
            return


def _goal_faults(case: _Case) -> Iterator[str]:
    """Observations and goals that are not finite or contradict their meaning."""
    steps, lanes = case.played.steps, range(len(case.ends))
    for name in ("obs", "achieved_goal", "outcome"):
        bad = ~np.isfinite(getattr(steps, name)).reshape(*steps.reward.shape, -1).all(axis=2)
        if bad.any():
            yield f"{case.place(*_first(bad))} has a {name} that is not finite"
    live = [slice(0, end + 1 if end >= 0 else None) for end in case.ends.tolist()]
    reached = np.concatenate([steps.goal_reached[i, live[i]] for i in lanes])
    goals = np.concatenate([steps.achieved_goal[i, live[i]] for i in lanes])
    if not reached.any():
        if case.shown:
            yield (
                f"no goal is reached in {len(reached)} steps, {case.shown} of the episodes being the "
                "demonstrator's; goal_reached says at which steps achieved_goal counts"
            )
    elif reached.sum() > LANES and (goals[reached] == goals[reached][0]).all():
        yield (
            f"achieved_goal is {shown(goals[reached][0].tolist())} at each of the {reached.sum()} steps "
            "at which a goal is reached; it must say which goal that is"
        )
    if case.env.spec.reward_confirms_goals:
        silent = (steps.reward > 0) & ~steps.goal_reached
        if silent.any():
            yield (
                f"{case.place(*_first(silent))} gives a positive reward although no goal is reached; with "
                "spec.reward_confirms_goals=True, goal_reached must be true there"
            )
    yield from _outcome_faults(case)


def _outcome_faults(case: _Case) -> Iterator[str]:
    """Episodes that solve their task, but whose outcome is not the goal of that task."""
    steps = case.played.steps
    wanted = np.asarray(jax.vmap(case.env.task_goal)(case.tasks))
    # Continuous goals are met within a tolerance that only the world knows. It is far below the distance
    # between the goals of two different tasks.
    apart = np.linalg.norm(wanted[:, None] - wanted[None], axis=-1)
    apart = apart[apart > 0]
    near = 0.5 * np.median(apart) if apart.size else 1e-3
    best = np.asarray(jax.jit(jax.vmap(case.env.optimal_return))(case.tasks))
    solved: list[tuple[int, int, bool]] = []
    missed: list[tuple[int, int, bool]] = []
    for lane, end in enumerate(case.ends.tolist()):
        if end < 0 or not steps.terminated[lane, end] or steps.failed[lane, end]:
            continue
        return_ = steps.reward[lane, : end + 1].sum()
        known = np.isfinite(best[lane])
        if return_ >= best[lane] - 1e-4 if known else steps.reward[lane, end] > 0:
            met = np.linalg.norm(steps.outcome[lane, end] - wanted[lane]) < near
            (solved if met else missed).append((lane, end, known))
    certain = [place for place in missed if place[2]]
    if certain or (missed and not solved):
        lane, end, known = (certain or missed)[0]
        how = "with the best return" if known else "with a reward"
        yield (
            f"{case.place(lane, end)} ends the episode {how}, and its outcome is "
            f"{shown(steps.outcome[lane, end].tolist())}; it must be the goal of the task, "
            f"{shown(wanted[lane].tolist())}"
        )


def _difference(a: _Played, b: _Played, tolerance: float = 0.0) -> tuple[int, int, str] | None:
    """The episode, step (0 for the reset) and field of the first difference between two runs."""
    found: list[tuple[int, int, str]] = []
    for name in TimeStep._fields:
        for mine, other, offset in ((a.first, b.first, 0), (a.steps, b.steps, 1)):
            x, y = (np.asarray(getattr(told, name)) for told in (mine, other))
            if x.ndim == 0:  # a constant
                continue
            rough = np.issubdtype(x.dtype, np.floating)
            same = np.isclose(x, y, tolerance, tolerance, equal_nan=True) if rough else x == y
            same = same.reshape(*x.shape[: 1 + offset], -1).all(axis=-1)
            if not same.all():
                place = _first(~same)
                found.append((place[0], place[1] + 1 if offset else 0, name))
    return min(found, key=lambda one: (one[1], one[0])) if found else None


def _at(case: _Case, where: tuple[int, int, str]) -> str:
    lane, step, name = where
    place = case.place(lane, step - 1) if step else f"the reset of episode {lane}"
    return f"{name} differs at {place}"


def _repetition_faults(case: _Case, repeated: _Played) -> Iterator[str]:
    """Differences between two runs with the same inputs."""
    if where := _difference(case.played, repeated):
        yield f"the world is not pure: the same keys, tasks and actions played twice, {_at(case, where)}"


def _chance_faults(case: _Case, notes: list[str]) -> Iterator[str]:
    """Contradictions between ``EnvSpec.deterministic`` and episodes with different keys."""
    others = jax.vmap(lambda key: jax.random.fold_in(key, 1))(case.keys)
    where = _difference(case.played, _numpy(case.play(others, case.tasks, case.actions)))
    if where and case.env.spec.deterministic:
        yield (
            "spec.deterministic is True, but with a different key and the same task and actions, "
            f"{_at(case, where)}"
        )
    if where is None and not case.env.spec.deterministic:
        notes.append(
            f"spec.deterministic is False, but {LANES} episodes were the same with different keys; set it "
            "to True if nothing in the world is random"
        )


def _program_faults(case: _Case) -> Iterator[str]:
    """Episodes that differ from those of the batch if they are run alone or without ``jit``."""
    lane = 0
    task = jax.tree.map(lambda leaf: leaf[lane], case.tasks)
    alone = jax.jit(
        partial(_play, case.env), compiler_options=dict(case.env.engine.compiler_options)
    )
    one = _numpy(alone(case.keys[lane], task, case.actions[lane]))
    kept = jax.tree.map(lambda rows: rows[lane : lane + 1], case.played)
    if where := _difference(kept, jax.tree.map(lambda leaf: leaf[None], one), CLOSE):
        yield (
            "vmap changes the results: compared with running the same episode alone, "
            f"{_at(case, where)}"
        )
    try:
        state, first = case.env.reset(case.keys[lane], task)
        told = []
        for action in case.actions[lane][:EAGER_STEPS]:
            state, timestep = case.env.step(state, action)
            told.append(timestep._replace(failed=jnp.asarray(timestep.failed)))
    except Exception as error:
        yield f"the world works only under jit; without jit it raises {_reason(error)}"
        return
    steps = jax.tree.map(lambda *rows: np.stack([np.asarray(row) for row in rows])[None], *told)
    eager = _Played(jax.tree.map(lambda leaf: np.asarray(leaf)[None], first), steps, None)
    short = jax.tree.map(lambda rows: rows[:, :EAGER_STEPS], kept.steps)
    if where := _difference(_Played(kept.first, short, None), eager, CLOSE):
        yield (
            "jit changes the results: compared with running the same episode without jit, "
            f"{_at(case, where)}"
        )
