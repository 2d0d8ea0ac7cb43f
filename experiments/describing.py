"""What ``data check`` finds and what ``data info`` knows as JSON values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.soundness import Findings, num_ends, returns_of
from mgpo_jax.dataset import load_dataset
from mgpo_jax.manifest import read_facts


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
