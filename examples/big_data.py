"""How much memory a training on large data takes: ``python -m examples.big_data FOLDER --run RUN``.

Writes a dataset of random pictures, one trajectory after another, trains on it in a process of its own, and
prints the peak of the resident memory of both. The numbers in docs/guides/own-data.md are of 32,600
trajectories, which are 20.5 GB.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np

from mgpo_jax.dataset import finish_mapped
from mgpo_jax.files import new_folder
from mgpo_jax.growing import GrowingFiles
from mgpo_jax.memory import peak_bytes

STEPS, PICTURE = 50, (64, 64, 3)
"""Number of steps of each trajectory, and the shape of its pictures of bytes."""
TRAINING = (
    "--no-standardize-obs --embed-dim 32 --num-layers 1 --tokens-per-step 1 --batch-size 16 --bucket 50 "
    "--steps 200 --warmup-steps 10 --eval-every 100 --save-every 100"
)
"""Flags of the training."""


def trajectory(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The rows of a trajectory of random pictures, actions and goals."""
    pictures = rng.integers(0, 256, (STEPS + 1, *PICTURE), np.uint8)
    goals = rng.normal(size=(STEPS, 2)).astype(np.float32)
    return {
        "obs": pictures[:STEPS],
        "actions": rng.uniform(-1, 1, (STEPS, 2)).astype(np.float32),
        "achieved_goals": goals,
        "goal_reached": np.ones(STEPS, bool),
        "outcomes": goals,
        "last_obs": pictures[STEPS:],
        "lengths": np.array([STEPS], np.int32),
    }


def write(folder: Path, num: int) -> None:
    """Write a dataset of ``num`` trajectories to a new folder."""
    rng = np.random.default_rng(0)
    with new_folder(folder) as place, GrowingFiles(place) as files:
        for _ in range(num):
            files.append(trajectory(rng))
        finish_mapped(place, files.finish(), num, num * STEPS, {"seed": 0})


def main() -> None:
    """Write the data if they are not there, and train on them if a folder for that is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the dataset, written if it is missing")
    parser.add_argument("--trajectories", type=int, default=32_600, help="0.63 MB each")
    parser.add_argument("--run", type=Path, help="folder of the training; without it none is made")
    parser.add_argument("--steps", type=int, default=200, help="gradient steps of the training")
    config = parser.parse_args()
    if not config.folder.exists():
        write(config.folder, config.trajectories)
        size = sum(path.stat().st_size for path in config.folder.iterdir()) / 1e9
        peak = peak_bytes() / 1e6
        print(f"written: {size:.2f} GB on disk, peak {peak:,.0f} MB")
    if config.run is not None:
        flags = TRAINING.replace("--steps 200", f"--steps {config.steps}").split()
        command = ["-m", "experiments.pretrain", "--data", str(config.folder), *flags]
        subprocess.run([sys.executable, *command, "--out", str(config.run)], check=True)
        print(f"trained: peak {peak_bytes(resource.RUSAGE_CHILDREN) / 1e6:,.0f} MB")


if __name__ == "__main__":
    main()
