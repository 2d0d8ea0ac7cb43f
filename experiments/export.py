"""Write a policy for other runtimes: ``python -m experiments.export --env maze15 --out policy.onnx``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from envs.errors import UsageError, printable
from experiments.runtime import Common, refuse_existing_file, run
from experiments.store.settings import DEFAULT_WORLD
from mgpo_jax.settings import Name


@dataclass(frozen=True)
class ExportConfig(Common):
    """Settings of ``experiments.export``."""

    env: Name = DEFAULT_WORLD
    """The world of the policy, by name or as module:attribute."""
    policy: Path | None = None
    """Folder of the policy (default: the world's released policy)."""
    out: Path = Path("policy.onnx")
    """Output file of the model of one step; the model that reads the prompt is written to
    NAME_prefill.onnx beside it."""


def main(config: ExportConfig) -> None:
    """Write a policy as ONNX models, which run without jax."""
    refuse_existing_file(config.out, "--out")
    if config.out.suffix != ".onnx":
        raise UsageError(f"--out {config.out} must end in .onnx")
    import envs

    world = envs.find(config.env)
    from experiments.exporting import export_onnx, prefill_path

    refuse_existing_file(prefill_path(config.out), "--out")
    export_onnx(world, config.policy, config.out)
    for path in (config.out, prefill_path(config.out)):
        print(printable(str(path)), file=sys.stderr)


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(ExportConfig, main, argv=argv)


if __name__ == "__main__":
    command()
