"""Adapt a policy to unseen tasks: ``python -m experiments.adapt --method ucb``."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from typing import NoReturn

import envs
from envs.errors import UsageError
from experiments.runtime import early_values, refuse_existing, run
from experiments.store.settings import DEFAULT_WORLD, AdaptConfig
from mgpo_jax import methods
from mgpo_jax.methods import METHODS, Method, foreign_setting
from mgpo_jax.settings import flag


def adapt_default(argv: Sequence[str]) -> AdaptConfig:
    """The defaults, with the hyper-parameters of the method that ``--method`` names.

    Raises:
      UsageError: for a flag that belongs to another method.
    """
    early = early_values(argv, env=DEFAULT_WORLD, method__bandit="ucb")
    method = methods.find(early["method"])
    _refuse_foreign_flags(argv, method)
    return AdaptConfig(method=early["method"], hyper=method.hyper())


def _refuse_foreign_flags(argv: Sequence[str], method: Method) -> None:
    """Raise ``UsageError`` for a flag that only other methods have."""
    own = {f.name for kind in (AdaptConfig, method.hyper) for f in dataclasses.fields(kind)}
    others = {f.name for other in METHODS.usable() for f in dataclasses.fields(other.hyper)}
    given = {word.split("=", 1)[0].replace("--no-", "--") for word in argv if word[:2] == "--"}
    for name in sorted(others - own):
        if flag(name) in given or f"--{name}" in given:
            raise foreign_setting(name, method)


def main(config: AdaptConfig) -> None:
    """Adapt to each task within a budget of episodes, and judge what was found."""
    if config.validation and config.tasks is not None:
        raise UsageError("--validation draws the tasks; leave out --tasks")
    refuse_existing(config.folder, "remove it", "choose another with --out")
    world = envs.find(config.env)
    from experiments.adaptation import adapt_and_save, chosen_tasks
    from experiments.store.summary import printed
    from mgpo_jax.policy_files import load_policy

    env = envs.make(config.env)
    policy = load_policy(world, config.policy)
    tasks = chosen_tasks(world, env, config.tasks, config.validation)
    results = adapt_and_save(config.folder, config, world, env, policy, tasks)
    print(printed(results.summary))
    if config.figures:
        from experiments.drawing import draw_run

        draw_run(world, results, config.folder)
    print(f"results in {config.folder}", file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(AdaptConfig, main, adapt_default, argv)


if __name__ == "__main__":
    command()
