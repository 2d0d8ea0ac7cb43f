"""Compare adaptations to the same tasks with each other, task by task."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.store.results import Results
from experiments.store.statistics import SeedSpread, compare
from experiments.store.tables import table

SAME = 1e-6  # returns that differ by at most this count as equal
HEAD = (
    "run", "method", "final (mean ± std over seeds)", "minus the first [95 %]",
    "better than the first with probability [95 %]", "tasks better / equal / worse",
)  # fmt: skip
FACTS = {
    "num_episodes": "budgets of episodes",
    "num_seeds": "numbers of seeds",
    "policy_sha256": "weights",
    "env": "worlds",
}
"""What all runs should have in common: names in ``summary.json``, and what messages call them."""


def as_table(runs: Sequence[Path], results: Sequence[Results]) -> str:
    """A Markdown table with a row for each run: its final return, and the difference from the first run.

    Differences are paired by task, and the bootstrap resamples seeds within each task. With one seed there
    is no interval. The return of a task is the mean over seeds.

    Raises:
      UsageError: for runs on different tasks.
    """
    first, rows = results[0], []
    for folder, result in zip(runs, results, strict=True):
        summary = result.summary
        final = SeedSpread(summary["final_return"], summary["final_return_std_over_seeds"])
        row = [str(folder), result.method, str(final)]
        if result is not first:
            difference, improvement = compare(result, first)
            row += [str(difference), str(improvement), " / ".join(map(str, _counts(result, first)))]
        rows.append(row + [""] * (len(HEAD) - len(row)))
    return table(HEAD, rows)


def as_values(runs: Sequence[Path], results: Sequence[Results]) -> dict[str, Any]:
    """What ``as_table`` shows, and the warnings, as JSON values; an interval that is unknown is null.

    Raises:
      UsageError: for runs on different tasks.
    """
    first, found = results[0], []
    for folder, result in zip(runs, results, strict=True):
        values: dict[str, Any] = {
            "run": str(folder),
            "method": result.method,
            "final_return": result.summary["final_return"],
            "final_return_std_over_seeds": result.summary["final_return_std_over_seeds"],
        }
        if result is not first:
            values |= {
                name: part._asdict() for name, part in compare(result, first)._asdict().items()
            }
            values["tasks"] = dict(
                zip(("better", "equal", "worse"), _counts(result, first), strict=True)
            )
        found.append(values)
    return {"runs": found, "warnings": list(differing(runs, results))}


def _counts(result: Results, first: Results) -> tuple[int, int, int]:
    """The numbers of tasks with a better, an equal and a worse return than in the first run."""
    change = final_returns(result) - final_returns(first)
    equal = np.abs(change) <= SAME
    return int(np.sum(change > SAME)), int(np.sum(equal)), int(np.sum(change < -SAME))


def final_returns(result: Results) -> np.ndarray:
    """The final return of each task, averaged over seeds, [N]."""
    means: np.ndarray = result.eval_returns[:, :, -1].mean(axis=0, dtype=np.float64)
    return means


def differing(runs: Sequence[Path], results: Sequence[Results]) -> Iterator[str]:
    """What makes a comparison of some runs unfair, one warning for each fact in which they differ."""
    for name, what in FACTS.items():
        found = [result.summary.get(name) for result in results]
        if len(set(found)) > 1:
            told = ", ".join(
                f"{folder} {_short(name, value)}" for folder, value in zip(runs, found, strict=True)
            )
            yield f"the runs have different {what}: {told}"


def _short(name: str, value: object) -> str:
    """A fact as text; the first twelve digits of a hash are enough to tell it from others."""
    return str(value)[:12] if name.endswith("sha256") else str(value)


def as_csv(runs: Sequence[Path], results: Sequence[Results]) -> str:
    """The final return of each task in each run, and the optimum where it is known.

    A run has a column with the mean over its seeds, and behind those of all runs a column for each seed.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    by_seed = {
        f"{folder} seed {index}": returns
        for folder, result in zip(runs, results, strict=True)
        for index, returns in enumerate(result.eval_returns[:, :, -1])
    }
    writer.writerow(["task", "optimum", *map(str, runs), *by_seed])
    columns = [results[0].optimal_returns, *map(final_returns, results), *by_seed.values()]
    for index, row in enumerate(zip(*columns, strict=True)):
        numbers = ("" if np.isnan(number) else f"{number:.6g}" for number in row)
        writer.writerow([index, *numbers])
    return text.getvalue()
