"""What a search knew after each episode, recomputed by telling its optimizer the recorded episodes again.

Methods that keep a table of arms (``mgpo_jax.optimizers.arms``) update it by returns alone, so no episode
has to be replayed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import ValidationError

from envs.base import Episode, Trajectory
from envs.errors import DataError, UsageError
from envs.specs import EnvSpec
from experiments.store.layout import CONFIG
from experiments.store.results import Results
from mgpo_jax.adaptation import Adapter
from mgpo_jax.methods import METHODS, Setting
from mgpo_jax.network_configs import network_config
from mgpo_jax.optimizers.arms import Arms
from mgpo_jax.prompts import Prompt
from mgpo_jax.rollout import Query

NO_ARM = 255  # stands for an episode that changed no arm; a table has at most 64 rows


class Knowledge(NamedTuple):
    """The row of the table of arms that each episode changed, and its new content."""

    row: np.ndarray
    """``[S, N, E]`` uint8 index of the row; ``NO_ARM`` if none changed."""
    pulls: np.ndarray
    """``[S, N, E]`` pulls of this arm so far; 1 for a new arm, which has the prompt of this episode."""
    mean: np.ndarray
    """``[S, N, E]`` float32 mean return of this arm so far."""


def knowledge_of(results: Results) -> Knowledge | None:
    """What a search knew after each episode, or None for a method without a table of arms.

    Raises:
      DataError: if the present version of the method does not arrive at the recorded prompts, or searches
        ended early.
    """
    found = told_adapter(results)
    if found is None or not isinstance(getattr(found[1], "arms", None), Arms):
        return None
    check_not_stopped(results)
    adapter, spec = found[0], results.world.make().spec
    names = ("prompt.goals", "prompt.mask", "greedy")
    goals, mask, greedy = (jnp.asarray(results.choices[name]) for name in names)
    blank = blank_episode(spec)

    def lane(
        blank: Episode, task_goal: Any, goals: Any, mask: Any, greedy: Any, returns: Any
    ) -> Any:
        def told(state: Any, row: Any) -> Any:
            goals, mask, greedy, return_ = row
            key = jax.random.key(0)  # the prompts drawn with it are replaced by the recorded ones
            _, asked = adapter.ask(key, state)
            query = Query(Prompt(goals, mask), greedy)
            episodes = jax.tree.map(
                lambda leaf: jnp.asarray(leaf)[None], blank._replace(return_=return_)
            )
            after = adapter.tell(key, asked, query, episodes)
            return after, _change(state.arms, after.arms, query.prompt)

        first = adapter.init(jax.random.key(0), task_goal)
        return jax.lax.scan(told, first, (goals, mask, greedy, returns))[1]

    lanes = jax.jit(jax.vmap(jax.vmap(lane, (None, 0, 0, 0, 0, 0)), (None, None, 0, 0, 0, 0)))
    changes = lanes(
        blank, jnp.asarray(results.task_goals), goals, mask, greedy, jnp.asarray(results.returns)
    )
    row, pulls, mean, fits = (np.asarray(leaf) for leaf in changes)
    if not fits.all():
        raise disagreement(results)
    return Knowledge(row.astype(np.uint8), pulls.astype(np.uint32), mean)


def check_not_stopped(results: Results) -> None:
    """Raise ``DataError`` for searches that could end early, whose later episodes are only placeholders."""
    if results.episodes_used is not None:
        raise DataError(
            "what the optimizer knew cannot be shown for searches that ended early (--stop-at)"
        )


def disagreement(results: Results) -> DataError:
    """The error for a method that, given the recorded episodes, does not arrive at the recorded prompts."""
    return DataError(
        f"replaying the recorded episodes with {results.method} gives different prompts from the recorded "
        "ones: the results were made by another version"
    )


def told_adapter(results: Results) -> tuple[Adapter, Any] | None:
    """Make the adapter of some results from their settings, to tell it the recorded episodes.

    It has no weights, so it cannot act.

    Returns:
      The adapter and the shapes of its state; None for a method without prompts, with several episodes per
      round, or whose settings are those of an older version.

    Raises:
      DataError: if making the adapter without weights fails.
    """
    config = results.config
    values, mask = config.get("hyper"), results.choices.get("prompt.mask")
    if mask is None or "greedy" not in results.choices or not isinstance(values, Mapping):
        return None
    num_rounds, slots = mask.shape[2:]
    if not slots or num_rounds != results.returns.shape[2]:
        return None
    try:
        method = METHODS.known(results.method, results.folder or CONFIG)
        hyper = method.hyper_from(values)
        env = results.environment
        setting = Setting(
            env=env,
            network=network_config(env.spec, max_prompt_length=slots),
            num_episodes=results.returns.shape[2],
            judged=results.world.judged,
        )
        method.check_use(setting, hyper)
        adapter = method.adapter(setting, None, hyper)
        state = jax.eval_shape(adapter.init, jax.random.key(0), jnp.zeros(env.spec.goal_dim))
    except (DataError, UsageError, ValidationError):  # settings of an older version
        return None
    except Exception as error:  # a user's method may raise anything
        raise DataError(
            f"what {results.method} knew cannot be shown, since the method cannot be made again without "
            f"weights: {type(error).__name__}: {error}"
        ) from error
    return adapter, state


def blank_episode(spec: EnvSpec) -> Episode:
    """A placeholder episode, for methods that only use its return."""
    steps = spec.horizon
    obs = jnp.zeros((steps, *spec.obs.shape), spec.obs.dtype)
    actions = jnp.zeros((steps, *spec.zero_action().shape), spec.zero_action().dtype)
    nothing = jnp.zeros((steps, spec.goal_dim))
    trajectory = Trajectory(obs, actions, nothing, jnp.zeros(steps, bool), nothing, jnp.int32(0))
    return Episode(trajectory, jnp.zeros(steps), jnp.float32(0), obs[0])


def _change(before: Arms, after: Arms, prompt: Prompt) -> tuple[Any, Any, Any, Any]:
    """The changed row, its pulls, its mean, and whether it holds the prompt of the episode."""
    num = len(before.pulls)
    differs = jnp.zeros(num, bool)
    for old, new in zip(_rows(before), _rows(after), strict=True):
        differs |= jnp.any((old != new).reshape(num, -1), axis=1)
    changed, row = jnp.any(differs), jnp.argmax(differs)
    held = after.prompt(row)
    same = jnp.all(held.mask == prompt.mask) & jnp.all(
        jnp.where(prompt.mask[:, None], held.goals == prompt.goals, True)
    )
    return jnp.where(changed, row, NO_ARM), after.pulls[row], after.mean[row], same | ~changed


def _rows(arms: Arms) -> list[jax.Array]:
    """The arrays of a table that have a row for each arm."""
    return [leaf for leaf in jax.tree.leaves(arms) if jnp.ndim(leaf)]
