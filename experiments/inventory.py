"""``experiments.reproduce list``: which results exist, what they cost, and an estimate for the others."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import envs
from envs.errors import DataError, UsageError
from experiments import ablations, glance, robustness
from experiments.comparisons import (
    SMOKE_TASKS,
    Cell,
    cell_config,
    methods_of,
    num_seeds,
    published,
    worlds_of,
)
from experiments.paper_figures import PICTURES
from experiments.store import runs
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.metrics import METRICS, cpu_seconds_of_training, read_metrics
from experiments.store.reproduce_settings import ABLATIONS, COMPARISONS, GLANCE, ReproduceConfig
from experiments.store.settings import DEFAULT_WORLD, PretrainConfig
from experiments.store.speeds import (
    cpu_seconds_of,
    num_episodes,
    rate_of,
    shipped_rates,
)
from experiments.store.summary import read_summary
from experiments.store.tables import table
from mgpo_jax import methods
from mgpo_jax.methods import Method
from mgpo_jax.released import released_folder

HEAD = (
    "what",
    "world",
    "cells done",
    "CPU-minutes spent",
    "CPU-minutes for the rest (estimate)",
)


class Piece(NamedTuple):
    """A cell or a training: whether it exists, and its cost."""

    there: bool
    """Whether it is finished."""
    seconds: float | None
    """CPU time that it took or would take; None if it cannot be estimated."""
    counts: bool = True
    """Whether it counts as a cell of the table; trainings only add to the cost."""
    fewer: bool = False
    """Whether it is a published cell of fewer seeds than asked for."""


def jobs(config: ReproduceConfig) -> list[ReproduceConfig]:
    """The jobs of ``reproduce all`` in order, each with its worlds.

    Tables of methods cover all worlds; everything else is made for one world at a time. Ablations only
    exist at the scale ``cpu``, since their trainings have budgets of their own.
    """
    scaled = ABLATIONS if config.scale == "cpu" else ()
    tables = [replace(config, what=name) for name in COMPARISONS]
    by_world = [
        replace(config, what=name, env=(world,))
        for name in (*PICTURES, *scaled)
        for world in worlds_of_job(replace(config, what=name))
    ]
    return [*tables, *by_world, replace(config, what=GLANCE)]


def worlds_of_job(config: ReproduceConfig) -> Sequence[str]:
    """The worlds of a table, figure or ablation: those of ``--env``, else the paper's or the default."""
    return worlds_of(config) or (DEFAULT_WORLD,)


def inventory(config: ReproduceConfig) -> str:
    """A Markdown table of what exists of each table, figure and ablation in each world, and of its cost."""
    rows = []
    for job in jobs(config):
        if job.what == GLANCE:
            there = glance.file_of(job).is_file()
            rows.append([GLANCE, "all that are installed", f"{int(there)} of 1", "", ""])
            continue
        for world in worlds_of_job(job):
            try:
                pieces = list(pieces_of(job, world))
            except UsageError as error:
                rows.append([job.what, world, "-", "", str(error)])
                continue
            rows.append([job.what, world, *told(pieces)])
    return table(HEAD, rows)


def told(pieces: Sequence[Piece]) -> tuple[str, str, str]:
    """How many cells exist, their CPU-minutes, and an estimate for the missing ones."""
    cells = [piece for piece in pieces if piece.counts]
    spent = sum(piece.seconds or 0.0 for piece in pieces if piece.there) / 60
    missing = [piece.seconds for piece in pieces if not piece.there]
    known = [seconds for seconds in missing if seconds is not None]
    estimate = [f"{sum(known) / 60:.1f}"] if known else []
    estimate += ["?"] if len(known) < len(missing) else []
    done = f"{sum(piece.there for piece in cells)} of {len(cells)}"
    if fewer := sum(piece.fewer for piece in cells):
        done += f", {fewer} with fewer seeds"
    return done, f"{spent:.1f}", " + ".join(estimate)


def pieces_of(config: ReproduceConfig, world: str) -> Iterator[Piece]:
    """The cells of a table, figure or ablation in one world, and the trainings that they need.

    Raises:
      UsageError: if it is not available in this world.
    """
    if config.what in ablations.PLANS:
        yield from _ablation_pieces(replace(config, env=(world,)))
        return
    names = PICTURES[config.what].methods if config.what in PICTURES else methods_of(config)
    for name in names:
        cell, piece = _cell(config, world, name)
        if config.what != "table3":
            yield piece
            continue
        yield piece._replace(counts=False)
        yield from _noise_pieces(config, cell)


def _cell(config: ReproduceConfig, world: str, method: str) -> tuple[Cell, Piece]:
    settings = cell_config(config, world, method)
    folder = settings.folder if settings.folder.is_dir() else published(config, settings)
    if folder is not None:
        fewer = read_summary(folder)["num_seeds"] < settings.seeds
        piece = Piece(True, cpu_seconds_of(folder), fewer=fewer)
    elif settings.policy is not None and not runs.is_finished(settings.policy.parent):
        piece = Piece(False, None)  # the cost of training its policy is unknown
    else:
        piece = Piece(False, _estimate(config, settings))
    return Cell(world, method, folder), piece


def _noise_pieces(config: ReproduceConfig, cell: Cell) -> Iterator[Piece]:
    rate = seconds_per_episode(cell.world, methods.find(cell.method))
    episodes = _num_tasks(config, cell.world) * num_seeds(config)
    episodes *= robustness.num_episodes(config)
    for noise in robustness.sizes_of(config):
        if (found := robustness.known(config, cell, noise)) is not None:
            yield Piece(True, found.cpu_seconds)
        else:
            yield Piece(False, None if rate is None else rate * episodes)


def _ablation_pieces(config: ReproduceConfig) -> Iterator[Piece]:
    trainings: dict[Path, PretrainConfig] = {}
    for part in ablations.PLANS[config.what](config):
        if part.training is not None:
            trainings[part.training.folder] = part.training
        if part.results.is_dir():
            yield Piece(True, cpu_seconds_of(part.results))
        else:
            settings = AdaptConfig(
                env=config.world,
                method=part.method,
                seeds=config.seeds,
                episodes=ablations.EPISODES,
                hyper=part.hyper,
            )
            yield Piece(False, _estimate(config, settings))
    for folder, training in trainings.items():
        done = runs.is_finished(folder)
        price = _seconds_in(folder) if done else price_of(training)
        yield Piece(done, price, counts=False)


def price_of(training: PretrainConfig) -> float | None:
    """CPU-seconds of a training at the speed of the released policy's training; None if that is unknown.

    The time of a step is taken to be proportional to the size of its batch.
    """
    place = released_folder(envs.find(training.env), training.method)
    seconds, steps = _seconds_in(place), _steps_in(place)
    if seconds is None or not steps:
        return None
    batch = training.train.batch_size
    return seconds / steps * training.train.steps * batch / (_batch_size_in(place) or batch)


def _batch_size_in(folder: Path) -> int | None:
    """The size of the batches that a released network was trained with; None if that is unknown."""
    try:
        document = json.loads((folder / "config.json").read_text(encoding="utf-8"))
        return int(document["made"]["config"]["train"]["batch_size"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _seconds_in(folder: Path) -> float | None:
    """CPU-seconds of a training's gradient steps, from its metrics; None if they are not recorded."""
    return cpu_seconds_of_training(_metrics(folder))


def _steps_in(folder: Path) -> int:
    rows = _metrics(folder)
    return int(rows[-1]["step"]) if rows else 0


def _metrics(folder: Path) -> list[dict[str, float]]:
    try:
        return read_metrics(folder / METRICS)
    except DataError:
        return []


def _num_tasks(config: ReproduceConfig, world: str) -> int:
    return SMOKE_TASKS if config.scale == "smoke" else envs.find(world).num_test_tasks


def _estimate(config: ReproduceConfig, settings: AdaptConfig) -> float | None:
    """CPU-seconds of an adaptation at the speed of similar published ones; None if there are none."""
    world = envs.find(settings.env)
    rate = seconds_per_episode(settings.env, methods.find(settings.method))
    episodes = num_episodes(settings, world, _num_tasks(config, settings.env))
    return None if rate is None else rate * episodes


def seconds_per_episode(world: str, method: Method) -> float | None:
    """CPU-seconds per episode in the published adaptations in a world; None if none are similar.

    The rates are those in the package (``store/speeds.json``).
    """
    return rate_of(shipped_rates(world), method)
