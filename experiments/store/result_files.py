"""The files of an adaptation's results, which only this module writes and reads.

The result folder of an adaptation contains

- ``results.npz``: the arrays of ``Results``. Names that begin with ``choice.`` and ``best.`` are parts of
  what the method chose, such as ``choice.prompt.goals``. Goals that episodes reached are stored as indices
  into a table of unique goals.
- ``tasks.npz``: the tasks, one array for each field.
- ``config.json``: the settings; ``meta.json``: provenance; ``summary.json``: the numbers that tables show.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from envs.errors import DataError, shown
from envs.registry import WORLDS
from experiments.store.layout import ARRAYS, CONFIG, META, SUMMARY, TASKS
from experiments.store.provenance import Place, provenance, read_meta
from experiments.store.results import Results
from experiments.store.summary import ADAPT_AGAIN, read_summary
from mgpo_jax.archives import array_names, read_arrays
from mgpo_jax.array_fields import LARGEST, ArrayField, Sizes
from mgpo_jax.files import new_folder, write_arrays, write_json
from mgpo_jax.methods import METHODS
from mgpo_jax.outcomes import Reached
from mgpo_jax.schema import STRICT, Json, Name, checked_entry, read_document
from mgpo_jax.settings import Count, Finite, NotNegative, NumEpisodes, NumSeeds, Seed
from mgpo_jax.tasks import save_tasks

FORMAT = 2  # format 1 had only prompts as choices, and neither actions nor reached goals
# Names in format 1, and their present names.
OLD_NAMES = {
    "greedy": "choice.greedy",
    "prompt_goals": "choice.prompt.goals",
    "prompt_masks": "choice.prompt.mask",
    "best_goals": "best.prompt.goals",
    "best_masks": "best.prompt.mask",
}
AXES = {
    "S": "seed", "N": "task", "E": "episode", "R": "round", "P": "slot", "T": "step", "G": "number",
    "C": "judgement", "L": "reached goal", "U": "different goal", "M": "named goal",
}  # fmt: skip
"""The axes of arrays, by letter, with their names in messages."""
SIZES: Sizes = dict.fromkeys(("seed", "task", "episode", "round", "judgement"), range(1, 2**31))


def _field(axes: str, dtype: str, **more: Any) -> ArrayField:
    """The schema of an array whose axes are given as letters."""
    shape = [... if axis == "*" else AXES.get(axis) or int(axis) for axis in axes]
    return ArrayField(tuple(shape), dtype, **more)


FIELDS = {
    "returns": _field("SNE", "float32"),
    "eval_episodes": _field("C", "int64", low=1),
    "eval_returns": _field("SNC", "float32"),
    "eval_achieved": _field("SNCM", "float32", required=False, low=0, high=1),
    "num_scored": _field("SNR", "int32", required=False, low=0),
    "optimal_returns": _field("N", "float32", required=False),
    "task_goals": _field("NG", "float32", required=False),
    "num_parts": _field("N", "integers", required=False, low=0),
    "lengths": _field("SNE", "integers", required=False, low=0),
    "keys": _field("SNE2", "uint32", required=False),
    "actions": _field("SNET*", "numbers", required=False),
    "reached_counts": _field("SNE", "int32", required=False, low=0),
    "reached_steps": _field("L", "integers", required=False, low=0),
    "reached_index": _field("L", "integers", required=False, low=0),
    "reached_table": _field("UG", "float32", required=False),
}
PART_FIELDS = {
    "prompt.goals": _field("SNRPG", "float32", any_value=True),  # see ``_check_prompts``
    "prompt.mask": _field("SNRP", "bool"),
    "greedy": _field("SNR", "bool"),
}
"""The schemas of the parts of choices that are known; for others there is ``OTHER_PART``."""
OTHER_PART = _field("SNR*", "anything", any_value=True)
REACHED = ("reached_counts", "reached_steps", "reached_index", "reached_table")
PARTS = frozenset({"choices", "lengths", "keys", "actions", "reached"})
"""Parts of results that ``load_results`` can leave out."""


def save_results(folder: Path, results: Results) -> None:
    """Write results to a new folder, which appears only when it is complete."""
    with new_folder(folder) as place:
        write_results(place, results, folder, provenance())


def write_results(place: Path, results: Results, folder: Path, meta: Mapping[str, Any]) -> None:
    """Write the files of results.

    Args:
      place: folder to write to.
      results: the results.
      folder: what ``place`` is renamed to afterward, for relative paths.
      meta: how the results were made, as ``provenance`` describes it.
    """
    arrays = {
        "returns": results.returns,
        "eval_episodes": results.eval_episodes,
        "eval_returns": results.eval_returns,
        "task_goals": results.task_goals,
        "num_parts": results.num_parts,
        **{f"choice.{name}": array for name, array in results.choices.items()},
        **{f"best.{name}": array for name, array in results.best.items()},
    }
    if results.optimum_known:
        arrays["optimal_returns"] = results.optimal_returns
    if results.eval_achieved is not None:
        arrays["eval_achieved"] = results.eval_achieved
    if results.num_scored is not None:
        arrays["num_scored"] = results.num_scored
    if results.lengths is not None:
        arrays["lengths"] = results.lengths.astype(np.min_scalar_type(results.lengths.max()))
    if results.keys is not None:
        arrays["keys"] = results.keys
    if results.actions is not None:
        arrays["actions"] = results.actions
    if results.reached is not None:
        arrays |= _compact(results.reached)
    write_arrays(place / ARRAYS, arrays)
    save_tasks(place / TASKS, results.task_set)
    write_json(place / CONFIG, results.config)
    places = policy_places(folder, results.config.get("policy"))
    write_json(place / META, {**meta, "format": FORMAT, "policy_places": places})
    write_json(place / SUMMARY, results.summary)


def policy_places(folder: Path, policy: str | None) -> list[str]:
    """Where a policy is: relative to the results, so that both can be moved together, and absolute."""
    if policy is None:
        return []
    absolute = os.path.abspath(policy)
    return [os.path.relpath(absolute, os.path.abspath(folder)), absolute]


def _compact(reached: Reached) -> dict[str, np.ndarray]:
    """Reached goals as indices into a table of unique goals."""
    table, index = np.unique(reached.goals, axis=0, return_inverse=True)
    return {
        "reached_counts": reached.counts.astype(np.min_scalar_type(reached.counts.max(initial=0))),
        "reached_steps": reached.steps,
        "reached_index": index.ravel().astype(np.min_scalar_type(len(table))),
        "reached_table": table,
    }


class Config(BaseModel):
    """The settings in ``config.json`` that are checked; there may be others."""

    model_config = {**STRICT, "extra": "ignore"}

    env: Name
    method: Name | None = None
    bandit: Name | None = None
    """The method, as older versions called it."""
    policy: Place | None = None
    tasks: Place | None = None
    validation: bool = False
    validation_seed: Seed = 0
    seeds: NumSeeds | None = None
    episodes: NumEpisodes | None = None
    seed: Seed = 0
    eval_every: Count | None = None
    eval_episodes: Count | None = None
    obs_noise: NotNegative = 0.0
    action_noise: NotNegative = 0.0
    stop_at: Finite | None = None
    max_goals: Count | None = None
    keep_rewarded: bool = True
    keep_actions: bool = False
    hyper: dict[str, Json] = {}
    options: dict[str, Json] = {}


def read_config(folder: Path) -> dict[str, Any]:
    """The settings of results.

    Raises:
      DataError: if ``config.json`` is missing or damaged, or names an unknown world or method.
    """
    path = folder / CONFIG
    document = read_document(path, dict[str, Json], ADAPT_AGAIN)
    config: Config = checked_entry(document, Config, path, "", ADAPT_AGAIN)
    method = config.method or config.bandit
    if method is None:
        raise DataError(f"{path} lacks method; {ADAPT_AGAIN}")
    WORLDS.known(config.env, path, "--env")
    if ":" not in method:  # module:attribute is only shown, and never imported
        METHODS.known(method, path)
    return document


def _check_format(path: Path) -> None:
    """Raise ``DataError`` for results in an unknown format, such as that of a later version."""
    found = read_meta(path, ADAPT_AGAIN).format
    if found not in (1, FORMAT):
        raise DataError(
            f"{path} has format {found}, this version reads 1 and {FORMAT}; {ADAPT_AGAIN}"
        )


def load_results(folder: Path, parts: Collection[str] = PARTS) -> Results:
    """Read the folder of one adaptation.

    Args:
      folder: the result folder.
      parts: which of ``PARTS`` to read; the others are left out.

    Raises:
      DataError: if a file is missing, unreadable or does not fit the others.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"no result folder {folder}; make one with `python -m experiments.adapt`")
    for name in (ARRAYS, TASKS, CONFIG, SUMMARY):
        if not (folder / name).is_file():
            raise DataError(
                f"{folder / name} is missing; is {folder} the folder of an adaptation? If so, {ADAPT_AGAIN}"
            )
    config = read_config(folder)
    _check_format(folder / META)
    arrays = _read_parts(folder / ARRAYS, config, parts)
    _check_actions(arrays.get("actions"), folder / ARRAYS)
    num_tasks = arrays["returns"].shape[1]
    optimum = arrays.get("optimal_returns")
    results = Results(
        config=config,
        tasks=_read_tasks(folder / TASKS, num_tasks),
        returns=arrays["returns"],
        choices=_with_prefix(arrays, "choice."),
        best=_with_prefix(arrays, "best."),
        eval_episodes=arrays["eval_episodes"],
        eval_returns=arrays["eval_returns"],
        optimal_returns=np.full(num_tasks, np.nan) if optimum is None else optimum,
        eval_achieved=arrays.get("eval_achieved"),
        num_scored=arrays.get("num_scored"),
        lengths=arrays.get("lengths"),
        keys=arrays.get("keys"),
        actions=arrays.get("actions"),
        reached=_expand(arrays, folder / ARRAYS),
        summary=dict(read_summary(folder)),
        folder=folder,
    )
    # Spares making the world; older versions did not store these.
    vars(results).update((n, arrays[n]) for n in ("task_goals", "num_parts") if n in arrays)
    return results


def _check_actions(actions: np.ndarray | None, path: Path) -> None:
    """Raise ``DataError`` for actions with a wrong number of axes."""
    if actions is not None and actions.ndim != (5 if actions.dtype.kind == "f" else 4):
        raise DataError(
            f"{path}: actions has shape {list(actions.shape)} of {actions.dtype}, wanted [seed, task, "
            f"episode, step] integers or one axis more of floats; {ADAPT_AGAIN}"
        )


def _read_tasks(path: Path, num: int) -> dict[str, np.ndarray]:
    """The arrays of the tasks; their schema is checked later, when the world is known."""
    fields = {name: _field("N*", "anything") for name in array_names(path, ADAPT_AGAIN)}
    return read_arrays(path, fields, {"task": num}, ADAPT_AGAIN)


def _read_parts(
    path: Path, config: Mapping[str, Any], parts: Collection[str]
) -> dict[str, np.ndarray]:
    """The requested arrays of results, by their present names."""
    stored = {OLD_NAMES.get(name, name): name for name in array_names(path, ADAPT_AGAIN)}
    fields = {name: field for name, field in FIELDS.items() if _wanted(name, parts)}
    for name in _parts_of_choices(stored):
        prefix, _, part = name.partition(".")
        if prefix == "best" or "choices" in parts:
            fields[name] = PART_FIELDS.get(part, OTHER_PART)
    sizes = {"seed": config.get("seeds"), "episode": config.get("episodes")}
    known = {axis: size for axis, size in sizes.items() if size is not None}
    in_file = {stored.get(name, name): field for name, field in fields.items()}
    found = read_arrays(path, in_file, {**SIZES, **known}, ADAPT_AGAIN)
    arrays = {OLD_NAMES.get(name, name): array for name, array in found.items()}
    _check_values(arrays, path)
    return arrays


def _wanted(name: str, parts: Collection[str]) -> bool:
    part = "reached" if name in REACHED else name
    return part in parts or part not in PARTS


def _parts_of_choices(stored: Mapping[str, str]) -> list[str]:
    """The names of the parts of choices; ``choice.`` and ``best.`` have the same parts."""
    parts = {*_with_prefix(stored, "choice."), *_with_prefix(stored, "best.")}
    if "task_goals" not in stored:  # format 1, in which every choice is a prompt
        parts |= PART_FIELDS.keys()
    # Format 1 did not store whether the policy acts greedily under the best prompt.
    return [
        f"{prefix}{part}"
        for prefix in ("choice.", "best.")
        for part in sorted(parts)
        if f"{prefix}{part}" != "best.greedy" or "best.greedy" in stored
    ]


def _check_values(arrays: Mapping[str, np.ndarray], path: Path) -> None:
    """Raise ``DataError`` for arrays that contradict each other."""
    judged, num = arrays["eval_episodes"], arrays["returns"].shape[2]
    # Two judgements may follow the first episode: of the initial choice, and of what it has changed.
    descends = (np.diff(judged) < 0).any() or (np.diff(judged[1:]) <= 0).any()
    if descends or judged[-1] > num:
        raise DataError(
            f"{path}: eval_episodes must ascend from 1 to at most {num}, found "
            f"{shown(judged.tolist())}; {ADAPT_AGAIN}"
        )
    for prefix in ("choice.", "best."):
        _check_prompts(_with_prefix(arrays, prefix), prefix, path)
    lengths, actions = arrays.get("lengths"), arrays.get("actions")
    if lengths is not None and actions is not None and lengths.max() > actions.shape[3]:
        raise DataError(
            f"{path}: lengths holds {lengths.max()}, there are actions of {actions.shape[3]} steps; "
            + ADAPT_AGAIN
        )


def _check_prompts(parts: Mapping[str, np.ndarray], prefix: str, path: Path) -> None:
    """Raise ``DataError`` for a prompt without goals, or a best prompt with a NaN or huge goal.

    Unused slots may hold anything. So may the goals of prompts that only acted, which nothing reads: with a
    population of 2, CMA-ES reaches NaN after many episodes.
    """
    goals, mask = parts.get("prompt.goals"), parts.get("prompt.mask")
    if mask is None:
        return
    empty = np.logical_not(mask.any(axis=-1))
    if empty.any():
        place = _place(empty, "SNR")
        raise DataError(f"{path}: {prefix}prompt.mask leaves no goal at {place}; {ADAPT_AGAIN}")
    if goals is None or prefix == "choice.":
        return
    wrong = mask[..., None] & ~(np.abs(goals) <= LARGEST)  # also true for NaN
    if wrong.any():
        raise DataError(
            f"{path}: {prefix}prompt.goals holds {goals[wrong][0]:g} at "
            f"{_place(wrong, 'SNRPG')}, must be from {-LARGEST:g} to {LARGEST:g}; {ADAPT_AGAIN}"
        )


def _place(where: np.ndarray, axes: str) -> str:
    """The first position at which ``where`` is true, in words; ``axes`` are the letters of its axes."""
    named = zip(axes, np.argwhere(where)[0], strict=True)
    return ", ".join(f"{AXES[axis]} {int(number)}" for axis, number in named)


def _with_prefix(arrays: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    return {
        name.removeprefix(prefix): array
        for name, array in arrays.items()
        if name.startswith(prefix)
    }


def _expand(arrays: Mapping[str, np.ndarray], where: Path) -> Reached | None:
    """Reached goals from their indices into the table of unique goals."""
    found = [arrays[name] for name in REACHED if name in arrays]
    if not found:
        return None
    if len(found) < len(REACHED):
        raise DataError(f"{where}: the reached goals are incomplete; {ADAPT_AGAIN}")
    counts, steps, index, table = found
    if index.max(initial=0) >= max(len(table), 1):
        raise DataError(
            f"{where}: reached_index holds {index.max()}, reached_table has {len(table)} goals; "
            + ADAPT_AGAIN
        )
    num = int(counts.sum(dtype=np.int64))
    if num != len(steps):
        raise DataError(f"{where}: {num} goals were reached, in {len(steps)} steps; {ADAPT_AGAIN}")
    return Reached(counts, steps, table[index])
