"""CPU-seconds per episode of the published adaptations, for estimates. Nothing here imports jax.

``speeds.json`` is part of the package, so that estimates do not need the published results, which only a
clone has. ``python -m experiments.store.speeds`` makes it again from them, in the root of a clone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from math import ceil
from pathlib import Path

from envs.registry import WORLDS, World
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.layout import META
from experiments.store.provenance import read_meta
from experiments.store.settings import file_name
from experiments.store.summary import ADAPT_AGAIN, judged_episodes, read_summary
from mgpo_jax import methods
from mgpo_jax.files import to_json, write_json
from mgpo_jax.methods import Method

SPEEDS = Path(__file__).parent / "speeds.json"
RESULTS = Path("results")


@cache
def shipped_rates(world: str) -> Mapping[str, float]:
    """CPU-seconds per episode in a world, by method, from ``speeds.json``; empty if none was measured."""
    found: dict[str, dict[str, float]] = json.loads(SPEEDS.read_text())
    return found.get(world, {})


@cache
def rates_in(folder: Path) -> Mapping[str, float]:
    """CPU-seconds per episode of the adaptations in a folder that ran on CPUs, by method."""
    folders = {name: folder / file_name(name) for name in methods.names()}
    return {
        name: 1 / read_summary(path)["episodes_per_cpu_second"]
        for name, path in folders.items()
        if path.is_dir() and cpu_seconds_of(path) is not None
    }


def cpu_seconds_of(folder: Path) -> float | None:
    """CPU-seconds of an adaptation; None if it ran on accelerators, which do most of its work."""
    meta = read_meta(folder / META, ADAPT_AGAIN)
    return read_summary(folder)["cpu_seconds"] if meta.on_cpus else None


def rate_of(rates: Mapping[str, float], method: Method) -> float | None:
    """CPU-seconds per episode of a method, from those of all methods in its world; None if none is similar.

    This is the rate of the same method, or else the mean over methods that learn in the same way. A method
    that learns nothing costs at most as much as the cheapest of all.
    """
    if method.name in rates:
        return rates[method.name]
    if not method.learns:
        return min(rates.values(), default=None)
    alike = [rate for name, rate in rates.items() if way_of(methods.find(name)) == way_of(method)]
    return sum(alike) / len(alike) if alike else None


def way_of(method: Method) -> tuple[str, type]:
    """How a method learns: the kind of its network, and the base class of its hyper-parameters."""
    return method.policy, method.hyper.__mro__[-2]  # the last class is object


def num_judging(config: AdaptConfig, world: World) -> int:
    """The number of episodes that judge one search, of its initial choice and after every segment."""
    judgements = 1 + ceil(config.episodes / config.eval_every)
    return judgements * (judged_episodes(to_json(config), world) or 1)


def num_episodes(config: AdaptConfig, world: World, tasks: int) -> int:
    """The number of episodes of an adaptation, those that judge it included."""
    return config.seeds * tasks * (config.episodes + num_judging(config, world))


def usual_cost(world: World) -> float | None:
    """CPU-seconds of the default adaptation to a world's test tasks; None if it was never measured."""
    config = AdaptConfig(env=world.name)
    rate = rate_of(shipped_rates(world.name), methods.find(config.method))
    return None if rate is None else rate * num_episodes(config, world, world.num_test_tasks)


def measured(results: Path) -> dict[str, dict[str, float]]:
    """The contents of ``speeds.json``: rates with four digits, by world and method."""
    found = {name: rates_in((results / file_name(name)).absolute()) for name in WORLDS.names()}
    return {
        world: {name: float(f"{rate:.4g}") for name, rate in sorted(rates.items())}
        for world, rates in sorted(found.items())
        if rates
    }


if __name__ == "__main__":
    write_json(SPEEDS, measured(RESULTS))
