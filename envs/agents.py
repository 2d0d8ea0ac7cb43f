"""What acts in an episode: agents, and the demonstrators from which datasets are collected."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from envs.base import Environment


def keeps_its_size(memory: Any, num_steps: int) -> Any:
    """The ``grow`` of agents whose memory has a fixed size: returns the memory unchanged."""
    del num_steps
    return memory


class Agent(NamedTuple):
    """An agent that acts in an episode, such as a policy under a prompt, or the demonstrator of a dataset.

    ``begin`` and ``proceed`` return ``(action, quits, memory)``. An agent that quits ends the episode
    before the action is taken.
    """

    begin: Callable
    """``(key, task, state, timestep) -> (action, quits, memory)`` at the start of an episode."""
    proceed: Callable
    """``(key, memory, state, timestep) -> (action, quits, memory)`` after every step."""
    grow: Callable = keeps_its_size
    """``(memory, num_steps) -> memory`` with room for that many more steps."""
    decisions: Callable = lambda memory: ()
    """``(memory) -> decisions``: the decisions of the episode besides its actions, for agents whose
    decisions last several steps. It is called once all episodes of a batch have ended. Until then the agent
    continues to act, so it must store decisions by their step; those of the first ``length`` steps
    count."""
    intended: Callable[[Any], Array] | None = None
    """``(memory) -> action``: the action that the agent intended in its latest ``begin`` or ``proceed``,
    with the shape and dtype of the executed one. It is for demonstrators that sometimes execute other
    actions, such as random ones: policies read the executed actions as history, and imitate the intended
    ones (default: executed actions are the intended ones, and no others are kept)."""


class Demonstrator(NamedTuple):
    """The source of a dataset: tasks to demonstrate, and the agent that demonstrates them."""

    sample_task: Callable
    """``(key, index) -> task``: the task of the index-th demonstration."""
    agent: Callable[[Any], Agent]
    """``(weights) -> agent``."""
    keeps: Callable = lambda episode: episode.trajectory.length > 0
    """``(episode) -> bool``: whether to keep a demonstration; others are discarded and repeated."""
    hindsight_return: Callable | None = None
    """``(trajectory) -> return`` on the task that the trajectory accomplishes in hindsight (default: the
    return of the episode)."""
    weights: Any = ()
    """Arrays that the agent is made from, such as the parameters of a network; they are traced."""
    settings: tuple[tuple[str, float], ...] = ()
    """Names and values of the settings that the data depend on; a dataset made with others is out of
    date."""
    configured: Callable[[Mapping[str, float]], Demonstrator] | None = None
    """``(values) -> demonstrator`` with some of its settings changed; raises ``ValueError`` for a value out
    of range. None if the settings are fixed."""
    env: Environment | None = None
    """The world in which it demonstrates, if that differs from the world that the data are for. Both have
    the same observations, goals and actions, and equal tasks have equal fingerprints."""
    variants: tuple[str, ...] = ()
    """Names of the variants of the world, such as its scenes. Every task belongs to one variant."""
    variant: Callable = lambda task: jnp.zeros((), jnp.int32)
    """``(task) -> index`` into ``variants``, which a dataset stores for every trajectory."""
