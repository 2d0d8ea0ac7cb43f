"""The arrays of one adaptation in a report, with more or fewer details, so that a page is not too large."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment
from envs.episodes import replay
from envs.page import Page
from experiments.pages.packing import smallest
from experiments.pages.tracks import tracks_of
from experiments.pages.worlds import page_of
from experiments.store.policies import seen_goals_of
from experiments.store.results import Results

Arrays = dict[str, np.ndarray]


class Detail(IntEnum):
    """What a page shows of its runs. Each stage leaves out something more than the one before it."""

    ALL = 0
    NO_TRACKS = 1
    """No drawings on the map of episodes that were replayed with jax."""
    NO_COURSES = 2
    """Nothing of what episodes did: neither actions nor goals reached."""
    HALF_GOALS = 3
    """The goals of prompts in half precision."""
    NO_KNOWLEDGE = 4
    """Nothing of what the optimizer knew."""
    NO_PROMPTS = 5
    """No prompts."""


LEFT_OUT = {
    Detail.NO_TRACKS: "the drawings of episodes on their map",
    Detail.NO_COURSES: "what the episodes did",
    Detail.HALF_GOALS: "half of the digits of goals",
    Detail.NO_KNOWLEDGE: "what the optimizer knew",
    Detail.NO_PROMPTS: "the prompts",
}
"""What each stage leaves out, in words."""


def stages_of(page: Page) -> list[Detail]:
    """The stages that differ for a world, from all details to the fewest."""
    return [stage for stage in Detail if stage != Detail.NO_TRACKS or page.track is not None]


def arrays_of(results: Results, known: Mapping[str, np.ndarray], detail: Detail) -> Arrays:
    """The arrays of one run: returns, prompts, and what its episodes did, as far as that is known.

    Args:
      results: the adaptation.
      known: what its search knew after each episode.
      detail: how much of this to keep.
    """
    page = page_of(results.world)
    arrays = _arrays(results, page, detail)
    return arrays if detail >= Detail.NO_KNOWLEDGE else arrays | dict(known)


def _arrays(results: Results, page: Page, detail: Detail) -> Arrays:
    arrays = {
        "returns": results.returns.astype(np.float32),
        "evalEpisodes": results.eval_episodes.astype(np.uint32),
        "evalReturns": results.eval_returns.astype(np.float32),
    }
    has_rules = page.script is not None and page.track is None
    with_courses, with_prompts = detail < Detail.NO_COURSES, detail < Detail.NO_PROMPTS
    with_prompts = with_prompts and "prompt.goals" in results.choices
    reached = results.reached if with_courses and not has_rules else None
    goals = [np.zeros((0, results.task_goals.shape[1]), np.float32)]
    if with_prompts:
        goals += [
            part["prompt.goals"][part["prompt.mask"]] for part in (results.choices, results.best)
        ]
    if reached is not None:
        goals.append(reached.goals)
    table, index = np.unique(np.concatenate(goals), axis=0, return_inverse=True)
    arrays["goals"] = table.astype(np.float32)
    if detail >= Detail.HALF_GOALS and (np.abs(table) < np.finfo(np.float16).max).all():
        arrays["goals"] = table.astype(np.float16)
    if (seen := seen_goals_of(results)) is not None:
        arrays["far"] = seen.far(table).astype(np.uint8)
    parts = np.split(index.ravel(), np.cumsum([len(part) for part in goals])[:-1])[1:]
    if with_prompts:
        arrays |= _prompts(results, parts[:2])
    if reached is not None:
        arrays["reachedCounts"] = smallest(reached.counts)
        arrays["reachedSteps"] = smallest(reached.steps)
        arrays["reachedGoals"] = smallest(parts[-1])
    if with_courses and has_rules:
        arrays |= _actions(results, page)
    elif detail == Detail.ALL:
        arrays |= tracks_of(results, page)
    return arrays


def _prompts(results: Results, index: Sequence[np.ndarray]) -> Arrays:
    """Prompts as rows of a table, numbered in order of first appearance.

    Args:
      results: the adaptation.
      index: indices into the table of goals, of the goals of the acting and of the best choices.
    """
    filled = []
    for part, places in zip((results.choices, results.best), index, strict=True):
        rows = np.zeros(part["prompt.mask"].shape, np.int64)
        rows[part["prompt.mask"]] = places + 1
        filled.append(rows)
    flat = np.concatenate([rows.reshape(-1, rows.shape[-1]) for rows in filled])
    _, first, inverse = np.unique(flat, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    numbers = np.argsort(order)[inverse.ravel()]
    choice, best = np.split(numbers, 2)
    shape = filled[0].shape[:-1]
    greedy = results.choices.get("greedy", np.zeros(shape, bool))
    return {
        "prompts": smallest(flat[first[order]]),
        "choice": smallest(_new_or_known(choice).reshape(shape)),
        "best": smallest(best.reshape(shape)),
        "greedy": greedy.astype(np.uint8),
    }


def _new_or_known(numbers: np.ndarray) -> np.ndarray:
    """Replace the first appearance of each number by 0, and all others by the number plus 1.

    Numbers must first appear in ascending order, from 0. Most are new, so this halves the compressed size.
    """
    _, first = np.unique(numbers, return_index=True)
    coded = numbers + 1
    coded[first] = 0
    return coded


def _actions(results: Results, page: Page) -> Arrays:
    """The actions of all episodes, concatenated, for a world whose rules are in the page.

    Under noise there are none, since the rules do not know how the noise changed the actions.
    """
    actions = results.actions
    noisy = results.environment != results.world.make()
    if actions is None or actions.dtype.kind == "f" or noisy:
        return {}
    real = actions != np.iinfo(actions.dtype).max
    found = {"lengths": smallest(real.sum(axis=-1)), "actions": smallest(actions[real])}
    if page.start is not None:
        if results.keys is None:
            return {}
        found["starts"] = _starts(results, page)
    return found


def _starts(results: Results, page: Page) -> np.ndarray:
    """``[S, N, E, ..]`` what the rules need of the first observation of each episode."""
    assert results.keys is not None
    assert page.start is not None
    env = results.world.make()
    seeds, num, episodes = results.keys.shape[:3]
    by_task = results.keys.swapaxes(0, 1).reshape(num, -1, 2)
    tasks = jax.tree.map(jnp.asarray, results.task_set)
    obs = np.asarray(_first_obs(env)(jnp.asarray(by_task), tasks))
    obs = obs.reshape(num, seeds, episodes, *obs.shape[2:]).swapaxes(0, 1)
    flat = obs.reshape(-1, *obs.shape[3:])
    return smallest(np.array([page.start(row) for row in flat]).reshape(*obs.shape[:3], -1))


def _first_obs(env: Environment) -> Any:
    """First observations ``[N, K, ..]`` of episodes with raw keys ``[N, K, 2]`` on N tasks."""

    def of(raw: jax.Array, task: Any) -> jax.Array:
        actions = jnp.zeros((1, *env.spec.zero_action().shape), env.spec.zero_action().dtype)
        return replay(jax.random.wrap_key_data(raw), env, task, actions, jnp.int32(0)).last_obs

    return jax.jit(jax.vmap(jax.vmap(of, (0, None))))
