"""Draw figures from adaptation results: ``python -m experiments.plot RUN_DIR [RUN_DIR ...]``."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
import tyro

from experiments.configs import make_env
from experiments.figures import STYLE, learning_curve, pictures
from experiments.figures.base import Save
from experiments.policies import load_network_of
from experiments.results import Results, load_results
from experiments.runtime import Common, run
from mgpo_jax.errors import UsageError
from mgpo_jax.policy import Policy, transformer_policy


@dataclass(frozen=True)
class PlotConfig(Common):
    """Settings of ``experiments.plot``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of adaptations; those of one world share its figures."""
    out: Path = Path("figures")
    """Folder to write."""
    tasks: tuple[int, ...] = ()
    """Tasks to draw, counted from 0 (default: the four that the first run improved most)."""
    seed: int = 0
    """Which seed of the adaptations to draw, counted from 0."""


def main(config: PlotConfig) -> None:
    """Draw every figure that the results of some adaptations allow."""
    if not config.runs:
        raise UsageError("no result folder given; usage: python -m experiments.plot RUN_DIR ...")
    by_env: dict[str, dict[Path, Results]] = {}
    for folder in dict.fromkeys(config.runs):
        result = load_results(folder)
        by_env.setdefault(result.config["env"], {})[folder] = result
    for folders in by_env.values():
        _check_together(config, folders)

    config.out.mkdir(parents=True, exist_ok=True)
    for env_name, folders in by_env.items():
        results = label_runs(folders)
        curve = learning_curve(results, env_name)
        _save(curve.savefig, config.out / f"{env_name}_learning_curve.png")
        which = config.tasks or next(iter(results.values())).most_improved()
        drawn = pictures(make_env(env_name)).draw_all(results, _load, which, config.seed)
        for name, save in drawn:
            _save(save, config.out / f"{env_name}_{name}")


def draw_run(folder: Path) -> None:
    """Draw into the folder of one adaptation what needs no policy."""
    result = load_results(folder)
    env_name = result.config["env"]
    curve = learning_curve({result.config["bandit"]: result}, env_name)
    _save(curve.savefig, folder / "learning_curve.png")
    for name, save in pictures(make_env(env_name)).draw_run(result, result.most_improved()):
        _save(save, folder / name)


def label_runs(folders: Mapping[Path, Results]) -> dict[str, Results]:
    """Results by method name, and folder where one method ran more than once."""
    methods = [result.config["bandit"] for result in folders.values()]
    labels = [
        method if methods.count(method) == 1 else f"{method} ({folder})"
        for method, folder in zip(methods, folders, strict=True)
    ]
    return dict(zip(labels, folders.values(), strict=True))


def _check_together(config: PlotConfig, folders: Mapping[Path, Results]) -> None:
    """Raise ``UsageError`` for runs that no figure can compare, or that lack what is asked for."""
    first_folder, first = next(iter(folders.items()))
    for folder, result in folders.items():
        same = result.tasks.keys() == first.tasks.keys() and all(
            np.array_equal(array, first.tasks[name]) for name, array in result.tasks.items()
        )
        if not same:
            raise UsageError(
                f"{folder} and {first_folder} ran on different tasks; plot them one at a time"
            )
        if not 0 <= config.seed < len(result.returns):
            raise UsageError(f"--seed {config.seed}: {folder} has {len(result.returns)} seeds")
    num = len(first.optimal_returns)
    if not all(0 <= index < num for index in config.tasks):
        raise UsageError(f"--tasks: {first.config['env']} has the tasks 0 to {num - 1}")


def _load(result: Results) -> Policy:
    network = load_network_of(result, make_env(result.config["env"]))
    return transformer_policy(network.config, network.params)


def _save(save: Save, path: Path) -> None:
    with mpl.rc_context(STYLE):
        save(path)
    print(path, file=sys.stderr)


if __name__ == "__main__":
    run(PlotConfig, main)
