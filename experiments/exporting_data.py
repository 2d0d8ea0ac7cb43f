"""Export datasets for other programs: as flat arrays in an npz file, or as a Minari dataset."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from envs.errors import DataError
from experiments.converting import OWN_BY_STEP, OWN_BY_TRAJECTORY
from experiments.sources import OWN
from experiments.store.extras import import_extra
from mgpo_jax.dataset import Dataset, load_dataset
from mgpo_jax.files import new_folder, write_arrays
from mgpo_jax.manifest import Facts, read_facts


def export_dataset(folder: Path, out: Path, author: str = "") -> None:
    """Write a dataset as logs.

    Args:
      folder: folder of the dataset.
      out: an npz file, or the folder of a Minari dataset.
      author: author in the metadata of a Minari dataset.

    Raises:
      DataError: if the dataset is damaged, or has no observations after its last actions.
    """
    facts = read_facts(folder)
    dataset, _ = load_dataset(folder)
    if dataset.last_obs is None:
        raise DataError(
            f"{folder} has no observations after the last actions, which logs need; collect it again"
        )
    if out.suffix == ".npz":
        write_arrays(out, flat_arrays(dataset, facts))
    else:
        _write_minari(dataset, facts, out, author)


def _sized(dataset: Dataset, facts: Facts) -> dict[str, np.ndarray]:
    """The entries (``SIZED``) with which an import restores what the arrays do not say."""
    spec = facts.spec
    found: dict[str, Any] = {
        "horizon": [spec.horizon],
        "cut_in_hindsight": [spec.truncate_in_hindsight],
        "without_rewards": [dataset.rewards is None],
        "without_ends": [dataset.terminated is None],
    }
    if facts.num_actions is not None:
        found["num_actions"] = [facts.num_actions]
    if spec.action_low:
        found |= {"action_low": spec.action_low, "action_high": spec.action_high}
    return {name: np.array(value) for name, value in found.items()}


def _ends(dataset: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Whether each trajectory was terminated, and truncated; if unknown, it counts as truncated."""
    unknown = np.ones(len(dataset), bool)
    if dataset.terminated is None or dataset.truncated is None:
        return ~unknown, unknown
    return dataset.terminated, dataset.truncated


def flat_arrays(dataset: Dataset, facts: Facts) -> dict[str, np.ndarray]:
    """All trajectories one after the other in D4RL's format, with the other arrays of the dataset.

    ``observations`` and ``next_observations`` have a row for every action, so the latter only add the last
    observation of each trajectory.
    """
    last = np.cumsum(dataset.lengths) - 1
    after = np.concatenate([dataset.obs[1:], dataset.obs[:1]])
    after[last] = dataset.last_obs
    flags = {}
    for name, ended in zip(("terminals", "timeouts"), _ends(dataset), strict=True):
        flags[name] = np.zeros(len(dataset.actions), bool)
        flags[name][last] = ended
    kept = {n: a for n, a in dataset.arrays.items() if n in (*OWN_BY_STEP, *OWN_BY_TRAJECTORY)}
    rewards = {} if dataset.rewards is None else {"rewards": dataset.rewards}
    return {
        "observations": dataset.obs,
        "next_observations": after,
        "actions": dataset.actions,
        **rewards,
        **flags,
        "lengths": dataset.lengths,
        **kept,
        **_sized(dataset, facts),
    }


def _spaces(facts: Facts) -> tuple[Any, Any]:
    """The gymnasium spaces of observations and actions."""
    import gymnasium

    spaces: Any = gymnasium.spaces
    dtype = np.dtype(facts.obs_dtype)
    if dtype.kind == "b":
        seen = spaces.MultiBinary(facts.obs_shape)
    else:
        whole = dtype.kind in "iu"
        low, high = (np.iinfo(dtype).min, np.iinfo(dtype).max) if whole else (-np.inf, np.inf)
        seen = spaces.Box(low, high, facts.obs_shape, dtype.type)
    if facts.num_actions is not None:
        return seen, spaces.Discrete(facts.num_actions)
    return seen, spaces.Box(-1, 1, (facts.action_dim,), np.float32)


def _write_minari(dataset: Dataset, facts: Facts, out: Path, author: str) -> None:
    """Write a Minari dataset, one trajectory at a time."""
    minari = import_extra("minari", "minari")
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    seen, acted = _spaces(facts)

    def episodes() -> Iterator[Any]:
        terminated, truncated = _ends(dataset)
        starts = dataset.starts
        assert dataset.last_obs is not None
        for index, (start, length) in enumerate(zip(starts, dataset.lengths, strict=True)):
            rows = slice(int(start), int(start) + int(length))
            flags = np.zeros((2, length), bool)
            flags[:, -1] = terminated[index], truncated[index]
            kept = {n: dataset.arrays[n][rows] for n in OWN_BY_STEP if n in dataset.arrays}
            for name in OWN_BY_TRAJECTORY:
                if name in dataset.arrays:
                    kept[name] = dataset.arrays[name][index : index + 1]
            rewards = np.zeros(length) if dataset.rewards is None else dataset.rewards[rows]
            yield EpisodeBuffer(
                observations=np.concatenate(
                    [dataset.obs[rows], dataset.last_obs[index : index + 1]]
                ),
                actions=np.array(dataset.actions[rows]),
                rewards=np.array(rewards),
                terminations=flags[0],
                truncations=flags[1],
                infos={OWN: {name: np.array(array) for name, array in kept.items()}},
            )

    sized = {
        f"{OWN}_{name}": json.loads(json.dumps(array.tolist()))
        for name, array in _sized(dataset, facts).items()
    }
    with new_folder(out) as place:
        # Lossless: JPEG would change image observations.
        storage = MinariStorage.new(place.absolute() / "data", seen, acted, jpeg_encoding=False)
        storage.update_metadata(
            {
                "dataset_id": f"{facts.spec.name}-v0",
                "minari_version": minari.__version__,
                "author": {author} if author else set(),
                **sized,
            }
        )
        storage.update_episodes(episodes())
