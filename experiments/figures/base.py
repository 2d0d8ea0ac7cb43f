"""What a world may draw beside curves, and what its drawings share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment
from experiments.results import Results
from mgpo_jax.policy import Policy
from mgpo_jax.rollout import rollout
from mgpo_jax.types import Episode, Prompt, Query

NUM_ROLLOUTS = 64
STAGES = (1, 10, 20, 40, 100)

Save = Callable[[Path], object]
"""Writes one picture to a path."""
LoadPolicy = Callable[[Results], Policy]
"""The policy that some results were made with."""
DrawRun = Callable[[Results, Sequence[int]], Iterator[tuple[str, Save]]]
DrawAll = Callable[
    [Mapping[str, Results], LoadPolicy, Sequence[int], int], Iterator[tuple[str, Save]]
]


class Pictures(NamedTuple):
    """What a world draws of adaptations to it, as pairs of a file's name and who writes it."""

    draw_run: DrawRun
    """``(result, tasks)``: what needs no policy."""
    draw_all: DrawAll
    """``(results by label, load, tasks, seed)``: everything."""


NO_PICTURES = Pictures(lambda *_: iter(()), lambda *_: iter(()))


def file_names(results: Iterable[Results]) -> dict[str, Results]:
    """Results by method, and number where one method ran more than once."""
    names: dict[str, Results] = {}
    for number, result in enumerate(results):
        method = result.config["bandit"]
        names[f"{method}_{number}" if method in names else method] = result
    return names


@partial(jax.jit, static_argnames=("env", "policy"))
def run_policy(
    key: jax.Array,
    env: Environment,
    policy: Policy,
    task: Any,
    prompt: Prompt,
    greedy: bool | jax.Array = False,
) -> Episode:
    """``NUM_ROLLOUTS`` episodes under one prompt."""
    query = Query(prompt, jnp.asarray(greedy))
    episode = jax.vmap(lambda k: rollout(k, env, policy, task, query, "lanes"), axis_name="lanes")
    return episode(jax.random.split(key, NUM_ROLLOUTS))


def goals_of(prompt: Prompt) -> np.ndarray:
    """The goals of one prompt, ``[k, G]``."""
    return np.asarray(prompt.goals)[np.asarray(prompt.mask)]
