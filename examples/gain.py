"""Final minus initial return, with its interval over tasks: ``python -m examples.gain RUN_DIR ..``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from experiments.store.statistics import gain_over_tasks

if __name__ == "__main__":
    for folder in sys.argv[1:]:
        returns = np.load(Path(folder) / "results.npz")["eval_returns"]
        print(f"{folder}: {gain_over_tasks(returns[:, :, -1], returns[:, :, 0])}")
