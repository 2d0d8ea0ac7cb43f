"""Compare adaptations in one table: ``python -m experiments.table runs/adapt/maze15/*``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.runtime import Common, run
from mgpo_jax.errors import DataError, UsageError

# Table 2 of the paper: mean return over test tasks of its own, std over 3 seeds.
PAPER = {
    "maze15": {
        "grips": "-0.56 ± 0.09",
        "bbt": "-0.80 ± 0.16",
        "explore": "-0.71 ± 0.03",
        "ucb": "-0.41 ± 0.10",
        "bpe": "-0.38 ± 0.05",
    },
    "maze30": {
        "grips": "-13.01 ± 1.22",
        "bbt": "-12.72 ± 2.22",
        "explore": "-14.74 ± 0.49",
        "ucb": "-14.21 ± 0.19",
        "bpe": "-14.86 ± 1.32",
    },
    "gridworld": {
        "grips": "0.40 ± 0.01",
        "bbt": "0.42 ± 0.03",
        "explore": "0.48 ± 0.01",
        "ucb": "0.58 ± 0.03",
        "bpe": "0.57 ± 0.01",
    },
    "kitchen": {
        "grips": "0.54 ± 0.09",
        "bbt": "0.74 ± 0.06",
        "explore": "0.47 ± 0.05",
        "ucb": "0.63 ± 0.02",
        "bpe": "0.65 ± 0.02",
    },
}


@dataclass(frozen=True)
class TableConfig(Common):
    """Settings of ``experiments.table``."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result folders of adaptations."""


def read_summary(folder: Path) -> dict[str, Any]:
    """``summary.json`` of a result folder."""
    try:
        return json.loads((folder / "summary.json").read_text())
    except (OSError, ValueError):
        raise DataError(f"{folder} holds no readable summary.json") from None


def markdown(summaries: list[dict[str, Any]]) -> str:
    """One row for each adaptation, in the order given."""
    head = [
        "env", "optimizer", "initial", "final (mean ± std over seeds)", "IQM [95 %]", "optimum",
        "regret", "after 40", "solved optimally", "paper: final",
    ]  # fmt: skip
    rows = [head, ["---"] * len(head)]
    for summary in summaries:
        low, high = summary["final_return_iqm_95"]
        after_40 = summary["regret_after_40"]
        rows.append(
            [
                summary["env"],
                summary["optimizer"],
                f"{summary['initial_return']:.2f}",
                f"{summary['final_return']:.3f} ± {summary['final_return_std_over_seeds']:.3f}",
                f"{summary['final_return_iqm']:.3f} [{low:.3f}, {high:.3f}]",
                f"{summary['optimal_return']:.3f}",
                f"{summary['regret']:.3f}",
                "" if after_40 is None else f"{after_40:.3f}",
                f"{100 * summary['solved_optimally']:.0f} %",
                PAPER.get(summary["env"], {}).get(summary["optimizer"], ""),
            ]
        )
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def main(config: TableConfig) -> None:
    """Print a Markdown table of adaptations beside the paper's Table 2."""
    if not config.runs:
        raise UsageError("no result folder given; usage: python -m experiments.table RUN_DIR ...")
    print(markdown([read_summary(folder) for folder in config.runs]))


if __name__ == "__main__":
    run(TableConfig, main)
