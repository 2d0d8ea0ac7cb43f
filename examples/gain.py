"""Differences of mean returns, with their 95 % intervals over tasks.

python -m examples.gain RUN ..                        final minus initial return of each run
python -m examples.gain RUN .. --minus OTHER          final returns minus those of another run
python -m examples.gain RUN .. --minus-initial OTHER  final returns minus its initial ones

With --initial, it takes the initial returns of each run instead of the final ones.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from experiments.store.statistics import gain_over_tasks


def judged(folder: Path, index: int) -> np.ndarray:
    """The returns [S, N] of a judgement: 0 is the initial one, -1 the final one."""
    return np.load(folder / "results.npz")["eval_returns"][:, :, index]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(usage=(__doc__ or "").replace("%", "%%"))
    parser.add_argument("runs", type=Path, nargs="+")
    other = parser.add_mutually_exclusive_group()
    other.add_argument("--minus", type=Path)
    other.add_argument("--minus-initial", type=Path)
    parser.add_argument("--initial", action="store_true")
    args = parser.parse_args()
    index = 0 if args.initial else -1
    for run in args.runs:
        before = judged(args.minus or args.minus_initial or run, -1 if args.minus else 0)
        print(f"{run}: {gain_over_tasks(judged(run, index), before)}")
