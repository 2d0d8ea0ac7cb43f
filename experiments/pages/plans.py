"""What the method ``plan`` knew after each episode, recomputed by telling it the recorded episodes again.

A plan keeps one of three models of its task (``mgpo_jax.planning``): a map, an order, or an estimate of the
worths of prompts. The first two learn from the steps of episodes, so the episodes are replayed from their
actions by the rules of the world; the estimate only needs returns. The policy never acts, so no weights are
needed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Episode
from envs.episodes import replay
from envs.errors import DataError
from envs.specs import EnvSpec
from experiments.pages.knowledge import (
    blank_episode,
    check_not_stopped,
    disagreement,
    told_adapter,
)
from experiments.pages.packing import smallest
from experiments.store.results import Results
from mgpo_jax.adaptation import Adapter
from mgpo_jax.planning.maps import MapState
from mgpo_jax.planning.orders import NONE, OrderState
from mgpo_jax.planning.table import FAR, UNKNOWN, find_state, way_to
from mgpo_jax.planning.worths import WorthState, posterior
from mgpo_jax.prompts import Prompt
from mgpo_jax.rollout import Query

NUM_BEST = 5  # number of best prompts that a page shows of an estimate
TIED = 1e-4  # posterior means that differ by less are equal up to rounding

Arrays = dict[str, np.ndarray]
Read = Callable[[Any], Any]
"""``(state) -> pytree``: extracts what to record from the state of a plan."""


class Told(NamedTuple):
    """The episodes of one task that a plan is told, leaves ``[S, E, ..]``."""

    goals: Any
    mask: Any
    greedy: Any
    returns: Any
    episodes: Any
    """``Episode`` records, or placeholders if only the returns matter."""


def plan_of(results: Results) -> Arrays:
    """What a plan knew after each episode, as arrays for the page; empty for another method.

    Axes: S seeds, N tasks, E episodes, M goals of one search. For a map and an order, ``knownGoals [K, G]``
    are unique goals, and ``known [S, N, M]`` lists those that each search found by its end, in order of
    discovery, as indices into them plus 1; 0 stands for none.

    - Map: ``visits [S, N, E, M]`` in each episode; ``wayCounts [S, N, E]`` and ``ways``, the states of the
      shortest known path after the start (see ``_encode_changes``); ``verified [S, N, E]``, the steps of
      the shortest greedy episode so far that arrived, or 0.
    - Order: ``prefix [S, N, E, W]``, the confirmed goals in order, as indices into ``known`` plus 1;
      ``excluded [S, N, E, M]``, goals that are known not to be next; ``complete [S, N, E]``, whether the
      order is known completely.
    - Estimate: ``worthEpisode [S, N, E, 5]``, the episodes, counted from 1, that first tried each of the
      best prompts, or 0; ``worthMean`` and ``worthStd``, the posterior of their mean returns.

    Raises:
      DataError: if the present version of the method does not arrive at the recorded prompts, or the
        results lack what it learned from.
    """
    found = told_adapter(results)
    if found is None:
        return {}
    adapter, state = found
    if isinstance(state, MapState | OrderState | WorthState):
        check_not_stopped(results)
    if isinstance(state, MapState):
        return _map_arrays(results, adapter)
    if isinstance(state, OrderState):
        return _order_arrays(results, adapter)
    return _worth_arrays(results, adapter) if isinstance(state, WorthState) else {}


def _map_arrays(results: Results, adapter: Adapter) -> Arrays:
    if results.actions is None:
        raise DataError("the map cannot be rebuilt, because these results hold no actions")
    spec = results.environment.spec

    def read(state: MapState) -> Any:
        key = jax.random.key(0)  # fixed, so that the same of several shortest paths is chosen
        goal = find_state(state.table, state.task_goal)
        way = way_to(key, state.table, state.start, goal, spec.horizon)
        states = jnp.where(way.steps < FAR, way.states, UNKNOWN)
        best = adapter.best(state).prompt
        return state.table.visits.astype(jnp.uint16), states.astype(jnp.int16), state.verified, best

    (goals, size), (visits, ways, verified, best) = _tell_episodes(
        results, adapter, read, lambda state: (state.table.goals, state.table.size)
    )
    if not _same_prompts(best, results).all():
        raise disagreement(results)
    num = int(size.max())
    gained = np.diff(visits[..., :num].astype(np.int32), axis=2, prepend=0)
    if gained.min() < 0:  # without splices, a better episode replaces the whole map
        raise DataError("a map that forgets what it has seen cannot be shown")
    counts, rows = _encode_changes(ways)
    return {
        **_known_goals(goals[:, :, :num], size),
        "visits": smallest(gained),
        "wayCounts": smallest(counts),
        "ways": smallest(rows),
        "verified": smallest(np.where(verified < FAR, verified, 0)),
    }


def _encode_changes(ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Encode paths ``[S, N, E, T]`` as those that differ from the path after the previous episode.

    Returns:
      ``[S, N, E]``: 0 if the path is unchanged (or, in the first episode, if there is none), otherwise the
      number of its states plus 1; and the concatenated states of all changed paths.
    """
    before = np.roll(ways, 1, axis=2)
    before[:, :, 0] = UNKNOWN
    is_new = (ways != before).any(axis=-1)
    counts = np.where(is_new, 1 + (ways != UNKNOWN).sum(axis=-1), 0)
    return counts, ways[(ways != UNKNOWN) & is_new[..., None]]


def _order_arrays(results: Results, adapter: Adapter) -> Arrays:
    def read(state: OrderState) -> Any:
        order = state.order
        return order.prefix, order.excluded, order.complete, adapter.best(state).prompt

    (goals, size), (prefix, excluded, complete, best) = _tell_episodes(
        results, adapter, read, lambda state: (state.order.goals, state.order.size)
    )
    if results.environment.spec.deterministic:
        fits = _same_prompts(best, results)  # the best of the greedy episodes
    else:
        fits = _follows(results, goals, prefix, complete)
    if not fits.all():
        raise disagreement(results)
    num = int(size.max())
    return {
        **_known_goals(goals[:, :, :num], size),
        "prefix": smallest(prefix - NONE),
        "excluded": excluded[..., :num].astype(np.uint8),
        "complete": complete.astype(np.uint8),
    }


def _follows(
    results: Results, goals: np.ndarray, prefix: np.ndarray, complete: np.ndarray
) -> np.ndarray:
    """``[S, N, E]`` whether the recorded best prompts begin with the confirmed goals.

    Once the order is complete, one of its goals may be missing. The goals after it are drawn at random.
    """
    found, masks = results.best["prompt.goals"], results.best["prompt.mask"]
    fits = np.zeros(prefix.shape[:3], bool)
    for place in np.ndindex(*fits.shape):
        inner = found[place][masks[place]][:-1]
        wanted = goals[place[:2]][prefix[place][prefix[place] != NONE]]
        num = min(len(inner), len(wanted))
        fits[place] = np.array_equal(inner[:num], wanted[:num])
        if complete[place] and not fits[place]:
            fits[place] = any(
                np.array_equal(inner, np.delete(wanted, skipped, axis=0)[: len(inner)])
                for skipped in range(len(wanted))
            )
    return fits


def _worth_arrays(results: Results, adapter: Adapter) -> Arrays:
    spec = results.environment.spec

    def read(state: WorthState) -> Any:
        if spec.deterministic:
            return state.returns, jnp.zeros_like(state.returns)
        return posterior(state, state.kernel)

    _, (mean, std) = _tell_episodes(results, adapter, read, lambda state: (), blank_episode(spec))
    shape = results.returns.shape
    worths = [np.zeros((*shape, NUM_BEST), dtype) for dtype in (np.int64, np.float32, np.float32)]
    for seed, task in np.ndindex(*shape[:2]):
        rows = _prompt_rows(results.choices, (seed, task))
        _, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        first = first[number.ravel()]  # the episode that first had this prompt
        held = _prompt_rows(results.best, (seed, task))
        for episode in range(shape[2]):
            means = np.where(first == np.arange(len(first)), mean[seed, task, episode], -np.inf)
            means = means[: episode + 1]
            is_held = (rows[: episode + 1] == held[episode]).all(axis=1)
            if not is_held.any() or means.max() - means[first[is_held.argmax()]] > TIED:
                raise disagreement(results)
            best = np.argsort(-means, kind="stable")[:NUM_BEST]
            best = best[np.isfinite(means[best])]
            where = (seed, task, episode, slice(len(best)))
            worths[0][where] = best + 1
            worths[1][where], worths[2][where] = means[best], std[seed, task, episode, best]
    return {
        "worthEpisode": smallest(worths[0]),
        "worthMean": worths[1],
        "worthStd": worths[2],
    }


def _prompt_rows(part: Arrays, where: tuple[int, int]) -> np.ndarray:
    """The prompts ``[E, P * (G + 1)]`` of one search, with zeros in unused slots."""
    goals, mask = part["prompt.goals"][where], part["prompt.mask"][where][..., None]
    return np.concatenate([np.where(mask, goals, 0), mask], axis=-1).reshape(len(goals), -1)


def _same_prompts(found: Any, results: Results) -> np.ndarray:
    """``[S, N, E]`` whether prompts equal the recorded best ones."""
    goals, mask = results.best["prompt.goals"], results.best["prompt.mask"]
    same_goals = np.where(mask[..., None], found.goals == goals, True).all(axis=(-1, -2))
    return (found.mask == mask).all(axis=-1) & same_goals


def _known_goals(goals: np.ndarray, size: np.ndarray) -> Arrays:
    """The first ``size [S, N]`` goals ``[S, N, M, G]`` of each search as arrays; see ``plan_of``."""
    real = np.arange(goals.shape[2]) < size[..., None]
    table, index = np.unique(goals[real], axis=0, return_inverse=True)
    places = np.zeros(real.shape, np.int64)
    places[real] = index.ravel() + 1
    return {"knownGoals": table.astype(np.float32), "known": smallest(places)}


def _tell_episodes(
    results: Results, adapter: Adapter, read: Read, last: Read, blank: Episode | None = None
) -> tuple[Any, Any]:
    """Tell a method all recorded episodes.

    Args:
      results: the adaptation.
      adapter: its method.
      read: extracts what to record from the state after each episode.
      last: extracts what to record from the last state.
      blank: a placeholder episode, if only returns matter; None to replay the episodes.

    Returns:
      The result of ``last`` ``[S, N, ..]``, and those of ``read`` ``[S, N, E, ..]``, with numpy leaves.
    """
    key = jax.random.key(0)  # the prompts drawn with it are replaced by the recorded ones

    @jax.jit
    @jax.vmap
    def of_lane(task_goal: Any, rows: Told) -> Any:
        def told(state: Any, row: Told) -> Any:
            query = Query(Prompt(row.goals, row.mask), row.greedy)
            episode = row.episodes._replace(return_=row.returns)
            state = adapter.tell(key, state, query, jax.tree.map(lambda leaf: leaf[None], episode))
            return state, read(state)

        state, found = jax.lax.scan(told, adapter.init(key, task_goal), rows)
        return last(state), found

    play, ends, reads = _player(results) if blank is None else None, [], []
    num_seeds, _, num = results.returns.shape
    same = None
    if blank is not None:
        stacked = lambda leaf: jnp.broadcast_to(leaf, (num_seeds, num, *jnp.shape(leaf)))  # noqa: E731
        same = jax.tree.map(stacked, blank)
    choices = [results.choices[name] for name in ("prompt.goals", "prompt.mask", "greedy")]
    for task, goal in enumerate(results.task_goals):
        episodes = same if play is None else play(task)
        parts = (*(part[:, task] for part in choices), results.returns[:, task], episodes)
        goals = np.broadcast_to(goal, (num_seeds, *goal.shape))
        end, found = jax.tree.map(np.asarray, of_lane(goals, Told(*parts)))
        ends.append(end)
        reads.append(found)
    together = lambda *parts: np.stack(parts, axis=1)  # noqa: E731
    return jax.tree.map(together, *ends), jax.tree.map(together, *reads)


def _player(results: Results) -> Callable[[int], Episode]:
    """A function that replays the episodes ``[S, E]`` of a task, or rebuilds them from reached goals."""
    env = results.environment
    actions = results.actions
    if actions is None or actions.dtype.kind == "f":
        return lambda task: _rebuild_episodes(results, env.spec, task)

    @jax.jit
    def play(task: Any, keys: Any, actions: Any, lengths: Any) -> Episode:
        def one(key: Any, actions: Any, length: Any) -> Episode:
            return replay(jax.random.wrap_key_data(key), env, task, actions, length)

        return jax.vmap(jax.vmap(one))(keys, actions, lengths)

    lengths = (actions != np.iinfo(actions.dtype).max).sum(axis=-1, dtype=np.int32)
    keys = results.keys
    if keys is None:
        keys = np.zeros((*lengths.shape, 2), np.uint32)
    return lambda task: play(results.task(task), keys[:, task], actions[:, task], lengths[:, task])


def _rebuild_episodes(results: Results, spec: EnvSpec, task: int) -> Episode:
    """Rebuild the episodes ``[S, E]`` of a task from the goals that they reached.

    The record does not say which goals were rewarded. Their number follows from the return, and they are
    taken to be the first of those that are part of the task goal: in a world that rewards an order, nothing
    is rewarded after a mistake.
    """
    if results.reached is None or not results.num_parts[task]:
        raise DataError("these results hold neither actions nor the goals that episodes reached")
    num_seeds, _, num = results.returns.shape
    shape = (num_seeds, num, spec.horizon)
    goals, rewards = np.zeros((*shape, spec.goal_dim), np.float32), np.zeros(shape, np.float32)
    reached, parts = np.zeros(shape, bool), int(results.num_parts[task])
    for seed, episode in np.ndindex(*shape[:2]):
        steps, achieved = results.reached_in(seed, task, episode)
        goals[seed, episode, steps], reached[seed, episode, steps] = achieved, True
        wanted = (achieved <= results.task_goals[task]).all(axis=1)
        done = int(np.round(results.returns[seed, task, episode] * parts))
        rewards[seed, episode, steps[wanted][:done]] = 1 / parts
    blank = blank_episode(spec)
    stacked = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (*shape[:2], *np.shape(leaf))), blank)
    trajectory = stacked.trajectory._replace(
        achieved_goals=goals,
        goal_reached=reached,
        length=np.full(shape[:2], spec.horizon, np.int32),
    )
    return stacked._replace(trajectory=trajectory, rewards=rewards)
