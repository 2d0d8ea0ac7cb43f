"""Two-level hierarchies: every k steps the high level makes a decision, on which the low level acts.

SPiRL and PTGM are both of this form. Decisions are made at the steps 0, k, 2k, .. of an episode, at the
same time for all episodes of a batch, which step together.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.agents import Agent, keeps_its_size
from envs.base import Episode, State, Task, TimeStep
from mgpo_jax.adaptation import Adapter


class Mlp(nn.Module):
    """A multilayer perceptron with hidden layers of one width."""

    num_outputs: int
    width: int = 128
    depth: int = 3
    starts_at_zero: bool = False
    """Whether all outputs are 0 before the first update."""

    @nn.compact
    def __call__(self, x: Float[Array, "*batch I"]) -> Float[Array, "*batch O"]:
        for _ in range(self.depth):
            x = nn.relu(nn.Dense(self.width)(x))
        last: Any = {"kernel_init": nn.initializers.zeros} if self.starts_at_zero else {}
        found: Array = nn.Dense(self.num_outputs, **last)(x)
        return found


class Choice(NamedTuple):
    """How a high level that draws its decisions from a distribution makes those of an episode."""

    greedy: Bool[Array, "*batch"]
    """Whether it takes the mode of the distribution instead of a sample."""


class LowLevel(NamedTuple):
    """The low level, which acts between decisions; all functions are pure and for one episode."""

    begin: Callable[[Array], tuple[Any, Any]]
    """``(obs) -> (view, carry)`` at the first observation. The view is the input of the high level."""
    proceed: Callable[[Any, Array, Array], tuple[Any, Any]]
    """``(carry, action, obs) -> (view, carry)`` after every step."""
    command: Callable[[Any, Any], Any]
    """``(carry, decision) -> orders``: the decision in the form that ``act`` needs for all of its steps."""
    act: Callable[[PRNGKeyArray, Any, Any, Int[Array, ""]], Array]
    """``(key, carry, orders, index) -> action``, ``index`` steps after the decision."""
    grow: Callable[[Any, int], Any] = keeps_its_size
    """``(carry, num_steps) -> carry`` with room for that many more steps."""


Decide = Callable[[PRNGKeyArray, Any, State], tuple[Any, Any]]
"""``(key, view, state) -> (decision, kept)``: ``kept`` is what a learner needs to remember about the
decision. Only reference agents, which do not learn, may look at the state of the world."""


class _Memory(NamedTuple):
    time: Int[Array, ""]
    carry: Any
    action: Array
    orders: Any
    kept: Any
    """The values ``kept`` of the decisions so far, [M, ..]."""


def num_decisions(horizon: int, skill_steps: int) -> int:
    """M, the largest number of decisions in an episode."""
    return -(-horizon // skill_steps)


def hierarchical(low: LowLevel, decide: Decide, skill_steps: int, horizon: int) -> Agent:
    """The agent of a two-level hierarchy.

    Args:
      low: the low level.
      decide: the high level.
      skill_steps: k, the number of steps between two decisions.
      horizon: the largest number of steps of an episode.
    """
    num = num_decisions(horizon, skill_steps)

    def decided(key: PRNGKeyArray, view: Any, carry: Any, state: State) -> tuple[Any, Any]:
        """Make a new decision; returns its orders and what is kept of it."""
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

        # All episodes of a batch share the step counter, so only one branch is computed.
        orders, kept = jax.lax.cond(index == 0, anew, lambda: (memory.orders, memory.kept))
        action = low.act(key_act, carry, orders, index)
        after = _Memory(memory.time + 1, carry, action, orders, kept)
        return action, jnp.zeros((), bool), after

    def grow(memory: _Memory, num_steps: int) -> _Memory:
        return memory._replace(carry=low.grow(memory.carry, num_steps))

    # If the low level's memory does not grow, the whole episode can be one loop.
    fixed = low.grow is keeps_its_size
    growing = keeps_its_size if fixed else grow
    return Agent(begin, proceed, growing, decisions=lambda memory: memory.kept)


class Transitions(NamedTuple):
    """The decisions of episodes in order, rows [M, ..]; the successor of a decision is the next row."""

    kept: Any
    """The values ``kept`` of each decision."""
    reward: Float[Array, "*M"]
    """Plain sum of the rewards of the decision's steps."""
    done: Bool[Array, "*M"]
    """Whether the episode ended, or was cut at the horizon, before the next decision."""
    valid: Bool[Array, "*M"]
    """Whether the decision was made before the end of the episode; other rows are meaningless."""


def transitions(episode: Episode, skill_steps: int) -> Transitions:
    """The decisions of one episode of a hierarchical agent, as transitions."""
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
    """A replay buffer of all transitions of an adaptation so far, in its first ``size`` rows."""

    rows: Transitions
    size: Int[Array, "*batch"]


def empty_replay(kept: Any, num_decisions: int, num_episodes: int) -> Replay:
    """An empty replay buffer with room for all decisions of a budget.

    Args:
      kept: zeros with the shapes of what is kept of one decision.
      num_decisions: the largest number of decisions in an episode.
      num_episodes: the budget, in episodes.
    """
    capacity = num_decisions * num_episodes
    numbers, flags = jnp.zeros(capacity), jnp.zeros(capacity, bool)
    rows = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), kept)
    return Replay(Transitions(rows, numbers, flags, flags), jnp.zeros((), jnp.int32))


def remember(replay: Replay, new: Transitions) -> Replay:
    """Append the valid transitions of an episode. The buffer must have room for them."""
    capacity = len(replay.rows.valid)
    place = jnp.where(new.valid, replay.size + jnp.cumsum(new.valid) - 1, capacity)
    rows = jax.tree.map(lambda rows, more: rows.at[place].set(more, mode="drop"), replay.rows, new)
    return Replay(rows, replay.size + new.valid.sum())


def draw(key: PRNGKeyArray, replay: Replay, num: int) -> tuple[Transitions, Transitions]:
    """Draw ``num`` transitions uniformly with replacement; returns them and their successors.

    The successor of a transition that is ``done`` is meaningless. The buffer must not be empty.
    """
    index = jax.random.randint(key, (num,), 0, replay.size)
    after = jnp.minimum(index + 1, len(replay.rows.valid) - 1)
    drawn, following = (
        jax.tree.map(lambda rows, i=i: rows[i], replay.rows) for i in (index, after)
    )
    return drawn, following


def reference(agent: Agent, choice: Any) -> Adapter:
    """Wrap an agent that does not learn in an adapter, whose choice is always the same."""
    return Adapter(
        init=lambda key, task_goal: (),
        ask=lambda key, state: (choice, state),
        agent=lambda state, choice: agent,
        tell=lambda key, state, choice, episodes: state,
        best=lambda state: choice,
    )
