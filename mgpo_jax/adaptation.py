"""Online adaptation: ask an adapter who acts, run an episode, tell it the result (paper, section 3.2).

Everything here is for one task; callers ``vmap`` over tasks and seeds.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, Shaped

from envs.base import Agent, Environment, EnvSpec, Episode, Goals, Task, Trajectory
from envs.episodes import run_episode
from mgpo_jax.prompts import hindsight_outcome
from mgpo_jax.trees import choose, put_row


class Adapter(NamedTuple):
    """Whatever adapts to a task: pure functions over a state of its own, for one task.

    A *choice* is a small pytree that says who acts in an episode: a prompt, a flag, an index.
    """

    init: Callable[[PRNGKeyArray, Float[Array, "G"]], Any]
    """``(key, task_goal) -> state``."""
    ask: Callable[[PRNGKeyArray, Any], tuple[Any, Any]]
    """``(key, state) -> (choice, state)``: who is to act in the next round."""
    agent: Callable[[Any, Any], Agent]
    """``(state, choice) -> agent``, which the one episode loop runs."""
    tell: Callable[[PRNGKeyArray, Any, Any, Episode], Any]
    """``(key, state, choice, episodes) -> state``; ``episodes`` has a leading axis, the episodes of the
    round."""
    best: Callable[[Any], Any]
    """``(state) -> choice``: the best one so far. It is judged in episodes outside of the budget, as the
    world's record says."""
    episodes_per_round: int = 1
    """Episodes that one choice is asked for. All of them count."""
    tell_in_turn: bool = False
    """Whether tasks that adapt side by side update one after the other, which saves memory where an
    update is large."""
    num_scored: Callable[[Any], Int[Array, ""]] | None = None
    """``(state) -> number`` of prompts that it scored so far by asking the policy, without an episode; None
    for those that learn by episodes alone."""


class AdaptState(NamedTuple):
    """An adaptation in progress."""

    key: PRNGKeyArray
    search: Any
    """State of the adapter."""


class Played(NamedTuple):
    """What is kept of an episode so that it can be shown and played again."""

    key: Shaped[Array, "*batch"]
    """The episode's random key, for ``envs.episodes.replay``."""
    actions: Array | None
    """``[T]`` small integers; the largest that the type holds stands in places after the end."""
    goals: Goals


class AdaptLog(NamedTuple):
    """What happened in R consecutive rounds of K episodes."""

    returns: Float[Array, "*batch R K"]
    failed: Bool[Array, "*batch R K"]
    """Whether the world broke down."""
    choices: Any
    """Who acted, [R, ..]."""
    best: Any
    """The best choice after each round, [R, ..]."""
    played: Played
    """The episodes, [R, K, ..]."""
    num_scored: Int[Array, "*batch R"] | None = None
    """Prompts that were scored without an episode until the end of each round; None where none can be."""


class Judged(NamedTuple):
    """The best choice in episodes outside of the budget."""

    return_: Float[Array, "*batch"]
    """Mean return."""
    num_failed: Int[Array, "*batch"]
    """How many episodes ended because the world broke down."""
    achieved: Float[Array, "*batch M"] | None = None
    """Share of the episodes that achieved each of the world's M named goals; None in worlds without any."""


def judge(
    returns: Float[Array, "J"],
    failed: Bool[Array, "J"],
    achieved: Bool[Array, "J M"] | None,
) -> Judged:
    """Mean return, number of failed episodes, and share that achieved each named goal, of J episodes.

    ``achieved`` is that of ``achieved_goals``.
    """
    shares = None if achieved is None else jnp.mean(achieved, axis=0)
    return Judged(returns.mean(), failed.sum(), shares)


def achieved_goals(env: Environment, goals: Goals | Trajectory) -> Bool[Array, "M"] | None:
    """Which of the world's M named goals an episode has achieved at its end; None without names."""
    num = len(env.goal_names)
    return hindsight_outcome(goals)[:num] > 0.5 if num else None


class AdaptResult(NamedTuple):
    """A finished adaptation to one task."""

    log: AdaptLog
    best: Any
    """The choice that the search ends with, such as the optimized prompt."""


def start(key: PRNGKeyArray, env: Environment, adapter: Adapter, task: Task) -> AdaptState:
    """The state before the first episode on ``task``."""
    key_init, key_run = jax.random.split(key)
    return AdaptState(key_run, adapter.init(key_init, env.task_goal(task)))


def search(
    key: PRNGKeyArray, env: Environment, adapter: Adapter, task: Task, num_episodes: int
) -> AdaptResult:
    """Adapt to one task within ``num_episodes`` episodes (Eq. 1).

    Raises:
      ValueError: if the budget is not a whole number of the adapter's rounds.
    """
    num_rounds = whole_rounds(adapter, num_episodes)
    state = start(key, env, adapter, task)
    state, log, _ = proceed(state, env, adapter, task, num_rounds, max_rounds=num_rounds)
    return AdaptResult(log, adapter.best(state.search))


def whole_rounds(adapter: Adapter, num_episodes: int) -> int:
    """The number of rounds in a budget of episodes."""
    rounds, rest = divmod(num_episodes, adapter.episodes_per_round)
    if rest or not rounds:
        raise ValueError(
            f"{num_episodes} episodes are not a whole number of rounds of {adapter.episodes_per_round}"
        )
    return rounds


def proceed(
    state: AdaptState,
    env: Environment,
    adapter: Adapter,
    task: Task,
    num_rounds: int | Int[Array, ""],
    *,
    max_rounds: int,
    judge_key: PRNGKeyArray | None = None,
    num_judged: int = 0,
    keep_actions: bool = False,
    stopped: Bool[Array, ""] | None = None,
) -> tuple[AdaptState, AdaptLog, Judged]:
    """The next rounds of a search, and then episodes that judge its best choice.

    Searching and judging are one loop, so that a program holds the code of an episode once.

    Args:
      state: the adaptation so far.
      env: the world (static).
      adapter: who adapts.
      task: the task.
      num_rounds: number of rounds to run (traced).
      max_rounds: room in the log; the entries from ``num_rounds`` on are meaningless.
      judge_key: random key of the judging episodes (default: none are run).
      num_judged: number of the judging episodes (static).
      keep_actions: whether the log also keeps continuous actions.
      stopped: whether the search has ended before: then episodes have no steps and nothing changes
        (default: it has not, which costs no test).
    """
    judge_keys = None if judge_key is None else jax.random.split(judge_key, num_judged)

    @jax.jit  # traced once: for the shapes of the log, and in the loop
    def entry(state: AdaptState, index: Array) -> tuple[AdaptState, AdaptLog]:
        searching = jnp.ones((), bool) if judge_keys is None else index < num_rounds
        own_key = None if judge_keys is None else judge_keys[jnp.maximum(index - num_rounds, 0)]
        return _round(state, env, adapter, task, searching, own_key, keep_actions, stopped)

    shapes = jax.eval_shape(entry, state, jnp.int32(0))[1]
    size = max_rounds + num_judged
    blank = jax.tree.map(lambda leaf: _zeros((size, *leaf.shape), leaf.dtype), shapes)

    def body(index: Array, carry: tuple[AdaptState, AdaptLog]) -> tuple[AdaptState, AdaptLog]:
        state, row = entry(carry[0], index)
        return state, put_row(carry[1], row, index)

    state, log = jax.lax.fori_loop(0, num_rounds + num_judged, body, (state, blank))
    judged = Judged(jnp.float32(jnp.nan), jnp.int32(0))
    if num_judged:
        returns, failed, goals = jax.tree.map(
            lambda rows: jax.lax.dynamic_slice_in_dim(rows[:, 0], num_rounds, num_judged),
            (log.returns, log.failed, log.played.goals),
        )
        judged = judge(returns, failed, jax.vmap(partial(achieved_goals, env))(goals))
    return state, jax.tree.map(lambda rows: rows[:max_rounds], log), judged


def _round(
    state: AdaptState,
    env: Environment,
    adapter: Adapter,
    task: Task,
    searching: Bool[Array, ""],
    judge_key: PRNGKeyArray | None,
    keep_actions: bool,
    stopped: Bool[Array, ""] | None,
) -> tuple[AdaptState, AdaptLog]:
    """One round of the search, or (not ``searching``) one judging episode, which changes nothing."""
    key, key_ask, key_run, key_tell = jax.random.split(state.key, 4)
    choice, asked = adapter.ask(key_ask, state.search)
    num = adapter.episodes_per_round
    keys = key_run[None] if num == 1 else jax.random.split(key_run, num)
    if judge_key is not None:
        choice, asked = choose(
            searching, (choice, asked), (adapter.best(state.search), state.search)
        )
        # The same judging episodes for every method, however many episodes its rounds have.
        judge_keys = jnp.broadcast_to(judge_key, keys.shape)
        key, keys = choose(searching, (key, keys), (state.key, judge_keys))
    if stopped is not None:
        choice = choose(stopped, adapter.best(state.search), choice)
    agent = adapter.agent(asked, choice)
    if stopped is not None:
        agent = idle_when(stopped, agent)
    wanted = jnp.where(searching, num, 1)
    episodes = _episodes(keys, env, agent, task, wanted)

    def told() -> Any:
        tell = in_turn(adapter.tell) if adapter.tell_in_turn else adapter.tell
        return tell(key_tell, asked, choice, episodes)

    after = told() if judge_key is None else jax.lax.cond(searching, told, lambda: state.search)
    if stopped is not None:
        after = choose(stopped, state.search, after)
    kept = env.spec.discrete or keep_actions
    log = AdaptLog(
        returns=episodes.return_,
        failed=jnp.broadcast_to(jnp.asarray(episodes.failed), (num,)),
        choices=choice,
        best=adapter.best(after),
        played=Played(
            key=keys,
            actions=small_actions(env.spec, episodes) if kept else None,
            goals=episodes.trajectory.goals,
        ),
        num_scored=None if adapter.num_scored is None else adapter.num_scored(after),
    )
    return AdaptState(key, after), log


def idle_when(stopped: Bool[Array, ""], agent: Agent) -> Agent:
    """The agent, which quits before its first step where its search has ended."""

    def begin(key: PRNGKeyArray, task: Task, state: Any, timestep: Any) -> tuple[Any, Any, Any]:
        action, quits, memory = agent.begin(key, task, state, timestep)
        return action, quits | stopped, memory

    return agent._replace(begin=begin)


def in_turn(function: Callable) -> Callable:
    """The same function, which ``vmap`` computes for one lane after the other.

    What it closes over becomes an argument: ``sequential_vmap`` by itself accepts nothing there that
    differs between lanes, such as the hyper-parameters of a sweep.
    """

    def call(*args: Any) -> Any:
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)

        @jax.custom_batching.sequential_vmap
        def run(consts: list[Any], leaves: list[Any]) -> list[Any]:
            return jax.core.eval_jaxpr(closed.jaxpr, consts, *leaves)

        leaves = run(closed.consts, jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(shapes), leaves)

    return call


def _episodes(
    keys: Key[Array, "K"], env: Environment, agent: Agent, task: Task, wanted: Int[Array, ""]
) -> Episode:
    """The first ``wanted`` episodes of ``agent``, one for each of the keys [K]; the others are zeros."""
    if len(keys) == 1:
        only = run_episode(keys[0], env, agent, task)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], only)
    shapes = jax.eval_shape(lambda: run_episode(keys[0], env, agent, task))
    blank = jax.tree.map(lambda leaf: _zeros((len(keys), *leaf.shape), leaf.dtype), shapes)

    def body(index: Array, rows: Episode) -> Episode:
        return put_row(rows, run_episode(keys[index], env, agent, task), index)

    return jax.lax.fori_loop(0, wanted, body, blank)


def small_actions(spec: EnvSpec, episodes: Episode) -> Array:
    """Actions of episodes in as few bytes as they need; continuous ones as they are.

    Discrete actions have one byte, or two where there are more than 255 of them; the largest number that
    the type holds stands in the places after the end of an episode.
    """
    actions = episodes.trajectory.actions
    if not spec.discrete:
        return actions
    dtype = jnp.uint8 if spec.action_dim <= 255 else jnp.uint16
    real = jnp.arange(actions.shape[-1]) < episodes.trajectory.length[..., None]
    return jnp.where(real, actions, jnp.iinfo(dtype).max).astype(dtype)


def _zeros(shape: tuple[int, ...], dtype: Any) -> Array:
    """Zeros, or random keys of zeros."""
    if jnp.issubdtype(dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(jax.random.key(0, impl=dtype._impl.name), shape)
    return jnp.zeros(shape, dtype)
