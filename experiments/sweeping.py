"""``adapt --sweep c=0.1,1,10``: sweep over values of hyper-parameters, all in one compiled program."""

from __future__ import annotations

import dataclasses
import itertools
import json
from contextlib import suppress
from typing import Any

from envs.base import Environment, Task
from envs.errors import UsageError, nearest, shown
from envs.registry import World
from experiments.adaptation import adapt_all, deciding, finished, results_with_summary
from experiments.runtime import say
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.provenance import provenance
from experiments.store.result_files import write_results
from experiments.store.work import long_work
from mgpo_jax import methods, processes
from mgpo_jax.methods import foreign_setting, split_hyper
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.settings import check_settings, check_values, get_parts, types_of


def variants(config: AdaptConfig) -> dict[str, AdaptConfig]:
    """The settings of each variant by name, such as ``c=0.1``; several hyper-parameters form a grid.

    Raises:
      UsageError: for a sweep that is malformed, or over a setting that one program cannot vary.
    """
    swept = dict(_values(text, config) for text in config.sweep)
    if len(swept) < len(config.sweep):
        raise UsageError("--sweep names a setting twice; give all of its values at once")
    found: dict[str, AdaptConfig] = {}
    for values in itertools.product(*swept.values()):
        named = dict(zip(swept, values, strict=True))
        name = ",".join(f"{key}={value:g}" for key, value in named.items())
        if name in found:
            raise UsageError(f"--sweep has {name} twice; leave one of them out")
        hyper = dataclasses.replace(config.hyper, **named)
        check_settings(hyper)
        found[name] = dataclasses.replace(config, hyper=hyper, sweep=(), out=config.folder / name)
    try:
        split_hyper([variant.hyper for variant in found.values()])
    except UsageError as error:
        raise UsageError(f"--sweep: {error}; run adapt once for each value") from None
    return found


def _values(text: str, config: AdaptConfig) -> tuple[str, list[int | float]]:
    """A hyper-parameter and its values from text such as ``c=0.1,1,10``."""
    name, sign, listed = text.partition("=")
    name = name.replace("-", "_")
    if not (name and sign and listed):
        raise UsageError(f"--sweep needs words such as c=0.1,1,10, found {shown(text)}")
    own = {field.name: field for field in dataclasses.fields(config.hyper)}
    if name not in own:
        method = methods.find(config.method)
        if not own:
            raise foreign_setting(name, method)
        raise nearest(name, list(own), f"hyper-parameter of {method.name}")
    settings_class: Any = type(config.hyper)
    kind = int if int in get_parts(types_of(settings_class)[name]) else float
    values: list[int | float] = []
    for word in listed.split(","):
        value: Any = word  # the check refuses words that are not numbers
        with suppress(ValueError):
            value = kind(word)
        try:
            check_values(type(config.hyper), {name: value})
        except UsageError as error:
            raise UsageError(f"--sweep {shown(text)}: {error}") from None
        values.append(value)
    return name, values


def check_finished(config: AdaptConfig, policy: LoadedPolicy, tasks: Task) -> None:
    """Check a sweep that was finished before ``--resume`` was given; raises as ``finished`` does."""
    for name, variant in variants(config).items():
        if not variant.folder.is_dir():
            raise UsageError(
                f"{config.folder} holds no results of {name}; choose another folder with --out"
            )
        finished(variant.folder, variant, policy, tasks)


def show(config: AdaptConfig) -> None:
    """Print a table of the variants, and draw their learning curves in one figure.

    A figure that was changed, or was not written by a command, is kept, with a line on stderr.
    """
    from experiments.drawing import is_kept, write
    from experiments.figures import later, learning_curve
    from experiments.store.result_files import load_results
    from experiments.store.rows import as_json, comparison, read_row

    folders = [variant.folder for variant in variants(config).values()]
    rows = [read_row(folder) for folder in folders]
    say(json.dumps([as_json(row) for row in rows], indent=2) if config.json else comparison(rows))
    path = config.folder / "learning_curve.png"
    if config.figures and not is_kept(path):
        curves = {f"{config.method} ({f.name})": load_results(f, parts=()) for f in folders}
        write(path, later(learning_curve, curves, config.env))


def sweep_and_save(
    config: AdaptConfig, world: World, env: Environment, policy: LoadedPolicy, tasks: Task
) -> None:
    """Adapt with every variant, and write the results of each to a folder below ``config.folder``.

    Raises:
      UsageError: for an invalid sweep, or unfinished work without ``--resume``.
      DataError: if the folder exists, another process makes it, or a return is not finite.
    """
    named = variants(config)
    settings = {name: deciding(variant, policy, tasks) for name, variant in named.items()}
    with long_work(config.folder, settings, provenance(), config.resume) as work:
        outcomes = adapt_all(world, env, policy, tasks, list(named.values()), work.journal)
        if not processes.is_first():
            outcomes, named = [], {}
        for (name, variant), outcome in zip(named.items(), outcomes, strict=True):
            place = work.place / name
            place.mkdir()
            results = results_with_summary(variant, env, policy, tasks, outcome)
            write_results(
                place, results, config.folder / name, {**work.meta, "settings": settings[name]}
            )
