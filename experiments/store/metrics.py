"""The metrics of a pre-training run: one JSON object a line in ``metrics.jsonl``."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from envs.errors import DataError, UsageError
from experiments.store.settings import PretrainConfig
from mgpo_jax.files import to_json

METRICS = "metrics.jsonl"


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The rows of a ``metrics.jsonl``.

    Raises:
      DataError: if it is missing, or a line is no JSON object with a step.
    """
    try:
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        assert all(isinstance(row["step"], int) for row in rows)
    except (AssertionError, KeyError, OSError, TypeError, ValueError):
        raise DataError(f"{path} is missing or not readable JSON lines") from None
    return rows


class Metrics:
    """Appends rows to ``metrics.jsonl`` and, if asked, to TensorBoard and Weights & Biases."""

    def __init__(self, folder: Path, config: PretrainConfig, first_step: int) -> None:
        self.path = folder / METRICS
        rows = read_metrics(self.path) if self.path.exists() else []
        # A resumed run writes again what came after its checkpoint.
        kept = [json.dumps(row) for row in rows if row["step"] <= first_step]
        self.path.write_text("".join(row + "\n" for row in kept))
        self.writers: list[Callable[[dict[str, float], int], Any]] = []
        if config.tb:
            board = _optional("tensorboardX", "tb").SummaryWriter(str(folder / "tensorboard"))
            self.writers.append(
                lambda row, step: [board.add_scalar(k, v, step) for k, v in row.items()]
            )
        if config.wandb:
            wandb = _optional("wandb", "wandb")
            wandb.init(project="mgpo-jax", name=str(folder), config=to_json(config))
            self.writers.append(lambda row, step: wandb.log(row, step=step))

    def write(self, step: int, row: dict[str, float]) -> None:
        with open(self.path, "a") as file:
            file.write(json.dumps({"step": step, **row}) + "\n")
        for writer in self.writers:
            writer(row, step)


def _optional(module: str, extra: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        raise UsageError(f'{module} is not installed; run `pip install -e ".[{extra}]"`') from None
