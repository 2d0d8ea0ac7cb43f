"""Pre-train a policy: ``python -m experiments.pretrain --env maze15``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import NoReturn

from envs.errors import UsageError
from experiments.joining import check_flags, join
from experiments.runtime import run, say
from experiments.store.presets import check_pretraining, pretrain_default
from experiments.store.recipes import schedule, told
from experiments.store.runs import check_start
from experiments.store.settings import PretrainConfig
from mgpo_jax.manifest import read_facts


def main(config: PretrainConfig) -> None:
    """Pre-train the multi-goal Transformer on hindsight prompts."""
    check_flags(config)
    check_pretraining(config)
    if config.json and not config.dry_run:
        raise UsageError(
            "--json prints the estimate of --dry-run as JSON; add --dry-run, or leave it out"
        )
    if not config.dry_run:
        check_start(config)
        join(config)
    folder = config.data.data_folder
    if folder is not None:
        print(told(config, read_facts(folder)), file=sys.stderr)
    elif config.dry_run:  # a training prints its schedule when it begins
        print(schedule(config), file=sys.stderr)
    if config.dry_run:
        from experiments.forecasts import of_training

        say(of_training(config))
        return
    from experiments.training import train

    train(config)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(PretrainConfig, main, pretrain_default, argv)


if __name__ == "__main__":
    command()
