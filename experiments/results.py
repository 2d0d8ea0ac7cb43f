"""Reading the result folder of an adaptation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from mgpo_jax.errors import DataError
from mgpo_jax.files import load_arrays
from mgpo_jax.types import Prompt


class Results(NamedTuple):
    """One adaptation: S seeds, N tasks, E episodes, P slots, G goal size, C checkpoints."""

    returns: np.ndarray  # [S, N, E]
    greedy: np.ndarray  # [S, N, E]
    prompt_goals: np.ndarray  # [S, N, E, P, G]
    prompt_masks: np.ndarray  # [S, N, E, P]
    best_goals: np.ndarray  # [S, N, E, P, G]
    best_masks: np.ndarray  # [S, N, E, P]
    eval_episodes: np.ndarray  # [C]
    eval_returns: np.ndarray  # [S, N, C]
    optimal_returns: np.ndarray  # [N]
    tasks: dict[str, np.ndarray]  # each [N, ...]
    config: dict[str, Any]
    summary: dict[str, Any]

    def best_prompt(self, seed: int, task: int, episodes: int | None = None) -> Prompt:
        """The best prompt of one task after ``episodes`` episodes (default: all)."""
        last = self.returns.shape[2] if episodes is None else episodes
        index = (seed, task, last - 1)
        return Prompt(jnp.asarray(self.best_goals[index]), jnp.asarray(self.best_masks[index]))

    def most_improved(self, num: int = 4) -> list[int]:
        """The tasks whose return adaptation raised most, over all seeds, the largest gain first."""
        gains = (self.eval_returns[:, :, -1] - self.eval_returns[:, :, 0]).mean(axis=0)
        return np.argsort(-gains, kind="stable")[:num].tolist()


FILES = ("results.npz", "tasks.npz", "config.json", "summary.json")
AXES = {
    "returns": "SNE",
    "greedy": "SNE",
    "prompt_goals": "SNEPG",
    "prompt_masks": "SNEP",
    "best_goals": "SNEPG",
    "best_masks": "SNEP",
    "eval_episodes": "C",
    "eval_returns": "SNC",
    "optimal_returns": "N",
}


def load_results(folder: Path) -> Results:
    """Read the folder of one adaptation.

    Raises:
      DataError: if a file is missing, unreadable or does not fit the others.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"no result folder {folder}")
    for name in FILES:
        if not (folder / name).is_file():
            raise DataError(f"{folder / name} is missing; is {folder} the folder of an adaptation?")
    arrays, tasks = load_arrays(folder / "results.npz"), load_arrays(folder / "tasks.npz")
    config, summary = _load_object(folder / "config.json"), _load_object(folder / "summary.json")
    for name in ("env", "bandit"):
        if not isinstance(config.get(name), str):
            raise DataError(f"{folder / 'config.json'} does not name the {name}")

    where = folder / "results.npz"
    if missing := [name for name in AXES if name not in arrays]:
        raise DataError(f"{where} lacks {', '.join(missing)}")
    sizes: dict[str, int] = {}
    for name, axes in AXES.items():
        shape = arrays[name].shape
        fits = len(shape) == len(axes) and all(
            size > 0 and sizes.setdefault(axis, size) == size
            for axis, size in zip(axes, shape, strict=True)
        )
        if not fits:
            raise DataError(
                f"{where}: {name} has shape {list(shape)}, which does not fit the axes {axes} "
                f"({', '.join(f'{axis} {size}' for axis, size in sizes.items())})"
            )
    for name in ("returns", "eval_returns", "optimal_returns"):
        if not np.isfinite(arrays[name]).all():
            raise DataError(f"{where}: {name} holds NaN or infinity")
    for name, array in tasks.items():
        if array.ndim == 0 or len(array) != sizes["N"]:
            raise DataError(
                f"{folder / 'tasks.npz'}: {name} has shape {list(array.shape)}, "
                f"the results are of {sizes['N']} tasks"
            )
    return Results(
        **{name: arrays[name] for name in AXES}, tasks=tasks, config=config, summary=summary
    )


def _load_object(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text())
    except ValueError:
        raise DataError(f"{path} is not readable JSON") from None
    if not isinstance(value, dict):
        raise DataError(f"{path} does not hold a JSON object")
    return value
