"""Find faults in a dataset.

A fault is something that a training should not learn from; a note is something that may be intended. Both
are sentences that name the trajectory and the step. ``_misaligned`` and ``_wrong_ends`` explain their
heuristics.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

import envs
from envs.specs import EnvSpec
from experiments import dropped_ends
from mgpo_jax.dataset import Dataset, load_dataset
from mgpo_jax.manifest import Facts, read_facts, read_manifest
from mgpo_jax.mapped import let_go

SAMPLE = 20_000  # maximum number of steps in a regression
MOST_NUMBERS = 256  # maximum size of an observation or action in a regression
RIDGE = 1e-3  # strength of the ridge penalty, relative to the variance of the inputs
MARGIN = 0.1  # share of the variance that another row's action must explain beyond the own row's


@dataclass
class Findings:
    """Sentences on faults and notes, by kind, in the order in which they were found."""

    faults: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    notes: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))

    @property
    def num_faults(self) -> int:
        return sum(map(len, self.faults.values()))

    def lines(self, most: int) -> Iterator[str]:
        """The lines to print: at most ``most`` of each kind, and how many more there are."""
        for word, kinds in (("fault", self.faults), ("note", self.notes)):
            for kind, found in kinds.items():
                yield from (f"{word}: {text}" for text in found[:most])
                if len(found) > most:
                    yield f"{word}: {len(found) - most} more of this kind ({kind}); see --most"
        if not self.faults:
            yield "no faults"


def examine(folder: Path, env: str | None = None, horizon: int | None = None) -> Findings:
    """Check a dataset for common faults of logs.

    Args:
      folder: folder of the dataset.
      env: the world whose shapes and horizon it must have, if any.
      horizon: steps after which an episode is truncated (default: the world's, or the manifest's).

    Raises:
      DataError: if it is not a dataset, is damaged, or does not have the world's shapes.
    """
    facts, spec = read_facts(folder), None
    if env is not None:
        spec = envs.make(env).spec
        horizon = horizon or spec.horizon
    dataset, _ = load_dataset(folder, _without_horizon(spec), any_value=True)
    found = Findings()
    _not_finite(dataset, found)
    if found.faults:
        return found  # the other checks need finite numbers
    _wrong_observations(dataset, found)
    _misaligned(dataset, facts, found)
    _wrong_ends(dataset, horizon or facts.spec.horizon, found)
    _wrong_dropped_ends(folder, horizon or facts.spec.horizon, found)
    _duplicates(dataset, found)
    _idle_goals(dataset, found)
    return found


def _without_horizon(spec: EnvSpec | None) -> EnvSpec | None:
    """The spec without its horizon, so that too long trajectories become findings instead of an error."""
    return None if spec is None else replace(spec, horizon=2**31 - 1)


def _place(dataset: Dataset, row: int) -> str:
    """The trajectory and step that a row of the flat arrays belongs to, in words."""
    index = int(np.searchsorted(np.cumsum(dataset.lengths), row, side="right"))
    return f"trajectory {index}, step {row - int(dataset.starts[index])}"


def _not_finite(dataset: Dataset, found: Findings) -> None:
    """Find NaN, infinity, and actions out of range."""
    for name, array in dataset.arrays.items():
        if array.dtype.kind != "f":
            continue
        for first, piece in pieces(array):
            flat = piece.reshape(len(piece), -1)
            for row in np.flatnonzero(~np.isfinite(flat).all(axis=1)):
                value = flat[row][~np.isfinite(flat[row])][0]
                word = "NaN" if np.isnan(value) else "infinity"
                where = (
                    f"trajectory {first + row}, after the last step"
                    if len(array) == len(dataset) and name == "last_obs"
                    else _place(dataset, first + int(row))
                )
                found.faults["not finite"].append(f"{where}: {name} holds {word}")
            if name in ("actions", "intended"):
                for row in np.flatnonzero((np.abs(flat) > 1).any(axis=1)):
                    where, most = _place(dataset, first + int(row)), np.abs(flat[row]).max()
                    found.faults["out of range"].append(
                        f"{where}: {name} holds {most:g}, actions are from -1 to 1"
                    )


def pieces(array: np.ndarray, size: int = 1 << 24) -> Iterator[tuple[int, np.ndarray]]:
    """Yield an array in pieces, each with the index of its first row, to save memory."""
    rows = max(1, size // max(1, array[:1].nbytes))
    for first in range(0, len(array), rows):
        yield first, np.asarray(array[first : first + rows])
        let_go(array)


def _wrong_observations(dataset: Dataset, found: Findings) -> None:
    """Find observations that belong to the previous episode, and missing last observations."""
    if dataset.last_obs is None:
        found.faults["last observation"].append(
            f"trajectory 0, step {dataset.lengths[0]}: there is no observation after the last action, "
            "nor in any other trajectory; an episode of T actions needs T + 1 observations"
        )
        return
    num, starts = len(dataset), dataset.starts
    first = dataset.obs[starts].reshape(num, -1)
    final = dataset.obs[starts + dataset.lengths - 1].reshape(num, -1)
    last = np.asarray(dataset.last_obs).reshape(num, -1)
    same = [(first[lag:] == last[:-lag]).all(axis=1) for lag in range(1, min(5, num))]
    # In worlds with few states, a trajectory may begin by chance where another one ended.
    chance = max((int(rows.sum()) for rows in same[1:]), default=0)
    few = dataset.obs.dtype.kind != "f" and same and same[0].mean() <= 0.2
    if same and same[0].sum() > 2 * chance and not few:
        for index in (1 + np.flatnonzero(same[0])).tolist():
            found.faults["off by one"].append(
                f"trajectory {index}, step 0: the first observation is the last one of trajectory "
                f"{index - 1}; "
                "observations are off by one, or the episodes are split one step too late"
            )
    repeated, moved = (final == last).all(axis=1), False
    for index in range(min(num, 100)):
        rows = dataset.obs[starts[index] : starts[index] + dataset.lengths[index]]
        moved |= bool((rows[1:] != rows[:-1]).any())
    if num > 1 and repeated.all() and moved:
        found.faults["last observation"].append(
            f"trajectory 0, step {dataset.lengths[0]}: the observation after the last action repeats the "
            f"one before it, as in all {num} trajectories; T observations were logged where T + 1 are "
            "needed"
        )


def _explained_variance(inputs: np.ndarray, targets: np.ndarray) -> float:
    """R^2 on the second half of the rows, of a ridge regression fitted to the first half."""
    half = len(inputs) // 2
    inputs = inputs - inputs[:half].mean(axis=0)
    inputs = inputs / np.where(inputs.std(axis=0) < 1e-8, 1, inputs.std(axis=0))
    inputs = np.concatenate([inputs, np.ones((len(inputs), 1))], axis=1)
    known, wanted = inputs[:half], targets[:half]
    normal = known.T @ known + RIDGE * half * np.eye(known.shape[1])
    error = targets[half:] - inputs[half:] @ np.linalg.solve(normal, known.T @ wanted)
    spread = targets[half:] - targets[half:].mean(axis=0)
    total = float((spread**2).sum())
    return 1 - float((error**2).sum()) / total if total > 0 else 0.0


def _misaligned(dataset: Dataset, facts: Facts, found: Findings) -> None:
    """Find actions that belong to the step before or after theirs, where this can be told.

    Ridge regressions predict the standardized change of the observation from step t to t + 1, from the
    observations at t and t - 1 and the action in row t - 1, t or t + 1. It is a fault if the action of
    another row explains more of the variance than that of row t, by more than ``MARGIN``. A reactive agent
    has the same effect: its next action reveals the next observation. So if the observation at t predicts
    at least half of the action in row t, the shift must show in the actions, too: the observation that they
    would react to if they were shifted must leave less than half as much unexplained.
    """
    if facts.obs_size > MOST_NUMBERS or facts.action_dim > MOST_NUMBERS:
        found.notes["alignment"].append(
            f"the alignment of actions with steps is not checked: observations have {facts.obs_size} "
            f"numbers and actions {facts.action_dim}, and the check supports at most {MOST_NUMBERS} of each"
        )
        return
    starts, lengths = dataset.starts, dataset.lengths
    rows = [
        np.arange(start + 1, start + length - 1)
        for start, length in zip(starts, lengths, strict=True)
        if length >= 4
    ]
    inner = np.concatenate([np.zeros(0, np.int64), *rows])
    if len(inner) > SAMPLE:
        inner = np.sort(np.random.default_rng(0).choice(inner, SAMPLE, replace=False))
    inner = inner[np.argsort(np.random.default_rng(1).random(len(inner)))]
    if len(inner) < 200:
        found.notes["alignment"].append(
            f"the alignment of actions with steps cannot be checked on {len(inner)} steps; 200 are needed"
        )
        return
    obs = {lag: _numbers(dataset.obs, inner + lag) for lag in (-1, 0, 1)}
    actions = {lag: _action_numbers(dataset, inner + lag, facts) for lag in (-1, 0, 1)}
    change = obs[1] - obs[0]
    change = change / np.where(change.std(axis=0) < 1e-8, 1, change.std(axis=0))
    explained = {
        lag: _explained_variance(np.concatenate([obs[0], obs[-1], acted], axis=1), change)
        for lag, acted in actions.items()
    }
    reacts = {lag: _explained_variance(seen, actions[0]) for lag, seen in obs.items()}
    for lag, where in ((-1, "step after"), (1, "step before")):
        better = explained[lag] - explained[0]
        shifted = reacts[0] < 0.5 or 1 - reacts[-lag] < 0.5 * (1 - reacts[0])
        if better > MARGIN and shifted:
            other = "before" if lag < 0 else "after"
            found.faults["misaligned"].append(
                f"{_place(dataset, int(inner.min()))} and all others: the action seems to belong to the "
                f"{where} its own: the action one row {other} explains {explained[lag]:.0%} of the "
                f"variance of the change in observations, the action in the same row {explained[0]:.0%}; "
                "shift the actions by one step"
            )


def _numbers(array: np.ndarray, rows: np.ndarray) -> np.ndarray:
    return np.asarray(array[rows], np.float64).reshape(len(rows), -1)


def _action_numbers(dataset: Dataset, rows: np.ndarray, facts: Facts) -> np.ndarray:
    """Actions as rows of numbers; discrete ones are one-hot."""
    if facts.num_actions is None:
        return _numbers(dataset.actions, rows)
    return np.eye(facts.num_actions)[np.asarray(dataset.actions[rows])]


def _wrong_ends(dataset: Dataset, horizon: int, found: Findings) -> None:
    """Find lengths above the horizon, and time limits that were logged as terminations.

    Terminations exactly at the horizon are a fault if there are at least three, and they make up nine
    tenths of the trajectories of that length. Truncations before the horizon are a note if others are at
    the horizon.
    """
    lengths = dataset.lengths
    for index in np.flatnonzero(lengths > horizon).tolist():
        found.faults["too long"].append(
            f"trajectory {index}, step {horizon}: it has {lengths[index]} steps, the horizon is {horizon}"
        )
    if dataset.terminated is None or dataset.truncated is None:
        return
    at_horizon = lengths == horizon
    ended = at_horizon & dataset.terminated & ~dataset.truncated
    if ended.sum() >= 3 and ended.sum() >= 0.9 * at_horizon.sum():
        for index in np.flatnonzero(ended).tolist():
            found.faults["time limits"].append(
                f"trajectory {index}, step {horizon - 1}: it is marked as terminated at the very "
                f"horizon, as {ended.sum()} of {at_horizon.sum()} of this length are; a time limit is a "
                "truncation"
            )
    early = dataset.truncated & ~dataset.terminated & (lengths < horizon)
    if early.any() and (dataset.truncated & at_horizon).any():
        index = int(np.argmax(early))
        found.notes["cut early"].append(
            f"trajectory {index}, step {lengths[index] - 1}: it is marked as truncated before the "
            f"horizon of {horizon}, as {early.sum()} are; an end of the task is a termination"
        )


def _wrong_dropped_ends(folder: Path, horizon: int, found: Findings) -> None:
    """Find the same in ends that the import dropped with the last actions of episodes."""
    ends = read_manifest(folder)[1].dropped_ends
    for word, kind, text in dropped_ends.wrong_ends(ends, horizon) if ends else ():
        (found.faults if word == "fault" else found.notes)[kind].append(text)


def _duplicates(dataset: Dataset, found: Findings) -> None:
    """Find trajectories with the same observations and actions; on the same task this is only a note."""
    seen: dict[bytes, int] = {}
    starts, hashes = dataset.starts, dataset.task_hashes
    for index, (start, length) in enumerate(zip(starts, dataset.lengths, strict=True)):
        rows = slice(int(start), int(start) + int(length))
        digest = hashlib.blake2b(np.ascontiguousarray(dataset.obs[rows]).tobytes(), digest_size=16)
        digest.update(np.ascontiguousarray(dataset.actions[rows]).tobytes())
        if index % 256 == 0:
            let_go(dataset.obs)
        first = seen.setdefault(digest.digest(), index)
        if first == index:
            continue
        text = f"trajectory {index}, step 0: all of its steps are those of trajectory {first}"
        same_task = hashes is not None and hashes[index] == hashes[first]
        (found.notes if same_task else found.faults)["twice"].append(text)


def _idle_goals(dataset: Dataset, found: Findings) -> None:
    """Find trajectories in which no goal is reached, or the achieved goal never changes."""
    starts = dataset.starts
    reached = np.logical_or.reduceat(dataset.goal_reached, starts)
    changes = np.zeros(len(dataset), bool)
    for index, (start, length) in enumerate(zip(starts, dataset.lengths, strict=True)):
        goals = dataset.achieved_goals[int(start) : int(start) + int(length)]
        changes[index] = length < 2 or bool((goals != goals[0]).any())
    for kind, good, text in (
        ("no goal", reached, "no goal is reached in it, so that its prompts have one goal alone"),
        ("still goals", changes, "the achieved goal is the same at every step"),
    ):
        bad = np.flatnonzero(~good)
        # A few such trajectories may be intended; if they are the majority, the goals are wrong.
        place = found.faults if len(bad) > 0.5 * len(dataset) else found.notes
        for index in bad.tolist():
            place[kind].append(f"trajectory {index}, step 0: {text}")
