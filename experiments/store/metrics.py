"""The metrics of a pre-training run: one JSON object per line in ``metrics.jsonl``."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import AllowInfNan, Strict

from envs.errors import DataError
from experiments.store.extras import import_extra
from experiments.store.settings import PretrainConfig
from mgpo_jax.files import to_json, write_text
from mgpo_jax.schema import read_json_lines

METRICS = "metrics.jsonl"
RESUME = "resume the run with `python -m experiments.pretrain --resume` and its other flags"


def read_metrics(path: Path, names: Collection[str] = ()) -> list[dict[str, Any]]:
    """The rows of a ``metrics.jsonl``.

    Args:
      path: the file.
      names: metrics that the last row must have.

    Raises:
      DataError: if the file is missing or has no rows, a line is not a JSON object of finite numbers, steps
        do not ascend, or the last row lacks one of ``names``.
    """
    rows = read_json_lines(path, dict[str, Annotated[float, AllowInfNan(False), Strict()]], RESUME)
    if not rows:
        raise DataError(f"{path} has no rows; {RESUME}")
    last = 0
    for number, row in enumerate(rows, 1):
        step = row.get("step", 0)
        if step <= last or not step.is_integer():
            found = f"found {step:g}" if "step" in row else "found none"
            raise DataError(
                f"{path}, line {number}: step must be an integer above {last}, {found}; {RESUME}"
            )
        row["step"] = last = int(step)
    if missing := [name for name in names if name not in rows[-1]]:
        raise DataError(f"{path}, line {len(rows)} lacks {', '.join(missing)}; {RESUME}")
    return rows


def salvaged_rows(path: Path, last_step: int) -> list[dict[str, float]]:
    """The rows of a ``metrics.jsonl`` up to a step; damaged ones are left out, with a line on stderr."""
    rows, lost = [], 0
    for line in path.read_bytes().splitlines() if path.is_file() else ():
        try:
            row = json.loads(line)
            if row["step"] <= last_step:
                rows.append({str(name): value for name, value in row.items()})
        except (KeyError, RecursionError, TypeError, ValueError):
            lost += 1
    if lost:
        print(f"{path}: {lost} rows are damaged and left out", file=sys.stderr)
    return rows


LOGGERS = {"tb": "tensorboardX", "wandb": "wandb"}  # settings, and the packages that they need


def check_loggers(config: PretrainConfig) -> None:
    """Raise ``UsageError`` for a requested logger that is not installed."""
    for setting, module in LOGGERS.items():
        if getattr(config, setting):
            import_extra(module, setting)


class Metrics:
    """Appends rows to ``metrics.jsonl`` and, if asked, to TensorBoard and Weights & Biases.

    Args:
      folder: the run folder.
      config: settings of the run.
      rows: the rows so far, from the checkpoint that the run resumes from; they replace what is in the
        file.
    """

    def __init__(
        self, folder: Path, config: PretrainConfig, rows: Sequence[Mapping[str, float]]
    ) -> None:
        self.path = folder / METRICS
        write_text(self.path, "".join(map(_line, rows)))
        self.rows = [dict(row) for row in rows]
        self.writers: list[Callable[[dict[str, float], int], Any]] = []
        if config.tb:
            board = import_extra("tensorboardX", "tb").SummaryWriter(str(folder / "tensorboard"))
            self.writers.append(
                lambda row, step: [board.add_scalar(k, v, step) for k, v in row.items()]
            )
        if config.wandb:
            wandb = import_extra("wandb", "wandb")
            wandb.init(project="mgpo-jax", name=str(folder), config=to_json(config))
            self.writers.append(lambda row, step: wandb.log(row, step=step))

    def write(self, step: int, row: dict[str, float]) -> None:
        """Append a row, which is on disk when this returns."""
        self.rows.append({"step": step, **row})
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(_line(self.rows[-1]))
            file.flush()
            os.fsync(file.fileno())
        for writer in self.writers:
            writer(row, step)


def _line(row: Mapping[str, float]) -> str:
    return json.dumps(row, allow_nan=False) + "\n"


def cpu_seconds_of_training(rows: Sequence[Mapping[str, float]]) -> float | None:
    """The CPU-seconds of a training's gradient steps, from its metrics; None if they are not recorded."""
    if not rows or any("cpu_seconds_per_step" not in row for row in rows):
        return None
    before = [0, *(row["step"] for row in rows[:-1])]
    return sum(
        row["cpu_seconds_per_step"] * (row["step"] - start)
        for row, start in zip(rows, before, strict=True)
    )
