"""Tracks: the data to draw saved episodes of worlds whose rules are not in the page, replayed with jax."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from envs.base import Episode, State, Task, TimeStep
from envs.episodes import replay
from envs.page import Page
from envs.wrappers import Wrapper
from experiments.pages.packing import smallest
from experiments.store.results import Results

MOST_STEPS = 750_000  # maximum number of steps to replay; if there are more, episodes are skipped
BATCH = 64  # episodes to replay at once; more are no faster on a CPU


@dataclass(frozen=True)
class Tracked(Wrapper):
    """A wrapper whose observations are the data for a drawing (``Page.track``), for replaying episodes.

    Its ``spec`` still describes the original observations.
    """

    track: Callable[[State], Array]

    def reset(self, key: PRNGKeyArray, task: Task) -> tuple[State, TimeStep]:
        return self._seen(*self.env.reset(key, task))

    def step(self, state: State, action: Array) -> tuple[State, TimeStep]:
        return self._seen(*self.env.step(state, action))

    def _seen(self, state: State, timestep: TimeStep) -> tuple[State, TimeStep]:
        return state, timestep._replace(obs=self.track(state).astype(jnp.uint8))


def tracks_of(results: Results, page: Page) -> dict[str, np.ndarray]:
    """The tracks of the episodes as arrays for the page.

    Returns:
      An empty dictionary if the world has no tracks, the results have no actions, or there was noise;
      otherwise

      - ``trackStride [1]``: n, if every n-th episode of each search is replayed.
      - ``trackCounts [S, N, E]``: the number of moments of each episode, which is its steps plus 1; 0 if it
        was not replayed, or the replay does not match the record.
      - ``track [D, total]``: the tracks of all episodes, concatenated, as differences from the previous
        moment modulo 256.
    """
    actions, keys = results.actions, results.keys
    if page.track is None or actions is None or actions.dtype.kind == "f":
        return {}
    if results.environment != results.world.make():
        return {}
    lengths = (actions != np.iinfo(actions.dtype).max).sum(axis=-1, dtype=np.int32)
    if keys is None:
        keys = np.zeros((*lengths.shape, 2), np.uint32)
    stride = max(1, -(-int(lengths.sum(dtype=np.int64)) // MOST_STEPS))
    chosen = np.zeros(lengths.shape, bool)
    chosen[:, :, ::stride] = True
    where = np.argwhere(chosen)
    env = Tracked(results.environment, page.track)

    @jax.jit
    @jax.vmap
    def play(task: Task, key: Array, actions: Array, length: Array) -> tuple[Array, ...]:
        episode: Episode = replay(jax.random.wrap_key_data(key), env, task, actions, length)
        played = episode.trajectory
        return played.obs, episode.last_obs, played.length, played.goal_reached

    # Batch episodes of similar length, since a batch runs as long as its longest episode.
    order, counts = np.argsort(-lengths[chosen], kind="stable"), np.zeros_like(lengths)
    rows = [np.zeros((0, 0), np.uint8)] * len(where)
    for start in range(0, len(order), BATCH):
        batch = np.resize(order[start : start + BATCH], BATCH)  # the same shape for all batches
        at = tuple(where[batch].T)
        tasks = jax.tree.map(lambda leaf, i=at[1]: jnp.asarray(leaf)[i], results.task_set)
        found = map(np.asarray, play(tasks, keys[at], actions[at], lengths[at]))
        for number, seen, last, length, reached in zip(batch, *found, strict=True):
            place = tuple(where[number])
            row = np.concatenate([seen[:length], last[None]])
            fits = length == lengths[place] and _matches_record(results, place, reached)
            counts[place] = len(row) if fits else 0
            rows[number] = np.diff(row, axis=0, prepend=np.zeros_like(row[:1]))[: counts[place]]
    return {
        "trackStride": np.array([stride], np.uint32),
        "trackCounts": smallest(counts),
        "track": np.ascontiguousarray(np.concatenate(rows).T),
    }


def _matches_record(results: Results, place: tuple[int, ...], reached: np.ndarray) -> bool:
    """Whether a replayed episode reached goals (mask ``[T]``) in the recorded steps, if there are any."""
    if results.reached is None:
        return True
    return np.array_equal(np.flatnonzero(reached), results.reached_in(*place)[0])
