"""The two compiled programs of an adaptation, which run many lanes (``mgpo_jax.lanes``) together."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from mgpo_jax.adaptation import proceed, start
from mgpo_jax.lanes import Lanes, Layout, over_lanes
from mgpo_jax.methods import Method, Setting, with_numbers


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
    """``((state, lanes), (params, rounds, judging, index of the segment)) -> (state, log, judged)``."""


def judge_key(key: PRNGKeyArray, number: int | Int[Array, ""]) -> PRNGKeyArray:
    """The random key of a judgement, counted from 0, in a search that started from ``key``.

    The search itself goes on with ``split(key)[1]``, which equals ``fold_in(key, 1)``, so judgement 1 has
    another number. Judgement 0 shares the key of ``Adapter.init``, from which no episode is played.
    """
    return jax.random.fold_in(key, jnp.where(number == 1, jnp.iinfo(jnp.int32).max, number))


@cache
def programs_of(
    method: Method,
    setting: Setting,
    fixed: Any,
    layout: Layout,
    max_rounds: int,
    keep_actions: bool,
) -> Programs:
    """The programs of an adaptation; calls with equal arguments share them within a process.

    Args:
      method: the method that adapts.
      setting: what it adapts to.
      fixed: its hyper-parameters, of which the numeric ones are replaced by those of a lane.
      layout: how the lanes are spread over devices.
      max_rounds: the largest number of rounds in a call.
      keep_actions: whether the log keeps continuous actions, too.
    """
    env = setting.env

    def begin(own: Lanes, params: Any) -> Any:
        adapter = method.adapter(setting, params, with_numbers(fixed, own.numbers))
        return start(own.key, env, adapter, own.task)

    def advance(own: tuple[Any, Lanes], shared: tuple[Any, Array, Array, Array]) -> Any:
        state, lane = own
        params, num_rounds, judging, number = shared
        return proceed(
            state,
            env,
            method.adapter(setting, params, with_numbers(fixed, lane.numbers)),
            lane.task,
            num_rounds,
            max_rounds=max_rounds,
            judge_key=judge_key(lane.key, number),
            num_judged=setting.judged.episodes,
            judging=judging,
            keep_actions=keep_actions,
            stopped=lane.stopped,
        )

    return Programs(
        Program(over_lanes(env, layout, begin)),
        Program(over_lanes(env, layout, advance)),
    )
