"""Searches that ended below the optimum, and whether an episode of theirs reached it nevertheless.

python -m examples.stuck results/kitchen/{ucb,bpe,explore}
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

OPTIMUM = 1.0 - 1e-5  # of a world whose returns end at 1, such as Kitchen


def count_stuck(folder: Path) -> np.ndarray:
    """Numbers of searches of a run, by seed and task, whose optimized prompt is not optimal.

    Returns:
      Three numbers: all of them, those in which a greedy episode reached the optimum, and those in which an
      episode with sampled actions did.
    """
    with np.load(folder / "results.npz") as arrays:
        stuck = arrays["eval_returns"][:, :, -1] < OPTIMUM
        optimal = arrays["returns"] >= OPTIMUM
        greedy = arrays["choice.greedy"]
    by = [np.any(optimal & greedy, axis=2), np.any(optimal & ~greedy, axis=2)]
    return np.array([stuck.sum(), *(np.sum(stuck & reached) for reached in by)])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="+")
    args = parser.parse_args()
    total = np.zeros(3, int)
    for run in args.runs:
        total += (counts := count_stuck(run))
        print(
            f"{run}: {counts[0]} below the optimum; greedy episodes reached it in {counts[1]}, ",
            end="",
        )
        print(f"sampled ones in {counts[2]}")
    print(f"together: {total[0]}, {total[1]}, {total[2]}")
