"""Convert an episode in the logs of another program to the rows of a dataset, and check it.

An episode of T actions has T + 1 observations. If there are only T, the last action is dropped, since its
effect is unknown. Achieved goals come from a function, or from columns or arrays of the logs; row t + 1 is
what action t achieved.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from envs.errors import DataError, UsageError, printable, shown
from envs.registry import load
from experiments.dropped_ends import kind_of_end
from experiments.sources import ACTIONS, TERMINATED, TRUNCATED, Source, first_of
from experiments.store.data_settings import ImportConfig

OBSERVATIONS = ("observations", "observation", "obs", "observations/observation")
NEXT = ("next_observations", "next_observation", "next_obs")
REWARDS = ("rewards", "reward")
OWN_BY_STEP = ("achieved_goals", "goal_reached", "outcomes", "intended")
OWN_BY_TRAJECTORY = ("task_hashes", "variants")
"""Arrays of our own exports, which are imported as they are."""
DTYPES = {"achieved_goals": np.float32, "goal_reached": np.bool_, "outcomes": np.float32}
LARGEST_INT = np.iinfo(np.int32)

Rows = dict[str, np.ndarray]


class BadEpisodeError(DataError):
    """An episode that cannot be used; the others may be fine."""


def named(name: str, arrays: Mapping[str, np.ndarray], who: str, flag: str) -> np.ndarray:
    """The array with a name, or the only one whose name ends with a slash and that name.

    Args:
      name: the name.
      arrays: the arrays of an episode.
      who: what messages call the episode.
      flag: the flag that gave the name, for messages.

    Raises:
      UsageError: if there is no such array, or more than one.
    """
    if name in arrays:
        return arrays[name]
    found = [key for key in arrays if key.endswith(f"/{name}")]
    if len(found) == 1:
        return arrays[found[0]]
    what = "several arrays" if found else "no array"
    known = printable(", ".join(sorted(found or arrays)))
    raise UsageError(f"{who} has {what} named {shown(name)}; give {flag} one of {known}")


def load_function(place: str) -> Callable[..., Any]:
    """Import a function given as ``module:function``; the module may be in the current folder.

    Raises:
      UsageError: if there is no such function.
    """
    function: Any = load(place, "--goal")
    if not callable(function):
        raise UsageError(f"--goal {place} is not a function, found {shown(function)}")
    return function


def _wants_episode(function: Callable[..., Any]) -> bool:
    try:
        return next(iter(inspect.signature(function).parameters), "") == "episode"
    except (TypeError, ValueError):  # functions written in C have no signature
        return False


def observations(config: ImportConfig, arrays: Mapping[str, np.ndarray], who: str) -> np.ndarray:
    """The observations of an episode, [T + 1, ...] or [T, ...]; several arrays are concatenated."""
    if config.obs_arrays:
        parts = [named(name, arrays, who, "--obs-arrays") for name in config.obs_arrays]
    else:
        found = first_of(OBSERVATIONS, arrays)
        if found is None:
            raise DataError(
                f"{who} has no observations; it has {printable(', '.join(sorted(arrays)))}; name the "
                "arrays that are the observation with --obs-arrays"
            )
        parts = [found]
    if len(parts) == 1:
        return parts[0]
    if len({len(part) for part in parts}) > 1:
        raise DataError(f"{who}: the arrays of the observation have different numbers of rows")
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


def suited(array: np.ndarray, who: str, what: str) -> np.ndarray:
    """The array with at most 32 bits per number, as our programs need it."""
    if array.dtype.kind == "f" and array.dtype.itemsize > 4:
        return array.astype(np.float32)
    if array.dtype.itemsize == 8:
        ends = [int(array.min()), int(array.max())] if len(array) else []
        if large := [end for end in ends if not LARGEST_INT.min <= end <= LARGEST_INT.max]:
            raise DataError(
                f"{who}: {what} hold {large[0]}, which needs more than 32 bits; scale or recode them "
                "before the import"
            )
        return array.astype(np.int32)
    return array.astype(array.dtype.newbyteorder("="))


class Converter:
    """Converts the episodes of logs to the rows of a dataset.

    Args:
      config: settings of the import.
      source: the logs.
    """

    def __init__(self, config: ImportConfig, source: Source) -> None:
        self.config, self.source = config, source
        self.function = load_function(config.goal) if config.goal else None
        self.num_cut = 0
        """Number of episodes without an observation after their last action."""
        self.dropped_end: tuple[str, int] | None = None
        """How the latest episode ended (``dropped_ends.KINDS``) and the number of its actions, if its last
        action was dropped and its logs mark ends; otherwise None."""

    def rows(self, who: str, arrays: Mapping[str, np.ndarray]) -> Rows:
        """The rows of one episode.

        Raises:
          DataError: if the episode is invalid.
        """
        obs = observations(self.config, arrays, who)
        actions = first_of(ACTIONS, arrays)
        if actions is None:
            raise DataError(f"{who} has no actions; it has {printable(', '.join(sorted(arrays)))}")
        num = len(actions)
        # Arrays named by the user are others than those that go on in next_observations.
        after = None if self.config.obs_arrays else first_of(NEXT, arrays)
        if num and len(obs) == num and after is not None and len(after) == num:
            if after.shape[1:] != obs.shape[1:]:
                raise DataError(
                    f"{who}: next observations have shape {list(after.shape[1:])}, observations "
                    f"{list(obs.shape[1:])}; both must be the same"
                )
            obs = np.concatenate([obs, after[-1:]])
        if len(obs) == num:
            num -= 1
            self.num_cut += 1
        if num < 1 or len(obs) != num + 1:
            raise BadEpisodeError(
                f"{who} has {len(obs)} observations and {len(actions)} actions; an episode of T actions "
                "needs T + 1 observations"
            )
        obs = suited(obs, who, "observations")
        rows: Rows = {"obs": obs[:num], "actions": self.actions(actions[:num], who)}
        rows |= self.goals(who, arrays, obs, len(actions), num)
        rewards = first_of(REWARDS, arrays)
        if rewards is not None and not self._lacks("rewards"):
            rows["rewards"] = np.asarray(rewards, np.float32).reshape(-1)[:num]
        rows["last_obs"] = obs[-1:]
        if not self._lacks("ends"):
            rows |= self.ends(arrays, len(actions), num)
        for name in OWN_BY_TRAJECTORY:
            if name in arrays:
                rows[name] = np.reshape(arrays[name], -1)[:1]
        check_rows(who, rows, num)
        return rows

    def ends(self, arrays: Mapping[str, np.ndarray], num_actions: int, num: int) -> Rows:
        """How an episode ended. If its last action was dropped, so was its end, which is kept in
        ``dropped_end``."""
        flags = [first_of(names, arrays) for names in (TERMINATED, TRUNCATED)]
        marks = [flag is not None and bool(np.reshape(flag, -1)[-1]) for flag in flags]
        is_marked, was_dropped = any(flag is not None for flag in flags), num_actions > num
        self.dropped_end = (kind_of_end(*marks), num_actions) if is_marked and was_dropped else None
        names = ("terminated", "truncated")
        return {
            name: np.array([mark and not was_dropped])
            for name, mark in zip(names, marks, strict=True)
        }

    def _lacks(self, what: str) -> bool:
        """Whether our own export notes that the original dataset had no such arrays."""
        return bool((sized_of(self.source, f"without_{what}") or [False])[0])

    def actions(self, actions: np.ndarray, who: str) -> np.ndarray:
        """Actions in the form that networks use: integers from 0, or numbers in [-1, 1]."""
        low, high = np.array(self.config.action_low), np.array(self.config.action_high)
        if actions.dtype.kind in "iu" and not len(low):
            if actions.ndim == 2 and actions.shape[1] == 1:
                actions = actions[:, 0]
            if actions.ndim != 1:
                raise DataError(
                    f"{who}: integer actions must have one number a step, found shape "
                    f"{list(actions.shape)}; "
                    "give --action-low and --action-high if they are quantities"
                )
            most = self.config.num_actions or self.source.num_actions or LARGEST_INT.max
            if actions.min() < 0 or actions.max() >= most:
                raise DataError(
                    f"{who}: actions are {actions.min()} to {actions.max()}, must be from 0 to {most - 1}; "
                    "see --num-actions"
                )
            return actions.astype(np.int32)
        if actions.dtype.kind not in "iuf":
            raise DataError(f"{who}: actions must be numbers, found {actions.dtype}")
        rows = actions.reshape(len(actions), -1).astype(np.float32)
        if len(low) > 1 and len(low) != rows.shape[1]:
            raise UsageError(
                f"--action-low has {len(low)} numbers, an action has {rows.shape[1]}; give one, or one "
                "for each"
            )
        if len(low):
            rows = (2 * (rows - low) / (high - low) - 1).astype(np.float32)
        if np.isfinite(rows).all() and np.abs(rows).max() > 1 + 1e-5:
            given = "after scaling they" if len(low) else "they"
            raise DataError(
                f"{who}: actions must be in [-1, 1], {given} go from {rows.min():g} to "
                f"{rows.max():g}; give "
                "their bounds with --action-low and --action-high"
            )
        return np.where(np.isfinite(rows), np.clip(rows, -1, 1), rows)

    def goals(
        self,
        who: str,
        arrays: Mapping[str, np.ndarray],
        obs: np.ndarray,
        num_actions: int,
        num: int,
    ) -> Rows:
        """Achieved goals, whether they count as reached, and outcomes, after each of the first ``num`` of
        the episode's actions."""
        found = {
            name: np.asarray(
                after_actions(who, name, arrays[name], num_actions)[:num], DTYPES.get(name)
            )
            for name in OWN_BY_STEP
            if name in arrays
        }
        config = self.config
        if config.goal or config.goal_columns or config.goal_array:
            for name in ("achieved_goals", "goal_reached", "outcomes"):
                found.pop(name, None)
        elif "achieved_goals" not in found:
            size = int(np.prod(obs.shape[1:]))
            raise UsageError(
                f"nothing says what a goal is; give --goal-columns with some of the {size} components of "
                f"an observation, --goal-array with one of {printable(', '.join(sorted(arrays)))}, or "
                "--goal module:function"
            )
        if "achieved_goals" not in found:
            goals = self._achieved(who, arrays, obs, num)
            found["achieved_goals"] = goals[-num:]
            changes = np.ones(num, bool)
            if config.reached == "changes":
                changes = np.any(np.diff(goals, axis=0), axis=1)
                # Without a goal before the first action, the first goal counts as reached.
                changes = np.concatenate([np.ones(num - len(changes), bool), changes])
            found["goal_reached"] = changes
        found.setdefault("goal_reached", np.ones(num, bool))
        found.setdefault("outcomes", found["achieved_goals"])
        if "intended" in found:
            found["intended"] = self.actions(found["intended"], f"{who}, intended")
        return found

    def _achieved(
        self, who: str, arrays: Mapping[str, np.ndarray], obs: np.ndarray, num: int
    ) -> np.ndarray:
        """Achieved goals from a function, columns or an array: [T + 1, G], or [T, G] after actions only."""
        config = self.config
        if config.goal_columns:
            flat = obs.reshape(len(obs), -1)
            if (most := max(config.goal_columns)) >= flat.shape[1]:
                raise UsageError(
                    f"--goal-columns {most} is out of range: observations have {flat.shape[1]} components, "
                    "counted from 0; choose another"
                )
            found, what = flat[:, list(config.goal_columns)], "--goal-columns"
        elif config.goal_array:
            what = f"--goal-array {config.goal_array}"
            found = named(config.goal_array, arrays, who, "--goal-array")
        else:
            assert self.function is not None
            what = f"--goal {config.goal}"
            found = self._call_goal_function(who, arrays, obs, what)
        goals = np.asarray(found)
        if goals.ndim == 1:
            goals = goals[:, None]
        rows = (num + 1,) if config.goal_array else (num + 1, num)
        if goals.dtype.kind not in "biuf" or goals.ndim != 2 or len(goals) not in rows:
            raise DataError(
                f"{who}: {what} gives {goals.dtype}{list(goals.shape)}, wanted numbers [{num + 1}, G]: a "
                "goal for every observation, the last one included"
            )
        return goals.astype(np.float32)

    def _call_goal_function(
        self, who: str, arrays: Mapping[str, np.ndarray], obs: np.ndarray, what: str
    ) -> Any:
        assert self.function is not None
        whole = _wants_episode(self.function)
        given = SimpleNamespace(**{**arrays, "observations": obs}) if whole else obs
        try:
            return self.function(given)
        except Exception as error:  # a function of a user may raise anything
            kind = type(error).__name__
            raise DataError(f"{who}: {what} raised {kind}: {printable(str(error))}") from None


def after_actions(who: str, name: str, array: np.ndarray, num_actions: int) -> np.ndarray:
    """The rows of an array that describe the world after each action.

    An array with one row more describes the start as well, in its first row.

    Raises:
      BadEpisodeError: if the array has any other number of rows.
    """
    if name in DTYPES and len(array) == num_actions + 1:
        return array[1:]
    if len(array) != num_actions:
        raise BadEpisodeError(
            f"{who}: {name} has {len(array)} rows, wanted one for each of {num_actions} actions"
        )
    return array


def check_rows(who: str, rows: Rows, num: int) -> None:
    """Raise ``BadEpisodeError`` for arrays with a wrong number of rows, and for NaN and infinity."""
    for name, array in rows.items():
        one = name in ("last_obs", "terminated", "truncated", *OWN_BY_TRAJECTORY)
        if len(array) != (1 if one else num):
            raise BadEpisodeError(f"{who}: {name} has {len(array)} rows, wanted {num}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            bad = ~np.isfinite(array.reshape(len(array), -1))
            step = num if one else int(np.flatnonzero(bad.any(axis=1))[0])
            raise BadEpisodeError(f"{who}, step {step}: {name} holds NaN or infinity")


def sized_of(source: Source, name: str) -> Any:
    """An entry of our own exports that holds for all episodes; None if there is none."""
    return source.sized[name].reshape(-1).tolist() if name in source.sized else None
