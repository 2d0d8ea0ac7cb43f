"""The paper's comparisons of methods in several worlds, cell by cell.

A cell is one adaptation, which has its own folder and can be resumed on its own. Published results under
``results/`` are used if they were made with the same weights, tasks and settings; those of fewer seeds are
used until the cell is made with all of them. Tables and figures of the cells are in
``experiments.comparison_tables``, ``experiments.robustness`` (Table 3) and ``experiments.paper_figures``.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax

import envs
from envs.errors import DataError, UsageError, nearest
from experiments.adaptation import adapt_and_save, finished
from experiments.signals import GO_ON
from experiments.store import runs
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.paper import paper_worlds
from experiments.store.presets import pretrain_preset
from experiments.store.reproduce_settings import ReproduceConfig
from experiments.store.rows import PAPER_EPISODES, changed_hyper, read_row
from experiments.store.settings import file_name
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
            "ppo-careful", "spirl-prior", "ptgm-goal", "ptgm-ppo", "ptgm-random", "ptgm-prior",
            "ptgm-oracle",
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


def published(
    config: ReproduceConfig, settings: AdaptConfig, place: Path | None = None
) -> Path | None:
    """The folder of published results with the settings of a cell; None if there are none.

    They may be of fewer seeds, and of any number of episodes if the method learns nothing.

    Args:
      config: settings of the command.
      settings: settings of the cell.
      place: where the results would be (default: among those of the world, under the method's name).
    """
    folder = place or PUBLISHED / file_name(settings.env) / file_name(settings.method)
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
    differing = {name: text for name, text in row.settings.items() if name != "eval_every"}
    world = envs.find(settings.env)
    return folder if same and differing == changed_hyper(settings, world) else None


def cells(config: ReproduceConfig) -> Iterator[Cell]:
    """Yield all cells of a comparison, world by world; each is made when it is requested."""
    for world in worlds_of(config):
        for method in methods_of(config):
            yield made(config, world, method)


def share_out(config: ReproduceConfig, make: Callable[[ReproduceConfig, str, str], object]) -> None:
    """Distribute the missing cells of a comparison over the processes, each of which makes its share.

    The processes need a shared folder. Cells that start from the same trained network go to the same
    process. A single process does nothing here: it makes the cells when the table requests them.

    Args:
      config: settings of the command.
      make: called with a world and a method; makes their cell and whatever else a table needs of it.
    """
    if processes.count() == 1:
        return
    groups: dict[Any, list[tuple[str, str]]] = {}
    for world in worlds_of(config):
        for method in methods_of(config):
            trains = config.scale == "paper"
            group = (world, methods.find(method).policy if trains else method)
            groups.setdefault(group, []).append((world, method))
    own = list(groups.values())[processes.index() :: processes.count()]
    with processes.apart():
        for world, method in itertools.chain.from_iterable(own):
            make(config, world, method)
    processes.exchange(b"")
