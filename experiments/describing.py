"""What ``data info`` tells of a dataset, as text and as JSON, and what ``data check`` finds as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.errors import printable
from experiments import dropped_ends
from experiments.soundness import Findings, pieces
from mgpo_jax.dataset import STEP_ARRAYS, Dataset, load_dataset
from mgpo_jax.manifest import read_facts, read_manifest


def findings(found: Findings, most: int) -> dict[str, Any]:
    """The faults and notes by kind: how many there are, and the sentences of at most ``most`` of them."""

    def shown(kinds: Mapping[str, Sequence[str]]) -> dict[str, Any]:
        return {
            kind: {"count": len(texts), "shown": list(texts[:most])}
            for kind, texts in kinds.items()
        }

    return {"faults": shown(found.faults), "notes": shown(found.notes)}


def facts_of(folder: Path) -> dict[str, Any]:
    """A dataset in numbers: its sizes, types, lengths, returns and ends. What is not known is None.

    Raises:
      DataError: if it is not a dataset, or is damaged.
    """
    facts = read_facts(folder)
    dataset, manifest = load_dataset(folder, any_value=True)
    returns = returns_of(dataset)
    return {
        "folder": str(folder),
        "sha256": manifest["sha256"],
        "imported": manifest.get("imported"),
        "env": facts.env,
        "demonstrator": manifest.get("policy"),
        "trajectories": len(dataset),
        "steps": facts.num_steps,
        "horizon": facts.spec.horizon,
        "lengths": _spread(dataset.lengths),
        "observations": {"dtype": facts.obs_dtype, "shape": list(facts.obs_shape)},
        "actions": {"discrete": facts.num_actions, "size": facts.action_dim},
        "goals": {"size": facts.goal_dim, "reached": float(np.mean(dataset.goal_reached))},
        "returns": None if returns is None else _spread(returns),
        "ends": num_ends(dataset),
        "dropped_ends": manifest.get("dropped_ends"),
        "bytes": sum(array.nbytes for array in dataset.arrays.values()),
    }


def _spread(values: np.ndarray) -> dict[str, float | None]:
    """The smallest, mean and largest of some numbers; None where it is not finite, as JSON demands."""
    found = {"min": np.min(values), "mean": np.mean(values), "max": np.max(values)}
    return {name: float(value) if np.isfinite(value) else None for name, value in found.items()}


def described(folder: Path) -> str:
    """A description of a dataset for a person to read.

    Raises:
      DataError: if it is not a dataset, or is damaged.
    """
    facts = read_facts(folder)
    dataset, manifest = load_dataset(folder, any_value=True)
    lengths = dataset.lengths
    quartiles = ", ".join(f"{q:g}" for q in np.percentile(lengths, [0, 25, 50, 75, 100]))
    num = facts.num_actions
    rows = [
        ("dataset", f"{folder}, SHA-256 {manifest['sha256'][:16]}.."),
        ("made by", _made_by(manifest)),
        ("trajectories", f"{len(dataset):,} with {facts.num_steps:,} steps"),
        (
            "lengths",
            f"mean {lengths.mean():.1f}; quartiles {quartiles}; horizon {facts.spec.horizon}",
        ),
        (
            "observations",
            f"{facts.obs_dtype}{list(facts.obs_shape)}, {_spread_in_words(dataset.obs)}",
        ),
        ("actions", f"{num} discrete" if num else f"{facts.action_dim} numbers in [-1, 1]"),
        ("  spread", _counts(dataset.actions, num) if num else _spread_in_words(dataset.actions)),
        ("goals", f"{facts.goal_dim} numbers, {_spread_in_words(dataset.achieved_goals)}"),
        ("  reached", f"at {float(np.mean(dataset.goal_reached)):.1%} of the steps"),
        ("returns", _returns(dataset)),
        ("ends", _ends(dataset) + dropped_ends.in_words(read_manifest(folder)[1].dropped_ends)),
        ("size", _size(folder, dataset)),
    ]
    if facts.spec.action_low:
        bounds = ", ".join(
            f"[{low:g}, {high:g}]"
            for low, high in zip(facts.spec.action_low, facts.spec.action_high, strict=True)
        )
        rows.insert(7, ("  were", f"{bounds} in the logs"))
    return "\n".join(f"{name:<14}{printable(text)}" for name, text in rows)


def _made_by(manifest: Mapping[str, Any]) -> str:
    made = manifest.get("imported")
    if isinstance(made, dict):
        who = made.get("author") or made.get("by") or "somebody"
        return f"{who}: {made.get('kind')} {made.get('source')}, goals {made.get('goal')}"
    if "policy" in manifest:
        return f"{manifest['policy']} in {manifest.get('env')}, seed {manifest.get('seed')}"
    return "not known"


def _spread_in_words(array: np.ndarray) -> str:
    """The range, mean and standard deviation of all numbers in an array, in words."""
    low, high, total, squares, num = np.inf, -np.inf, 0.0, 0.0, 0
    for _, piece in pieces(array):
        rows = piece.astype(np.float64)
        low, high = min(low, rows.min()), max(high, rows.max())
        total, squares, num = total + rows.sum(), squares + (rows**2).sum(), num + rows.size
    mean = total / num
    std = max(squares / num - mean**2, 0.0) ** 0.5
    return f"from {low:.4g} to {high:.4g}, mean {mean:.4g}, standard deviation {std:.4g}"


def _counts(actions: np.ndarray, num: int) -> str:
    shares = np.bincount(np.asarray(actions), minlength=num) / len(actions)
    text = ", ".join(f"{index} {share:.1%}" for index, share in enumerate(shares[:20]))
    return f"{text}, .." if num > 20 else text


def returns_of(dataset: Dataset) -> np.ndarray | None:
    """The return of each trajectory; None without rewards."""
    if dataset.rewards is None:
        return None
    return np.add.reduceat(np.asarray(dataset.rewards, np.float64), dataset.starts)


def num_ends(dataset: Dataset) -> dict[str, int] | None:
    """The number of trajectories that ended in each way; None if it is not known."""
    if dataset.terminated is None or dataset.truncated is None:
        return None
    neither = ~dataset.terminated & ~dataset.truncated
    ways = {"terminated": dataset.terminated, "truncated": dataset.truncated, "neither": neither}
    return {way: int(rows.sum()) for way, rows in ways.items()}


def _returns(dataset: Dataset) -> str:
    if (returns := returns_of(dataset)) is None:
        return "not known, since there are no rewards"
    quartiles = ", ".join(f"{q:.4g}" for q in np.percentile(returns, [0, 25, 50, 75, 100]))
    return f"mean {returns.mean():.4g}; quartiles {quartiles}"


def _ends(dataset: Dataset) -> str:
    nums = num_ends(dataset)
    return "not known" if nums is None else ", ".join(f"{num} {way}" for way, num in nums.items())


def _size(folder: Path, dataset: Dataset) -> str:
    on_disk = sum(path.stat().st_size for path in Path(folder).iterdir() if path.is_file())
    arrays = dataset.arrays
    mapped = {
        n: a
        for n, a in arrays.items()
        if isinstance(a, np.memmap) and n in (*STEP_ARRAYS, "rewards")
    }
    in_memory = sum(a.nbytes for a in arrays.values())
    text = f"{on_disk / 1e6:,.2f} MB on disk, {in_memory / 1e6:,.2f} MB as arrays"
    return f"{text}, which are mapped and not read" if mapped else f"{text}, which are in memory"
