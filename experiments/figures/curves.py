"""Curves: returns during adaptation (the paper's Figures 6 and 7), performance profiles, and trainings."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from envs.drawing import INK
from experiments.figures.style import METHODS, STYLE, method_styles, plain, styled
from experiments.store.statistics import performance_profile

if TYPE_CHECKING:
    from experiments.store.results import Results

IN_A_ROW = 3  # panels beside each other, so that their text is legible on a page
RETURN = "evaluation return"
"""Label of the return in evaluation episodes, of an optimized prompt or of a learned policy."""
TITLE_WIDTH = 70  # letters in a line of a title above a figure
WIDEST, NARROWEST = 2.8, 1.0  # width of the first and the last line of a panel, in points


@styled
def learning_curve(results: Mapping[str, Results], title: str | None = None) -> Figure:
    """Figures 6 and 7: return of the optimized prompt, or of the learned policy, over the episodes.

    Lines are means over tasks and seeds, bands the standard deviation over seeds. Lines of a single seed
    have hollow markers, and the legend says so. The optimum is drawn if it is known. An adaptation of a
    single episode is a line at its return.
    """
    figure = Figure(figsize=(4.8, 2.7), layout="constrained")
    ax = figure.add_subplot()
    _draw_curves(ax, results, None)
    if title:
        figure.suptitle(_lines(title), fontsize=STYLE["axes.titlesize"])
    for line, result in zip(ax.lines, results.values(), strict=False):  # those of optima come last
        if len(result.eval_returns) == 1 < max(len(r.eval_returns) for r in results.values()):
            line.set_label(f"{line.get_label()}, one seed")
    figure.legend(loc="outside right center")
    return figure


@styled
def learning_curves(results: Mapping[str, Mapping[str, Results]]) -> Figure:
    """Figures 6 and 7 as a whole: a panel of learning curves for each world, with one legend."""
    columns = min(IN_A_ROW, len(results))
    rows = -(-len(results) // columns)
    figure = Figure(figsize=(2.5 * columns, 2.2 * rows + 0.7), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for index, (ax, (world, of_world)) in enumerate(zip(panels, results.items(), strict=False)):
        _draw_curves(ax, of_world, world)
        ax.set_ylabel(RETURN if index % columns == 0 else "")
    for ax in panels[len(results) :]:
        ax.set_axis_off()
    entries = {
        label: line
        for ax in panels
        for line, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        entries.values(), entries.keys(), loc="outside lower center", ncols=min(4, 2 * columns)
    )
    return figure


def _draw_curves(ax: Any, results: Mapping[str, Results], title: str | None) -> None:
    """Draw the curves of a panel; later ones are narrower, so that none hides another that it equals."""
    widths = np.linspace(WIDEST, NARROWEST, len(results)) if len(results) > 1 else [2.0]
    for (label, look), width in zip(method_styles(results).items(), widths, strict=True):
        name, color, line, marker = look
        result = results[label]
        by_seed = result.eval_returns.mean(axis=1)
        mean, std = by_seed.mean(axis=0), by_seed.std(axis=0)
        episodes = result.eval_episodes
        if episodes[-1] == 1:  # enough for a method that learns nothing
            ax.axhline(mean[-1], label=name, color=color, linestyle=line)
            continue
        ax.plot(
            episodes, mean, label=name, color=color, linestyle=line, marker=marker, linewidth=width,
            markeredgecolor=color if len(by_seed) == 1 else "white", markeredgewidth=0.6,
            markerfacecolor="white" if len(by_seed) == 1 else color,
        )  # fmt: skip
        if len(by_seed) > 1:
            ax.fill_between(episodes, mean - std, mean + std, color=color, alpha=0.16, linewidth=0)
    optima = {round(float(result.optimal_returns.mean()), 6) for result in results.values()}
    for index, optimum in enumerate(sorted(filter(np.isfinite, optima))):
        label = "_" if index else "optimum"
        ax.axhline(
            optimum, color=INK, linestyle=(0, (4, 3)), linewidth=1.0, label=label, zorder=1.8
        )
    ax.set(xlabel="episodes", ylabel=RETURN, title=plain(title or ""))
    ax.set_xlim(left=0)
    ax.margins(y=0.08)


def _lines(title: str) -> str:
    """A title in lines that fit above a figure."""
    return "\n".join(textwrap.wrap(plain(title, 2 * TITLE_WIDTH), TITLE_WIDTH))


@styled
def performance_profiles(results: Mapping[str, Results], title: str | None = None) -> Figure:
    """Performance profiles (Agarwal et al., 2021): the share of tasks and seeds that reach each score.

    If one line is above another everywhere, its method is better by any aggregate. If the optima are known,
    the score is the regret, which is comparable between tasks, from bad to good; otherwise it is the
    return. Bands are 95 % intervals.
    """
    figure = Figure(figsize=(4.8, 2.7), layout="constrained")
    ax = figure.add_subplot()
    # The negated regret: like a return, higher is better.
    optima = [np.asarray(result.optimal_returns) for result in results.values()]
    known = all(np.isfinite(optimum).all() for optimum in optima)
    scores = [
        result.eval_returns[:, :, -1] - (optimum if known else 0.0)
        for result, optimum in zip(results.values(), optima, strict=True)
    ]
    low, high = (pick(pick(of_run) for of_run in map(np.ravel, scores)) for pick in (min, max))
    edge = 0.02 * (high - low) or 0.02
    thresholds = np.linspace(low - edge, high, 400, endpoint=False)
    for score, look in zip(scores, method_styles(results).values(), strict=True):
        share, lower, upper = performance_profile(score, thresholds)
        ax.plot(thresholds, share, label=look.name, color=look.color, linestyle=look.line)
        if lower is not None and upper is not None:
            ax.fill_between(thresholds, lower, upper, color=look.color, alpha=0.16, linewidth=0)
    if known:
        ax.xaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
    ax.set(
        xlabel="regret of at most" if known else "return of at least",
        ylabel="share of tasks and seeds",
        title=plain(title or ""),
        ylim=(-0.02, 1.02),
    )
    figure.legend(loc="outside right upper")
    return figure


@styled
def training_curve(rows: Sequence[Mapping[str, Any]], watched: str) -> Figure:
    """Losses and returns during a training.

    The returns are of greedy or sampled episodes, whichever the world's record says.

    Args:
      rows: the rows of ``metrics.jsonl``.
      watched: what acts in the episodes of ``eval/initial_return`` (``Kind.watched``).
    """
    steps = [row["step"] for row in rows]
    figure = Figure(figsize=(6.4, 2.4), layout="constrained")
    panels = (
        ("loss (nats per action)", {"train/loss": "training", "val/loss": "validation"}),
        (
            "return",
            {
                "eval/followed_return": "prompt of a demonstration",
                "eval/initial_return": watched,
            },
        ),
    )
    colors = (METHODS["bpe"].color, METHODS["ucb"].color)
    # A training on a dataset without a world has no returns.
    drawn = [panel for panel in panels if any(name in row for name in panel[1] for row in rows)]
    axes = figure.subplots(1, max(1, len(drawn)), squeeze=False)[0]
    for ax, (ylabel, names) in zip(axes, drawn, strict=False):
        for (name, label), color in zip(names.items(), colors, strict=True):
            if any(name in row for row in rows):
                values = [row.get(name, np.nan) for row in rows]
                ax.plot(steps, values, color=color, label=label, marker="o", markersize=3)
        ax.set(xlabel="gradient steps", ylabel=ylabel)
        ax.legend()
    return figure
