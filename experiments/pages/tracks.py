"""What a drawing has to know of saved episodes whose rules are not in the page: jax plays them again."""

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

MOST_STEPS = 750_000  # are played again; of more, every second, third .. episode of each search is
# Episodes at once: more are no faster on a CPU. What is played again is checked against the record.
BATCH = 64


@dataclass(frozen=True)
class Tracked(Wrapper):
    """A world in which the agent sees what a drawing has to know (``Page.track``), for episodes that are
    played again. Its ``spec`` still tells of what the agent saw then."""

    track: Callable[[State], Array]

    def reset(self, key: PRNGKeyArray, task: Task) -> tuple[State, TimeStep]:
        return self._seen(*self.env.reset(key, task))

    def step(self, state: State, action: Array) -> tuple[State, TimeStep]:
        return self._seen(*self.env.step(state, action))

    def _seen(self, state: State, timestep: TimeStep) -> tuple[State, TimeStep]:
        return state, timestep._replace(obs=self.track(state).astype(jnp.uint8))


def tracks_of(results: Results, page: Page) -> dict[str, np.ndarray]:
    """The tracks of the episodes of a world that has them, as arrays for the page.

    Returns:
      ``trackStride [1]``, of how many episodes the first is played again; ``trackCounts [S, N, E]``, how
      many moments of each episode are known: its steps and 1, or 0 where it was not played again, or did
      not come to the goals on record; and ``track [D, total]``, the numbers of all of them, one episode
      after another, as differences to the moment before, modulo 256. Nothing where the world has no tracks
      or the results hold no actions, and behind noise.
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

    # Episodes of about one length together, since a batch runs as long as its longest one.
    order, counts = np.argsort(-lengths[chosen], kind="stable"), np.zeros_like(lengths)
    rows = [np.zeros((0, 0), np.uint8)] * len(where)
    for start in range(0, len(order), BATCH):
        batch = np.resize(order[start : start + BATCH], BATCH)  # all batches of one shape
        at = tuple(where[batch].T)
        tasks = jax.tree.map(lambda leaf, i=at[1]: jnp.asarray(leaf)[i], results.task_set)
        found = map(np.asarray, play(tasks, keys[at], actions[at], lengths[at]))
        for number, seen, last, length, reached in zip(batch, *found, strict=True):
            place = tuple(where[number])
            row = np.concatenate([seen[:length], last[None]])
            fits = length == lengths[place] and _as_on_record(results, place, reached)
            counts[place] = len(row) if fits else 0
            rows[number] = np.diff(row, axis=0, prepend=np.zeros_like(row[:1]))[: counts[place]]
    return {
        "trackStride": np.array([stride], np.uint32),
        "trackCounts": smallest(counts),
        "track": np.ascontiguousarray(np.concatenate(rows).T),
    }


def _as_on_record(results: Results, place: tuple[int, ...], reached: np.ndarray) -> bool:
    """Whether an episode reached goals ``[T]`` in the steps on record, as far as they are kept."""
    if results.reached is None:
        return True
    return np.array_equal(np.flatnonzero(reached), results.reached_in(*place)[0])
