"""Mean returns after given numbers of episodes, as a Markdown table with a row for each run.

python -m examples.over_time RUN ..

The runs must be of one world. The last return of a run has the standard deviation over seeds as well. Cells
are empty where a run was not evaluated: methods that learn nothing may have one episode.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.store.paper import paper_final
from experiments.store.rows import read_row
from experiments.store.statistics import seed_spread
from experiments.store.tables import table
from mgpo_jax.settings import flag

EPISODES = (1, 10, 20, 40, 60, 80, 100)


def over_time(folder: Path) -> list[str]:
    """The cells of a run: its method and settings, its mean returns, and the paper's final return."""
    row = read_row(folder)
    method = row.summary["method"]
    others = {name: value for name, value in row.settings.items() if name != "eval_every"}
    flags = [f"{flag(name)} {value}" for name, value in others.items()]
    one_seed = " (one seed)" if row.summary["num_seeds"] == 1 else ""
    with np.load(folder / "results.npz") as arrays:
        after, returns = arrays["eval_episodes"].tolist(), arrays["eval_returns"].astype(np.float64)
    known = [episode for episode in EPISODES if episode in after]
    spreads = [seed_spread(returns[:, :, after.index(episode)]) for episode in known]
    means = [f"{spread.mean:.2f}" for spread in spreads]
    if spreads[-1].std is not None:
        means[-1] += f" ± {spreads[-1].std:.2f}"
    shown = dict(zip(known, means, strict=True))
    cells = [shown.get(episode, "") for episode in EPISODES]
    paper = paper_final(row.summary["env"], method) if row.like_the_paper else ""
    return [f"`{' '.join([method, *flags])}`{one_seed}", *cells, paper]


def main(folders: Sequence[Path]) -> None:
    """Print the table."""
    head = ["after", *map(str, EPISODES), "paper: 100"]
    print(table(head, [over_time(folder) for folder in folders]))


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
