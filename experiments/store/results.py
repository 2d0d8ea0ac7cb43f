"""What an adaptation leaves behind: one schema, written and read here only.

The folder of an adaptation holds

- ``results.npz``: the arrays of ``Results``. Names that begin with ``choice.`` and ``best.`` are parts of
  what the method chose, such as ``choice.prompt.goals``. Goals that episodes reached are stored as places
  in a table of different goals.
- ``tasks.npz``: the tasks, one array for each field.
- ``config.json``: the settings; ``meta.json``: how and with what it was made; ``summary.json``: the numbers
  that tables show.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.base import Environment, Episode, Task
from envs.episodes import replay
from envs.errors import DataError
from experiments.store.provenance import provenance
from mgpo_jax.files import load_arrays, new_folder, read_object, write_json
from mgpo_jax.runner import Outcome, Reached
from mgpo_jax.tasks import save_tasks, task_arrays, task_at, tasks_from
from mgpo_jax.trees import named_leaves

FORMAT = 2  # 1 had only prompts as choices, and neither actions nor reached goals
ARRAYS, TASKS, CONFIG, META, SUMMARY = (
    "results.npz", "tasks.npz", "config.json", "meta.json", "summary.json"
)  # fmt: skip
# Names of format 1 and what they are called now.
OLD_NAMES = {
    "greedy": "choice.greedy",
    "prompt_goals": "choice.prompt.goals",
    "prompt_masks": "choice.prompt.mask",
    "best_goals": "best.prompt.goals",
    "best_masks": "best.prompt.mask",
}
# Axes: S seeds, N tasks, E episodes, R rounds, P slots of a prompt, T steps, G goal size, C judgements,
# L reached goals, U different ones.
AXES = {
    "returns": "SNE",
    "eval_episodes": "C",
    "eval_returns": "SNC",
    "optimal_returns": "N",
    "task_goals": "NG",
    "lengths": "SNE",
    "keys": "SNE2",
    "actions": "SNET*",
    "reached_counts": "SNE",
    "reached_steps": "L",
    "reached_index": "L",
    "reached_table": "UG",
    "choice.prompt.goals": "SNRPG",
    "choice.prompt.mask": "SNRP",
    "best.prompt.goals": "SNRPG",
    "best.prompt.mask": "SNRP",
}
REQUIRED = ("returns", "eval_episodes", "eval_returns")


@dataclass(frozen=True, kw_only=True)
class Results:
    """One adaptation. Axes: S seeds, N tasks, E episodes, R rounds, G goal size, C judgements."""

    config: dict[str, Any]
    """Settings of the command that made it."""
    tasks: dict[str, np.ndarray]
    """Arrays of the tasks, each [N, ..]."""
    returns: np.ndarray
    """[S, N, E] returns of the search's episodes."""
    choices: dict[str, np.ndarray]
    """Parts of who acted, each [S, N, R, ..]."""
    best: dict[str, np.ndarray]
    """Parts of the best choice after each round, each [S, N, R, ..]."""
    eval_episodes: np.ndarray
    """[C]: after how many episodes the best choice was judged."""
    eval_returns: np.ndarray
    """[S, N, C] mean returns of the judging episodes."""
    optimal_returns: np.ndarray
    """[N]; NaN where the optimum is unknown."""
    lengths: np.ndarray | None = None
    """[S, N, E] steps of the episodes."""
    keys: np.ndarray | None = None
    """[S, N, E, 2] raw random keys of the episodes in a world of chance, from which their starts follow
    (``envs.episodes.replay``)."""
    actions: np.ndarray | None = None
    """[S, N, E, T, ..]; small integers have their largest value after the end of an episode."""
    reached: Reached | None = None
    """The goals that the episodes reached, with their steps."""
    summary: dict[str, Any] = field(default_factory=dict)
    """The numbers that tables show."""

    @property
    def env(self) -> str:
        """Name or place of the world."""
        return self.config["env"]

    @property
    def method(self) -> str:
        """Name or place of the method."""
        return str(self.config.get("method", self.config.get("bandit")))

    @property
    def optimum_known(self) -> bool:
        return bool(np.isfinite(self.optimal_returns).all())

    @cached_property
    def task_set(self) -> Task:
        """The tasks as the world's record."""
        return tasks_from(self.tasks, envs.make(self.env), "the tasks of the results", trusted=True)

    @cached_property
    def task_goals(self) -> np.ndarray:
        """[N, G] task goals g^M."""
        return np.asarray(jax.vmap(envs.make(self.env).task_goal)(self.task_set))

    def task(self, index: int) -> Task:
        """One task, with numpy leaves."""
        return jax.tree.map(np.asarray, task_at(self.task_set, index))

    def best_goals(self, seed: int, task: int, episodes: int | None = None) -> np.ndarray | None:
        """The goals [k, G] of the best prompt after some episodes (default: all of them).

        None for a method that has no prompts.
        """
        if "prompt.goals" not in self.best:
            return None
        rounds, total = self.best["prompt.mask"].shape[2], self.returns.shape[2]
        last = -(-(total if episodes is None else episodes) * rounds // total)
        where = (seed, task, last - 1)
        return self.best["prompt.goals"][where][self.best["prompt.mask"][where]]

    def reached_in(self, seed: int, task: int, episode: int) -> tuple[np.ndarray, np.ndarray]:
        """The steps [n] and goals [n, G] that one episode of the search reached.

        Raises:
          DataError: if the results do not hold them.
        """
        if self.reached is None:
            raise DataError("these results were made before reached goals were kept; adapt again")
        counts = self.reached.counts
        end = int(
            counts.ravel()[: np.ravel_multi_index((seed, task, episode), counts.shape) + 1].sum()
        )
        rows = slice(end - int(counts[seed, task, episode]), end)
        return self.reached.steps[rows], self.reached.goals[rows]

    def replay(self, seed: int, task: int, episode: int) -> Episode:
        """Play one episode of the search again.

        Raises:
          DataError: if the results do not hold its actions.
        """
        if self.actions is None:
            raise DataError(
                "these results hold no actions; adapt again, with --keep-actions where they are continuous"
            )
        where = (seed, task, episode)
        env, actions = envs.make(self.env), self.actions[where]
        if self.lengths is not None:
            length = int(self.lengths[where])
        else:  # the largest number of the type stands after the end
            length = int((actions != np.iinfo(actions.dtype).max).sum())
        raw = np.zeros(2, np.uint32) if self.keys is None else self.keys[where]
        played = jnp.asarray(actions, env.spec.zero_action().dtype)
        one = jax.tree.map(jnp.asarray, self.task(task))
        return replay(
            jax.random.wrap_key_data(jnp.asarray(raw)), env, one, played, jnp.int32(length)
        )

    def most_improved(self, num: int = 4) -> list[int]:
        """The tasks whose return adaptation raised most, over all seeds, the largest gain first."""
        gains = (self.eval_returns[:, :, -1] - self.eval_returns[:, :, 0]).mean(axis=0)
        return np.argsort(-gains, kind="stable")[:num].tolist()


def results_of(
    outcome: Outcome, config: Mapping[str, Any], env: Environment, tasks: Task, optimum: np.ndarray
) -> Results:
    """The results of an adaptation that was just run.

    Random keys are only kept in worlds of chance: elsewhere the actions determine an episode.
    """
    return Results(
        config=dict(config),
        tasks=task_arrays(tasks),
        returns=outcome.returns,
        choices=_parts(outcome.choices),
        best=_parts(outcome.best),
        eval_episodes=outcome.eval_episodes,
        eval_returns=outcome.eval_returns,
        optimal_returns=optimum,
        lengths=outcome.lengths,
        keys=None if env.spec.deterministic else outcome.keys,
        actions=outcome.actions,
        reached=outcome.reached,
    )


def _parts(choice: Any) -> dict[str, np.ndarray]:
    return {name: np.asarray(leaf) for name, leaf in named_leaves(choice, "choice").items()}


def save_results(folder: Path, results: Results) -> None:
    """Write results to a new folder, which appears when all of it is there."""
    arrays = {
        "returns": results.returns,
        "eval_episodes": results.eval_episodes,
        "eval_returns": results.eval_returns,
        "task_goals": results.task_goals,
        **{f"choice.{name}": array for name, array in results.choices.items()},
        **{f"best.{name}": array for name, array in results.best.items()},
    }
    if results.optimum_known:
        arrays["optimal_returns"] = results.optimal_returns
    if results.lengths is not None:
        arrays["lengths"] = results.lengths.astype(np.min_scalar_type(results.lengths.max()))
    if results.keys is not None:
        arrays["keys"] = results.keys
    if results.actions is not None:
        arrays["actions"] = results.actions
    if results.reached is not None:
        arrays |= _compact(results.reached)
    with new_folder(folder) as partial:
        np.savez_compressed(partial / ARRAYS, allow_pickle=False, **arrays)
        save_tasks(partial / TASKS, results.task_set)
        write_json(partial / CONFIG, results.config)
        write_json(partial / META, {"format": FORMAT, **provenance()})
        write_json(partial / SUMMARY, results.summary)


def _compact(reached: Reached) -> dict[str, np.ndarray]:
    """Reached goals as places in a table of different goals."""
    table, index = np.unique(reached.goals, axis=0, return_inverse=True)
    return {
        "reached_counts": reached.counts.astype(np.min_scalar_type(reached.counts.max(initial=0))),
        "reached_steps": reached.steps,
        "reached_index": index.ravel().astype(np.min_scalar_type(len(table))),
        "reached_table": table,
    }


def load_results(folder: Path) -> Results:
    """Read the folder of one adaptation.

    Raises:
      DataError: if a file is missing, unreadable or does not fit the others.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"no result folder {folder}")
    for name in (ARRAYS, TASKS, CONFIG, SUMMARY):
        if not (folder / name).is_file():
            raise DataError(f"{folder / name} is missing; is {folder} the folder of an adaptation?")
    config = read_object(folder / CONFIG)
    if not isinstance(config.get("env"), str):
        raise DataError(f"{folder / CONFIG} does not name the env")
    if not isinstance(config.get("method", config.get("bandit")), str):
        raise DataError(f"{folder / CONFIG} does not name the method")
    where = folder / ARRAYS
    arrays = {OLD_NAMES.get(name, name): array for name, array in load_arrays(where).items()}
    tasks = load_arrays(folder / TASKS)
    sizes = _check_arrays(arrays, where)
    for name, array in tasks.items():
        if array.ndim == 0 or len(array) != sizes["N"]:
            raise DataError(
                f"{folder / TASKS}: {name} has shape {list(array.shape)}, "
                f"the results are of {sizes['N']} tasks"
            )
    results = Results(
        config=config,
        tasks=tasks,
        returns=arrays["returns"],
        choices=_with_prefix(arrays, "choice."),
        best=_with_prefix(arrays, "best."),
        eval_episodes=arrays["eval_episodes"],
        eval_returns=arrays["eval_returns"],
        optimal_returns=arrays.get("optimal_returns", np.full(sizes["N"], np.nan)),
        lengths=arrays.get("lengths"),
        keys=arrays.get("keys"),
        actions=arrays.get("actions"),
        reached=_expand(arrays, where),
        summary=read_object(folder / SUMMARY),
    )
    if "task_goals" in arrays:
        vars(results)["task_goals"] = arrays["task_goals"]  # saves making the world
    return results


def read_summary(folder: Path) -> dict[str, Any]:
    """The numbers that tables show, of a result folder."""
    return read_object(Path(folder) / SUMMARY)


def _check_arrays(arrays: Mapping[str, np.ndarray], where: Path) -> dict[str, int]:
    """Raise ``DataError`` if arrays are missing or do not fit together; returns the sizes of the axes."""
    if missing := [name for name in (*REQUIRED, *_expected_parts(arrays)) if name not in arrays]:
        raise DataError(f"{where} lacks {', '.join(missing)}")
    parts = [name for name in arrays if name.startswith(("choice.", "best."))]
    axes_of = dict.fromkeys(parts, "SNR*")
    axes_of |= {name: axes for name, axes in AXES.items() if name in arrays}
    sizes: dict[str, int] = {}
    for name, axes in axes_of.items():
        shape, wanted = arrays[name].shape, axes.removesuffix("*")
        fits = len(shape) >= len(wanted) if axes.endswith("*") else len(shape) == len(wanted)
        fits = fits and all(
            size == int(axis) if axis.isdigit() else sizes.setdefault(axis, size) == size
            for axis, size in zip(wanted, shape, strict=False)
        )
        if not fits or (name in REQUIRED and 0 in shape):
            raise DataError(
                f"{where}: {name} has shape {list(shape)}, which does not fit the axes {axes} "
                f"({', '.join(f'{axis} {size}' for axis, size in sizes.items())})"
            )
    for name in ("returns", "eval_returns", "optimal_returns"):
        if name in arrays and not np.isfinite(arrays[name]).all():
            raise DataError(f"{where}: {name} holds NaN or infinity")
    return sizes


def _expected_parts(arrays: Mapping[str, np.ndarray]) -> list[str]:
    """Names of the parts of choices: who acted and the best choice have the same ones."""
    parts = {*_with_prefix(arrays, "choice."), *_with_prefix(arrays, "best.")}
    if not parts and "task_goals" not in arrays:  # format 1, in which every choice is a prompt
        parts = {"*"}
    expected = [f"{prefix}{part}" for prefix in ("choice.", "best.") for part in sorted(parts)]
    return [name for name in expected if name != "best.greedy"]  # which format 1 did not keep


def _with_prefix(arrays: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {
        name.removeprefix(prefix): array
        for name, array in arrays.items()
        if name.startswith(prefix)
    }


def _expand(arrays: Mapping[str, np.ndarray], where: Path) -> Reached | None:
    """Reached goals from their places in the table of different goals."""
    if "reached_counts" not in arrays:
        return None
    try:
        counts, steps = arrays["reached_counts"].astype(np.int32), arrays["reached_steps"]
        goals = arrays["reached_table"][arrays["reached_index"]]
    except (KeyError, IndexError):
        raise DataError(f"{where}: the reached goals are incomplete") from None
    if counts.sum() != len(steps):
        raise DataError(f"{where}: {counts.sum()} goals were reached, in {len(steps)} steps")
    return Reached(counts, steps, goals)
