"""Adapt a policy to unseen tasks: ``python -m experiments.adapt --method ucb``."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from collections.abc import Iterable, Sequence
from typing import NoReturn

import envs
from envs.errors import UsageError
from experiments.joining import check_flags, join
from experiments.runtime import refuse_existing, run, say
from experiments.store.adapt_settings import AdaptConfig
from mgpo_jax import methods, processes
from mgpo_jax.methods import METHODS, foreign_setting
from mgpo_jax.settings import flag


def adapt_default(config: AdaptConfig, flags: Iterable[str] = ()) -> AdaptConfig:
    """The default settings, with the hyper-parameters of the config's method in its world.

    Args:
      config: settings without hyper-parameters.
      flags: the other flags on the command line.

    Raises:
      UsageError: for a flag that belongs to another method, or a world or method that does not exist.
    """
    method = methods.find(config.method)
    own = {field.name for field in dataclasses.fields(method.hyper)}
    others = {f.name for other in METHODS.usable() for f in dataclasses.fields(other.hyper)}
    for name in sorted(others - own):
        if not {flag(name), flag(f"no_{name}")}.isdisjoint(flags):
            raise foreign_setting(name, method)
    hyper = method.hyper_in(envs.find(config.env))
    return AdaptConfig(method=config.method, hyper=hyper)


def main(config: AdaptConfig) -> None:
    """Adapt to each task within a budget of episodes, and evaluate the result."""
    check_flags(config)
    if config.validation and config.tasks is not None:
        raise UsageError("--validation draws the tasks; leave out --tasks")
    if config.validation_seed and not config.validation:
        raise UsageError("--validation-seed says which validation tasks to draw; add --validation")
    folder = config.folder
    if config.sweep:
        from experiments.sweeping import check_finished, show, sweep_and_save, variants

        variants(config)
    if not (config.resume and os.path.isdir(folder)):
        refuse_existing(folder, "remove it", "choose another folder with --out")
    world = envs.find(config.env)
    join(config)
    from envs.wrappers import behind_noise
    from experiments.adaptation import adapt_and_save, chosen_tasks, finished
    from experiments.store.summary_text import printed
    from mgpo_jax.policy_files import load_policy

    env = behind_noise(envs.make(config.env), config.obs_noise, config.action_noise)
    policy = load_policy(world, config.policy, methods.find(config.method).policy)
    tasks = chosen_tasks(world, env, config.tasks, config.validation, config.validation_seed)
    if config.dry_run:
        from experiments.forecasts import of_adaptation

        say(of_adaptation(config, world, env, policy, tasks))
        return
    if config.sweep:
        if not processes.from_first(folder.is_dir):
            sweep_and_save(config, world, env, policy, tasks)
        elif processes.is_first():
            check_finished(config, policy, tasks)
            print(f"{folder} is already finished", file=sys.stderr)
        if processes.is_first():
            show(config)
        print(f"results in {folder}", file=sys.stderr)
        return
    results = None
    if not processes.from_first(folder.is_dir):
        results = adapt_and_save(folder, config, world, env, policy, tasks)
    elif processes.is_first():
        results = finished(folder, config, policy, tasks)
        print(f"{folder} is already finished", file=sys.stderr)
    if results is None:  # only process 0 has them
        return
    say(json.dumps(results.summary, indent=2) if config.json else printed(results.summary))
    if config.figures:
        from experiments.drawing import draw_run

        draw_run(world, results, folder)
        from experiments.pages.report import report_of_run

        report_of_run(folder)
    print(f"results in {folder}", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(AdaptConfig, main, adapt_default, argv)


if __name__ == "__main__":
    command()
