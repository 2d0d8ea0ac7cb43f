"""Pre-train a policy: ``python -m experiments.pretrain --env maze15``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

from envs.errors import UsageError
from experiments.runtime import refuse_existing, run
from experiments.store.settings import PretrainConfig, pretrain_default


def main(config: PretrainConfig) -> None:
    """Pre-train the multi-goal Transformer on hindsight prompts."""
    if config.train.batch_size % config.train.part_size:
        raise UsageError(
            f"--batch-size {config.train.batch_size} is not a multiple of --part-size "
            f"{config.train.part_size}"
        )
    if not config.resume:
        refuse_existing(config.folder, "continue it with --resume", "choose another with --out")
    from experiments.training import train

    train(config)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(PretrainConfig, main, pretrain_default, argv)


if __name__ == "__main__":
    command()
