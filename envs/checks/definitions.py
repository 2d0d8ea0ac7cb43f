"""Checks of a world's type, spec and functions, and of its tasks: what can be known without an episode."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment, Task, TimeStep
from envs.checks.values import equal, first_of, reason
from envs.errors import NotAvailableError, shown
from envs.specs import Box, Discrete, EnvSpec


def record_faults(env: Any) -> Iterator[str]:
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


def trace_faults(env: Environment) -> Iterator[str]:
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
                yield f"{name} is not defined ({reason(error)})"
            else:
                yield f"{name} cannot be compiled ({reason(error)})"
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


def shape_faults(env: Environment) -> Iterator[str]:
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


def draw(env: Environment, seed: int, num: int) -> tuple[Task, Task]:
    """``num`` random tasks, drawn twice with the same keys."""
    keys, program = jax.random.split(jax.random.key(seed), num), jax.jit(jax.vmap(env.sample_task))
    return program(keys), program(keys)


def task_faults(env: Environment, tasks: Task, again: Task, num_test_tasks: int) -> Iterator[str]:
    """Tasks that are invalid, not diverse enough, or not determined by their key."""
    num = len(jax.tree.leaves(tasks)[0])
    if not equal(tasks, again):
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
        yield f"task_goal of sampled task {first_of(~np.isfinite(goals))[0]} is not finite"
