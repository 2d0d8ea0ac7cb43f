"""Online adaptation: ask an adapter what to run, run it, tell it the result (paper, section 3.2).

Everything here is written for one task; callers ``vmap`` over tasks and seeds.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, Shaped

from envs.agents import Agent
from envs.base import Environment, Episode, Goals, Task, Trajectory
from envs.episodes import run_episode
from envs.specs import EnvSpec
from mgpo_jax.prompts import hindsight_outcome
from mgpo_jax.trees import choose, put_row

CHECK_RETURNS = (
    "check the world's rewards (`python -m experiments.check WORLD`) and the policy's weights"
)
"""How to find the reason of a return that is not finite, the end of a message."""


class Adapter(NamedTuple):
    """A method that adapts to one task, as pure functions over an explicit state.

    A *choice* is a small pytree that selects how the next episodes are acted: a prompt, a flag or an index.
    """

    init: Callable[[PRNGKeyArray, Float[Array, "G"]], Any]
    """``(key, task_goal) -> state``."""
    ask: Callable[[PRNGKeyArray, Any], tuple[Any, Any]]
    """``(key, state) -> (choice, state)``: the choice to run in the next round."""
    agent: Callable[[Any, Any], Agent]
    """``(state, choice) -> agent``: the agent that ``envs.episodes.run_episode`` runs for a choice."""
    tell: Callable[[PRNGKeyArray, Any, Any, Episode], Any]
    """``(key, state, choice, episodes) -> state``: the update. The leading axis of ``episodes`` is the
    K episodes of the round."""
    best: Callable[[Any], Any]
    """``(state) -> choice``: the best choice so far. It is judged in episodes that do not count against the
    budget, as the world's record (``Judgement``) prescribes."""
    episodes_per_round: int = 1
    """K, the number of episodes that are run with each choice. All of them count against the budget."""
    tell_in_turn: bool = False
    """Whether ``vmap`` over tasks runs ``tell`` for one task after another. This saves memory where an
    update is large."""
    num_scored: Callable[[Any], Int[Array, ""]] | None = None
    """``(state) -> number`` of prompts that were rehearsed so far: the policy acted under them in a model
    of the task, without an episode. None for methods that learn from episodes alone."""


class AdaptState(NamedTuple):
    """An adaptation in progress."""

    key: PRNGKeyArray
    search: Any
    """State of the adapter."""


class Played(NamedTuple):
    """The part of an episode that is kept, from which it can be drawn and replayed."""

    key: Shaped[Array, "*batch"]
    """The episode's random key, for ``envs.episodes.replay``."""
    actions: Array | None
    """Actions ``[.., T]``, as ``small_actions`` encodes them; None if they were not kept."""
    goals: Goals


class AdaptLog(NamedTuple):
    """The record of R consecutive rounds of K episodes."""

    returns: Float[Array, "*batch R K"]
    failed: Bool[Array, "*batch R K"]
    """Whether the episode ended because the simulation failed."""
    choices: Any
    """The choice of each round, [R, ..]."""
    best: Any
    """The best choice after each round, [R, ..]."""
    played: Played
    """The episodes, [R, K, ..]."""
    num_scored: Int[Array, "*batch R"] | None = None
    """Cumulative number of prompts rehearsed at the end of each round; None if the method rehearses none
    (``Adapter.num_scored``)."""


class Judged(NamedTuple):
    """How well the best choice did in judging episodes, which do not count against the budget."""

    return_: Float[Array, "*batch"]
    """Mean return."""
    num_failed: Int[Array, "*batch"]
    """Number of episodes that ended because the simulation failed."""
    achieved: Float[Array, "*batch M"] | None = None
    """Fraction of the episodes that achieved each of the world's M named goals; None in worlds without
    named goals."""


def judge(
    returns: Float[Array, "J"],
    failed: Bool[Array, "J"],
    achieved: Bool[Array, "J M"] | None,
) -> Judged:
    """Summarize J judging episodes.

    Args:
      returns: their returns.
      failed: whether each ended because the simulation failed.
      achieved: which of the M named goals each achieved (``achieved_goals``), or None.
    """
    shares = None if achieved is None else jnp.mean(achieved, axis=0)
    return Judged(returns.mean(), failed.sum(), shares)


def achieved_goals(env: Environment, goals: Goals | Trajectory) -> Bool[Array, "M"] | None:
    """Which of the world's M named goals an episode has achieved by its end; None if no goals are named."""
    num = len(env.goal_names)
    return hindsight_outcome(goals)[:num] > 0.5 if num else None


class AdaptResult(NamedTuple):
    """A finished adaptation to one task."""

    log: AdaptLog
    best: Any
    """The best choice at the end of the search, such as the optimized prompt."""


def start(key: PRNGKeyArray, env: Environment, adapter: Adapter, task: Task) -> AdaptState:
    """The state of an adaptation before its first episode on ``task``."""
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
            f"{num_episodes} episodes are not a whole number of rounds; give a multiple of "
            f"{adapter.episodes_per_round}"
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
    judging: bool | Bool[Array, ""] = True,
    keep_actions: bool = False,
    stopped: Bool[Array, ""] | None = None,
) -> tuple[AdaptState, AdaptLog, Judged]:
    """Run the next rounds of a search, and then the episodes that judge its best choice.

    Searching and judging share one loop, so that the code of an episode is compiled only once.

    Args:
      state: the adaptation so far.
      env: the world (static).
      adapter: the method that adapts.
      task: the task.
      num_rounds: number of rounds to run (traced).
      max_rounds: number of rounds that the log has room for (static); its entries from ``num_rounds`` on
        are meaningless.
      judge_key: random key of the judging episodes (default: none are run).
      num_judged: number of judging episodes (static).
      judging: whether the judging episodes are run after these rounds (traced).
      keep_actions: whether the log keeps continuous actions, too; discrete actions are always kept.
      stopped: whether the search had already ended, so that its episodes have no steps and its state does
        not change; None, the default, compiles no test for it.

    Returns:
      The new state, the log, and the judgement (NaN if no episodes judge, meaningless if not ``judging``).
    """
    judge_keys = None if judge_key is None else jax.random.split(judge_key, num_judged)

    def entry(state: AdaptState, index: Array) -> tuple[AdaptState, AdaptLog]:
        searching = jnp.ones((), bool) if judge_keys is None else index < num_rounds
        own_key = None if judge_keys is None else judge_keys[jnp.maximum(index - num_rounds, 0)]
        return _round(state, env, adapter, task, searching, own_key, keep_actions, stopped)

    traced, (_, row) = traced_once(entry, state, jnp.int32(0))
    blank = _blank_rows(max_rounds + num_judged, row)

    def body(index: Array, carry: tuple[AdaptState, AdaptLog]) -> tuple[AdaptState, AdaptLog]:
        state, row = traced(carry[0], index)
        return state, put_row(carry[1], row, index)

    num_judging = num_judged if judging is True else jnp.where(judging, num_judged, 0)
    state, log = jax.lax.fori_loop(0, num_rounds + num_judging, body, (state, blank))
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
    """Run one round of the search or, if not ``searching``, one judging episode, which keeps the state."""
    key, key_ask, key_run, key_tell = jax.random.split(state.key, 4)
    num = adapter.episodes_per_round
    keys = key_run[None] if num == 1 else jax.random.split(key_run, num)

    def ask() -> tuple[Any, Any]:
        return adapter.ask(key_ask, state.search)

    if judge_key is None:
        choice, asked = ask()
    else:
        # A branch rather than a selection, because a method may search for long before it chooses.
        choice, asked = jax.lax.cond(
            searching, ask, lambda: (adapter.best(state.search), state.search)
        )
        # All methods are judged with the same keys, however many episodes their rounds have.
        judge_keys = jnp.broadcast_to(judge_key, keys.shape)
        key, keys = choose(searching, (key, keys), (state.key, judge_keys))
    if stopped is not None:
        choice = choose(stopped, adapter.best(state.search), choice)
    agent = adapter.agent(asked, choice)
    if stopped is not None:
        agent = idle_when(stopped, agent)
    wanted = jnp.where(searching, num, 1)
    episodes = _episodes(keys, env, agent, task, wanted)

    def update() -> Any:
        tell = in_turn(adapter.tell) if adapter.tell_in_turn else adapter.tell
        return tell(key_tell, asked, choice, episodes)

    after = update() if judge_key is None else jax.lax.cond(searching, update, lambda: state.search)
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
    """The same agent, except that it quits before its first step if its search has ended (``stopped``)."""

    def begin(key: PRNGKeyArray, task: Task, state: Any, timestep: Any) -> tuple[Any, Any, Any]:
        action, quits, memory = agent.begin(key, task, state, timestep)
        return action, quits | stopped, memory

    return agent._replace(begin=begin)


def traced_once(function: Callable, *args: Any) -> tuple[Callable, Any]:
    """The same function, not to be traced again for these shapes, and the shapes of its results.

    Tracing is most of what starting a program from the cache costs, and jax forgets it between a question
    for shapes and a loop.
    """
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)

    def call(*args: Any) -> Any:
        leaves = jax.core.eval_jaxpr(closed.jaxpr, closed.consts, *jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(shapes), leaves)

    return call, shapes


def in_turn(function: Callable) -> Callable:
    """The same function, except that ``vmap`` evaluates it for one lane after another.

    Traced values that ``function`` closes over are turned into arguments, because ``sequential_vmap``
    cannot batch over closed-over values such as the hyper-parameters of a sweep.
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
    """Run the first ``wanted`` of K episodes, one for each key; the rows of the others are zeros."""
    if len(keys) == 1:
        only = run_episode(keys[0], env, agent, task)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], only)
    shapes = jax.eval_shape(lambda: run_episode(keys[0], env, agent, task))
    blank = _blank_rows(len(keys), shapes)

    def body(index: Array, rows: Episode) -> Episode:
        return put_row(rows, run_episode(keys[index], env, agent, task), index)

    return jax.lax.fori_loop(0, wanted, body, blank)


def small_actions(spec: EnvSpec, episodes: Episode) -> Array:
    """The actions of episodes in a compact encoding.

    Discrete actions become uint8, or uint16 in worlds with more than 255 actions; the places after the end
    of an episode hold the largest value of that type. Continuous actions are returned unchanged.
    """
    actions = episodes.trajectory.actions
    if not spec.discrete:
        return actions
    dtype = jnp.uint8 if spec.action_dim <= 255 else jnp.uint16
    real = jnp.arange(actions.shape[-1]) < episodes.trajectory.length[..., None]
    return jnp.where(real, actions, jnp.iinfo(dtype).max).astype(dtype)


def _blank_rows(num: int, shapes: Any) -> Any:
    """``num`` rows of zeros for each of the ``shapes``."""
    return jax.tree.map(lambda leaf: _zeros((num, *leaf.shape), leaf.dtype), shapes)


def _zeros(shape: tuple[int, ...], dtype: Any) -> Array:
    """An array of zeros; for the dtype of random keys, an array of the key with seed 0."""
    if jnp.issubdtype(dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(jax.random.key(0, impl=dtype._impl.name), shape)
    return jnp.zeros(shape, dtype)
