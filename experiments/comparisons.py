"""The paper's comparisons of methods in several worlds (Tables 1, 2 and 8; Figures 6 and 7), cell by cell.

A cell is one adaptation, which has its own folder and can be resumed on its own. Published results under
``results/`` are used if they were made with the same weights, tasks and settings; those of fewer seeds are
used until the cell is made with all of them, and a note says so. Table 3 (``experiments.robustness``) has
the same cells.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

import jax

import envs
from envs.errors import DataError, NotAvailableError, UsageError, nearest
from experiments.adaptation import adapt_and_save, finished
from experiments.drawing import pictures_together, write
from experiments.figures import later, learning_curves
from experiments.prompt_lengths import entropy_table
from experiments.runtime import say
from experiments.signals import GO_ON
from experiments.store import runs
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.paper import paper_final, paper_worlds
from experiments.store.presets import pretrain_preset
from experiments.store.reproduce_settings import ReproduceConfig
from experiments.store.result_files import load_results
from experiments.store.results import Results
from experiments.store.rows import PAPER_EPISODES, read_row
from experiments.store.seals import check_replaceable, write_sealed
from experiments.store.settings import file_name
from experiments.store.statistics import SeedSpread
from experiments.store.summary import read_summary
from experiments.store.tables import number, table
from experiments.training import train
from mgpo_jax import methods, processes
from mgpo_jax.policy_files import load_policy
from mgpo_jax.tasks import num_tasks, test_tasks

PUBLISHED = Path("results")
SMOKE_TASKS, SMOKE_EPISODES = 5, 20


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What a table of the paper compares.

    Attributes:
      title: title of the table.
      methods: the paper's methods.
      further: our additions: variants, our own optimizer, and baselines that learn nothing.
    """

    title: str
    methods: tuple[str, ...]
    further: tuple[str, ...] = ()


TABLES: Mapping[str, Comparison] = {
    "table1": Comparison(
        title="Table 1: MGPO and other methods",
        methods=("gcbc", "ppo", "spirl", "ptgm", "ucb"),
        further=(
            "ppo-careful", "spirl-prior", "ptgm-goal", "ptgm-random", "ptgm-prior", "ptgm-oracle",
        ),
    ),
    "table2": Comparison(
        title="Table 2: prompt optimization methods",
        methods=("grips", "bbt", "explore", "ucb", "bpe"),
        further=("plan",),
    ),
    "table3": Comparison(
        title="Table 3: optimized prompts under noise",
        methods=("grips", "bbt", "ucb", "bpe"),
        further=("explore",),
    ),
    "table8": Comparison(
        title="Table 8: BC-finetune with two algorithms",
        methods=("reinforce", "ppo"),
        further=("reinforce-careful", "ppo-careful"),
    ),
}  # fmt: skip
CURVES_OF = {"figure6": "table1", "figure7": "table2"}
"""Figures of learning curves, and the tables of the same adaptations."""


class Picture(NamedTuple):
    """A figure of prompts, or of episodes under them."""

    methods: tuple[str, ...]
    pattern: str
    """Glob pattern of its file names among those that ``experiments.plot`` draws."""
    numbers: Callable[[Results], str] | None = None
    """Makes a Markdown table of the numbers that the figure shows, from the results of an adaptation."""


PICTURES: Mapping[str, Picture] = {
    "figure2": Picture(TABLES["table2"].methods, "*_prompts.png"),
    "figure3": Picture(("ucb",), "*_evolution_*.png"),
    "figure5": Picture(("ucb",), "*.gif"),
    "figure9": Picture(("ucb",), "*_short_and_long.png", entropy_table),
    "figure10": Picture(("ucb",), "*_evolution_*.png"),
}


class Cell(NamedTuple):
    """One method in one world."""

    world: str
    method: str
    results: Path | None
    """Its result folder; None if it is not available."""
    reason: str = ""
    """Why it is not available."""
    failed: bool = False
    """Whether it is not available because its adaptation failed."""


class Compared(NamedTuple):
    """A table of a comparison."""

    text: str
    failed: Sequence[str]
    """The cells whose adaptations failed, each as "METHOD in WORLD"."""


@dataclass(frozen=True)
class Notes:
    """The notes below a table, without duplicates."""

    lines: list[str] = field(default_factory=list)

    def add(self, line: str) -> None:
        if line not in self.lines:
            self.lines.append(line)


def worlds_of(config: ReproduceConfig) -> Sequence[str]:
    """The worlds of a comparison: those given by ``--env``, or the paper's."""
    return config.env or paper_worlds(CURVES_OF.get(config.what, config.what))


def table_of(config: ReproduceConfig) -> Comparison:
    """The comparison that a table or figure shows."""
    return TABLES[CURVES_OF.get(config.what, config.what)]


def methods_of(config: ReproduceConfig) -> Sequence[str]:
    """The methods of a comparison: those given by ``--only``, or all.

    Raises:
      UsageError: for a method that the comparison does not have.
    """
    comparison = table_of(config)
    known = (*comparison.methods, *comparison.further)
    for name in config.only:
        if name not in known:
            raise nearest(name, known, f"method of {config.what}")
    return config.only or known


def num_seeds(config: ReproduceConfig) -> int:
    """The number of independent adaptations to each task."""
    return 1 if config.scale == "smoke" else config.seeds


def cell_config(config: ReproduceConfig, world: str, method: str) -> AdaptConfig:
    """The settings of the adaptation of one cell. A method that learns nothing needs one episode."""
    smoke, seeds = config.scale == "smoke", num_seeds(config)
    budget = SMOKE_EPISODES if smoke else PAPER_EPISODES
    learns = methods.find(method).learns
    name = f"{file_name(method)}-{config.scale}-{seeds}seeds"
    return AdaptConfig(
        env=world,
        method=method,
        policy=_trained_policy(config, world, method) if config.scale == "paper" else None,
        seeds=seeds,
        episodes=budget if learns else 1,
        eval_every=10 if learns else 1,
        out=config.out / file_name(world) / "methods" / name,
        resume=True,
        figures=False,
        hyper=methods.find(method).hyper_in(envs.find(world)),
    )


def _trained_policy(config: ReproduceConfig, world: str, method: str) -> Path:
    """The folder of the policy, trained with the preset "paper", that a method starts from."""
    kind = methods.find(method).policy
    return config.out / file_name(world) / "policies" / f"paper-{kind}" / runs.POLICY


def made(config: ReproduceConfig, world: str, method: str) -> Cell:
    """Get a cell: from earlier or published results, or by adapting now.

    If the world is not installed, its policy is not released, or the adaptation fails, as when a return is
    not a finite number, the cell is empty.
    """
    settings = cell_config(config, world, method)
    if not settings.folder.is_dir() and (place := published(config, settings)) is not None:
        return Cell(world, method, place)
    try:
        record, env = envs.find(world), envs.make(world)
        if settings.policy is not None:
            _train(settings.policy.parent, world, methods.find(method).policy)
        policy = load_policy(record, settings.policy, methods.find(method).policy)
        tasks = test_tasks(record)
        if config.scale == "smoke":
            tasks = jax.tree.map(lambda leaf: leaf[:SMOKE_TASKS], tasks)
        folder = settings.folder
        if folder.is_dir():
            finished(folder, settings, policy, tasks)
        else:
            print(f"{method} in {world}: {num_tasks(tasks)} tasks", file=sys.stderr)
            try:
                adapt_and_save(folder, settings, record, env, policy, tasks)
            except DataError as error:
                return Cell(world, method, None, f"{method} failed: {error}", failed=True)
    except UsageError as error:
        return Cell(world, method, None, str(error))
    return Cell(world, method, folder)


def _train(folder: Path, world: str, kind: str) -> None:
    """Run or continue the training of a network with the preset "paper", unless it is finished.

    Raises:
      UsageError: if it was finished or begun with other settings.
    """
    preset = replace(pretrain_preset(world, "paper", kind), out=folder)
    if runs.is_finished(folder):
        runs.check_settings(preset)
        return
    print(f"training {folder}", file=sys.stderr)
    train(replace(preset, resume=runs.has_begun(folder)), GO_ON)


def published(config: ReproduceConfig, settings: AdaptConfig) -> Path | None:
    """The folder of published results with the settings of a cell; None if there are none.

    They may be of fewer seeds, and of any number of episodes if the method learns nothing.
    """
    folder = PUBLISHED / file_name(settings.env) / file_name(settings.method)
    if config.scale != "cpu" or not folder.is_dir():
        return None
    try:
        row = read_row(folder)
    except DataError as error:
        print(f"ignoring {folder}: {error}", file=sys.stderr)
        return None
    learns = methods.find(settings.method).learns
    enough = not learns or row.summary["num_episodes"] == settings.episodes
    same = row.tasks == "test" and enough and row.summary["num_seeds"] <= settings.seeds
    return folder if same and not row.settings.keys() - {"eval_every"} else None


def cells(config: ReproduceConfig) -> Iterator[Cell]:
    """Yield all cells of a comparison, world by world; each is made when it is requested."""
    for world in worlds_of(config):
        for method in methods_of(config):
            yield made(config, world, method)


def share_out(config: ReproduceConfig) -> None:
    """Distribute the missing cells of a comparison over the processes, each of which makes its share.

    The processes need a shared folder. Cells that start from the same trained network go to the same
    process, which also measures the rows of a cell for Table 3. A single process does nothing here: it
    makes the cells when the table requests them.
    """
    if processes.count() == 1:
        return
    from experiments import robustness  # which is made of this module

    groups: dict[Any, list[tuple[str, str]]] = {}
    for world in worlds_of(config):
        for method in methods_of(config):
            trains = config.scale == "paper"
            group = (world, methods.find(method).policy if trains else method)
            groups.setdefault(group, []).append((world, method))
    own = list(groups.values())[processes.index() :: processes.count()]
    with processes.apart():
        for world, method in itertools.chain.from_iterable(own):
            if config.what == "table3":
                list(robustness.rows_of(config, world, method))  # makes the cell, and its rows
            else:
                made(config, world, method)
    processes.exchange(b"")


HEAD = (
    "world", "method", "paper", "ours (mean ± std over seeds)", "gap", "best single episode",
    "tasks x seeds x episodes", "CPU-minutes",
)  # fmt: skip


def as_table(found: Sequence[Cell], scale: str = "cpu") -> str:
    """The table in Markdown, with notes on what is missing or scaled down."""
    notes = Notes()
    rows = [_row(cell, scale, notes) for cell in found]
    below = "".join(f"- {line}\n" for line in notes.lines)
    return f"{table(HEAD, rows)}\n" + (f"\n{below}" if below else "")


def _row(cell: Cell, scale: str, notes: Notes) -> list[str]:
    paper = paper_final(cell.world, cell.method)
    title = methods.find(cell.method).title or cell.method
    if cell.results is None:
        notes.add(f"{cell.world}: {cell.reason}")
        return [cell.world, title, paper, *["-"] * (len(HEAD) - 3)]
    summary = read_summary(cell.results)
    ours = SeedSpread(summary["final_return"], summary["final_return_std_over_seeds"])
    size = (summary["num_tasks"], summary["num_seeds"], summary["num_episodes"])
    if scale == "smoke":
        notes.add(
            f"Scaled down: {size[0]} tasks, {size[1]} seed, {SMOKE_EPISODES} episodes, where the paper has "
            f"3 seeds and {PAPER_EPISODES} episodes. These numbers only show that everything runs."
        )
    elif size[1] < 3:
        notes.add(f"{cell.world}, {title}: {size[1]} seed(s), where the paper has 3.")
    if fresh := summary.get("fresh"):
        notes.add(
            f"{cell.world}, fresh: the mean of {fresh['episodes']} sampled episodes outside of the search. "
            "The best single episode is of the search, and is luck for the most part."
        )
    if not methods.find(cell.method).learns:
        notes.add(f"{title} learns nothing, so the number of its episodes does not matter.")
    return [
        cell.world,
        title,
        paper,
        f"{ours} (fresh)" if fresh else str(ours),
        gap(paper, summary["final_return"]),
        number(summary.get("best_episode_return")),
        " x ".join(map(str, size)),
        f"{summary['cpu_seconds'] / 60:.1f}",
    ]


def gap(paper: str, ours: float) -> str:
    """Our value minus the paper's, which is the first word of ``paper``; empty if the paper has none."""
    return f"{ours - float(paper.split()[0]):+.3f}" if paper else ""


def files_of(config: ReproduceConfig) -> tuple[Path, Path]:
    """The files of a comparison's table and learning curves."""
    place = config.out / f"{config.what}-{config.scale}"
    return place.with_suffix(".md"), place.with_suffix(".png")


def compare(config: ReproduceConfig) -> Compared:
    """Make all missing cells, and write the table and the learning curves."""
    place, picture = files_of(config)
    check_replaceable((place, picture))
    found = list(cells(config))
    text = f"{table_of(config).title}\n\n{as_table(found, config.scale)}"
    place.parent.mkdir(parents=True, exist_ok=True)
    write_sealed(place, lambda path: path.write_text(text, encoding="utf-8"))
    curves = _curves(found, table_of(config).methods)
    if curves:
        write(picture, later(learning_curves, curves))
    return Compared(text, [f"{cell.method} in {cell.world}" for cell in found if cell.failed])


def _curves(found: Sequence[Cell], of_paper: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The results in a figure of learning curves, by world and method.

    Those are of methods that learn, and of the paper's methods that do not, but not of our references.
    """
    curves: dict[str, dict[str, Any]] = {}
    for cell in found:
        shown = methods.find(cell.method).learns or cell.method in of_paper
        if cell.results is not None and shown:
            curves.setdefault(cell.world, {})[cell.method] = load_results(cell.results)
    return curves


def draw(config: ReproduceConfig) -> list[Path]:
    """Draw a figure in each of its worlds, after making the adaptations that are missing.

    If the figure also has a table of numbers, the table is printed, and written beside the figure.

    Returns:
      The files.

    Raises:
      UsageError: if a world or a network is missing, or a world draws no such figure.
    """
    return [path for world in worlds_of(config) for path in _draw_in(config, world)]


def _draw_in(config: ReproduceConfig, world: str) -> list[Path]:
    """Draw a figure in one world; returns its files."""
    figure, results = PICTURES[config.what], {}
    for method in figure.methods:
        cell = made(config, world, method)
        if cell.results is None:
            kind = DataError if cell.failed else UsageError
            raise kind(f"{config.what} is not available for {world}: {cell.reason}")
        results[method] = load_results(cell.results)
    place = config.out / f"{config.what}-{config.scale}_{file_name(world)}.md"
    saves = {
        config.out / f"{config.what}-{config.scale}_{name}": save
        for name, save in pictures_together(results, (), seed=0)
        if fnmatch(name, figure.pattern)
    }
    if not saves and figure.numbers is None:
        raise NotAvailableError(
            f"{config.what} is not available for {world}, which does not draw such a figure"
        )
    check_replaceable((place, *saves) if figure.numbers else saves)
    config.out.mkdir(parents=True, exist_ok=True)
    for path, save in saves.items():
        write(path, save)
    if figure.numbers is None:
        return list(saves)
    text = figure.numbers(results[figure.methods[0]])
    say(text)
    write_sealed(place, lambda path: path.write_text(text, encoding="utf-8"))
    return [*saves, place]
