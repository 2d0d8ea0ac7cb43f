"""How often episodes achieved each named goal of their world, as a Markdown table.

python -m examples.achieved RUN ..

Each run has two columns: the share of episodes under its initial prompt, and under its final ones. The
first column orders the goals.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.store.summary import read_summary
from experiments.store.tables import table


def achieved_table(folders: Sequence[Path]) -> str:
    """The table of some runs whose world names its goals."""
    shares: list[dict[str, list[float]]] = []
    head = ["%"]
    for folder in folders:
        summary = read_summary(folder)
        shares.append(summary["achieved"])
        head += [f"{summary['env']}: (g^M)", f"{summary['method']}"]
    names = sorted(shares[0], key=lambda name: -shares[0][name][0])
    rows = [
        [name.replace("_", " "), *(f"{100 * share:.1f}" for run in shares for share in run[name])]
        for name in names
    ]
    return table(head, rows)


if __name__ == "__main__":
    print(achieved_table([Path(name) for name in sys.argv[1:]]))
