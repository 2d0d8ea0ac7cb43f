"""Hierarchies of two levels: every k steps the high level decides, and the low level acts on the decision.

SPiRL and PTGM are both of this form. Decisions fall on the steps 0, k, 2k, .. of an episode, for all
episodes of a batch, which share one clock.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import Agent, Episode, State, Task, TimeStep, keeps_its_size
from mgpo_jax.adaptation import Adapter


class Mlp(nn.Module):
    """A multilayer perceptron with hidden layers of one width."""

    num_outputs: int
    width: int = 128
    depth: int = 3

    @nn.compact
    def __call__(self, x: Float[Array, "*batch I"]) -> Float[Array, "*batch O"]:
        for _ in range(self.depth):
            x = nn.relu(nn.Dense(self.width)(x))
        found: Array = nn.Dense(self.num_outputs)(x)
        return found


class LowLevel(NamedTuple):
    """Who acts between decisions; all functions are pure and for one episode."""

    begin: Callable[[Array], tuple[Any, Any]]
    """``(obs) -> (view, carry)`` at the first observation. A view is what a high level decides by."""
    proceed: Callable[[Any, Array, Array], tuple[Any, Any]]
    """``(carry, action, obs) -> (view, carry)`` after every step."""
    command: Callable[[Any, Any], Any]
    """``(carry, decision) -> orders``: what a decision says for all of its steps."""
    act: Callable[[PRNGKeyArray, Any, Any, Int[Array, ""]], Array]
    """``(key, carry, orders, index) -> action`` in the ``index``-th step after the decision."""
    grow: Callable[[Any, int], Any] = keeps_its_size
    """``(carry, num_steps) -> carry`` with room for that many more steps."""


Decide = Callable[[PRNGKeyArray, Any, State], tuple[Any, Any]]
"""``(key, view, state) -> (decision, kept)``: ``kept`` is what a learner wants to know of it later. Only
references, which learn nothing, may look at the state of the world."""


class _Memory(NamedTuple):
    time: Int[Array, ""]
    carry: Any
    action: Array
    orders: Any
    kept: Any
    """What was kept of the decisions so far, [M, ..]."""


def num_decisions(horizon: int, skill_steps: int) -> int:
    """M, the largest number of decisions in an episode."""
    return -(-horizon // skill_steps)


def hierarchical(low: LowLevel, decide: Decide, skill_steps: int, horizon: int) -> Agent:
    """The agent of two levels.

    Args:
      low: who acts.
      decide: who decides.
      skill_steps: k, the number of steps between two decisions.
      horizon: the largest number of steps of an episode.
    """
    num = num_decisions(horizon, skill_steps)

    def decided(key: PRNGKeyArray, view: Any, carry: Any, state: State) -> tuple[Any, Any]:
        """The orders of a new decision, and what is kept of it."""
        decision, kept = decide(key, view, state)
        return low.command(carry, decision), kept

    def begin(key: PRNGKeyArray, task: Task, state: State, timestep: TimeStep) -> tuple:
        del task
        key_decide, key_act = jax.random.split(key)
        view, carry = low.begin(timestep.obs)
        orders, row = decided(key_decide, view, carry, state)
        rows = jax.tree.map(
            lambda leaf: jnp.zeros((num, *leaf.shape), leaf.dtype).at[0].set(leaf), row
        )
        action = low.act(key_act, carry, orders, jnp.int32(0))
        memory = _Memory(jnp.ones((), jnp.int32), carry, action, orders, rows)
        return action, jnp.zeros((), bool), memory

    def proceed(key: PRNGKeyArray, memory: _Memory, state: State, timestep: TimeStep) -> tuple:
        key_decide, key_act = jax.random.split(key)
        view, carry = low.proceed(memory.carry, memory.action, timestep.obs)
        index = memory.time % skill_steps

        def anew() -> tuple[Any, Any]:
            orders, row = decided(key_decide, view, carry, state)
            at = memory.time // skill_steps
            put = lambda rows, new: jax.lax.dynamic_update_index_in_dim(rows, new, at, 0)  # noqa: E731
            return orders, jax.tree.map(put, memory.kept, row)

        # The clock is one number for a whole batch, so that only one branch is computed.
        orders, kept = jax.lax.cond(index == 0, anew, lambda: (memory.orders, memory.kept))
        action = low.act(key_act, carry, orders, index)
        after = _Memory(memory.time + 1, carry, action, orders, kept)
        return action, jnp.zeros((), bool), after

    def grow(memory: _Memory, num_steps: int) -> _Memory:
        return memory._replace(carry=low.grow(memory.carry, num_steps))

    # A low level that needs no more room lets the whole episode be one loop.
    fixed = low.grow is keeps_its_size
    growing = keeps_its_size if fixed else grow
    return Agent(begin, proceed, growing, decisions=lambda memory: memory.kept)


class Transitions(NamedTuple):
    """Decisions in the order in which they were made, rows [M, ..]; each leads to the next row's."""

    kept: Any
    """What was kept of each."""
    reward: Float[Array, "*M"]
    """Plain sum of the rewards of the decision's steps."""
    done: Bool[Array, "*M"]
    """Whether the episode ended, or was cut at the horizon, before another decision."""
    valid: Bool[Array, "*M"]
    """Whether the decision was made in the episode; those after its end mean nothing."""


def transitions(episode: Episode, skill_steps: int) -> Transitions:
    """The decisions of one episode of a hierarchical agent."""
    horizon = len(episode.rewards)
    num = num_decisions(horizon, skill_steps)
    padded = jnp.pad(episode.rewards, (0, num * skill_steps - horizon))
    start = jnp.arange(num) * skill_steps
    length = episode.trajectory.length
    return Transitions(
        kept=episode.decisions,
        reward=padded.reshape(num, skill_steps).sum(axis=1),
        done=start + skill_steps >= length,
        valid=start < length,
    )


class Replay(NamedTuple):
    """All transitions of an adaptation so far: the first ``size`` rows."""

    rows: Transitions
    size: Int[Array, "*batch"]


def empty_replay(kept: Any, num_decisions: int, num_episodes: int) -> Replay:
    """A replay without rows, with room for all decisions of a budget.

    Args:
      kept: zeros of the shapes of what is kept of one decision.
      num_decisions: the largest number of decisions in an episode.
      num_episodes: the budget.
    """
    capacity = num_decisions * num_episodes
    numbers, flags = jnp.zeros(capacity), jnp.zeros(capacity, bool)
    rows = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), kept)
    return Replay(Transitions(rows, numbers, flags, flags), jnp.zeros((), jnp.int32))


def remember(replay: Replay, new: Transitions) -> Replay:
    """The replay with the valid ones of an episode's transitions. It has to have room for them."""
    capacity = len(replay.rows.valid)
    place = jnp.where(new.valid, replay.size + jnp.cumsum(new.valid) - 1, capacity)
    rows = jax.tree.map(lambda rows, more: rows.at[place].set(more, mode="drop"), replay.rows, new)
    return Replay(rows, replay.size + new.valid.sum())


def draw(key: PRNGKeyArray, replay: Replay, num: int) -> tuple[Transitions, Transitions]:
    """``num`` transitions, drawn uniformly and with replacement, and the ones that follow them.

    What follows a transition that is ``done`` is of another episode or nothing. The replay must not be
    empty.
    """
    index = jax.random.randint(key, (num,), 0, replay.size)
    after = jnp.minimum(index + 1, len(replay.rows.valid) - 1)
    drawn, following = (
        jax.tree.map(lambda rows, i=i: rows[i], replay.rows) for i in (index, after)
    )
    return drawn, following


def reference(agent: Agent, choice: Any) -> Adapter:
    """An agent that learns nothing, as an adapter whose choice is always the same."""
    return Adapter(
        init=lambda key, task_goal: (),
        ask=lambda key, state: (choice, state),
        agent=lambda state, choice: agent,
        tell=lambda key, state, choice, episodes: state,
        best=lambda state: choice,
    )
