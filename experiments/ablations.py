"""The paper's ablations and ours: the trainings and adaptations they need, and their tables."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import envs
from envs.errors import NotAvailableError, nearest
from experiments.adaptation import adapt_all, deciding, finished, save_outcome
from experiments.comparison_tables import gap
from experiments.comparisons import PUBLISHED, published
from experiments.drawing import write
from experiments.figures import later, learning_curve
from experiments.signals import GO_ON, farewell, kept
from experiments.store import runs
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.paper import paper_value
from experiments.store.presets import pretrain_preset
from experiments.store.provenance import provenance
from experiments.store.reproduce_settings import TRAIN_NOTHING, ReproduceConfig
from experiments.store.result_files import load_results
from experiments.store.rows import PAPER_EPISODES
from experiments.store.seals import write_sealed
from experiments.store.settings import DataConfig, PretrainConfig, file_name
from experiments.store.statistics import SeedSpread
from experiments.store.summary import read_summary
from experiments.store.tables import number, table
from experiments.store.work import open_journal
from experiments.training import train
from mgpo_jax import methods
from mgpo_jax.claims import claimed
from mgpo_jax.distributions import HEADS
from mgpo_jax.methods import UCB, UcbHyper
from mgpo_jax.policy_files import load_policy
from mgpo_jax.tasks import test_tasks

EPISODES = PAPER_EPISODES  # episodes of an adaptation
UNFINISHED = "unfinished-"  # prefix of folders with the finished pieces of an unfinished adaptation
LONGEST = 5  # maximum number of goals in a prompt where the paper varies c


class Line(NamedTuple):
    """A row of a table: its results, and the paper's value."""

    label: str
    results: Path
    paper: str


class Part(NamedTuple):
    """The plan of one row of an ablation."""

    label: str
    """Label of the row in our table."""
    name: str
    """Name of the row in the paper's table."""
    training: PretrainConfig | None
    """Training of its policy; None for the released policy."""
    hyper: Any
    """Hyper-parameters of its method."""
    results: Path
    """Result folder of its adaptation."""
    together: str
    """Successive parts with the same value are adapted in one program."""
    method: str = "ucb"
    """Name of its adaptation method."""


def planned(
    config: ReproduceConfig, label: str, demonstrator: str | None = None, **changes: Any
) -> PretrainConfig:
    """The settings of one training, including its run folder.

    Args:
      config: settings of the command.
      label: first part of the folder's name.
      demonstrator: demonstrator of the dataset (default: that of the world's preset).
      **changes: other changes to the world's ``PretrainConfig``.
    """
    fast = pretrain_preset(config.world, "fast")
    settings = replace(
        fast,
        data=DataConfig(demonstrator or fast.data.demonstrator, config.num_trajectories),
        train=replace(fast.train, steps=config.num_steps),
        **changes,
    )
    size = f"{config.num_steps}steps-{config.num_trajectories}episodes"
    name = f"{label}-k{settings.max_prompt_length}-{size}"
    return replace(settings, out=config.folder / "policies" / name)


def trained(settings: PretrainConfig) -> Path:
    """Run or continue a training unless it is finished; returns the folder of its policy.

    Raises:
      UsageError: if it was finished or begun with other settings.
    """
    folder = settings.folder
    if runs.is_finished(folder):
        runs.check_settings(settings)
    else:
        print(f"training {folder}", file=sys.stderr)
        train(replace(settings, resume=runs.has_begun(folder)), GO_ON)
    return folder / runs.POLICY


def adapted(
    config: ReproduceConfig,
    policy_folder: Path | None,
    folders: Mapping[Path, Any],
    method: str = "ucb",
) -> None:
    """Adapt with each variant of a method's hyper-parameters in one program; finished results are kept.

    Args:
      config: settings of the command.
      policy_folder: folder of the policy; None for the released one.
      folders: result folders to write, with the hyper-parameters of each.
      method: name of the adaptation method.

    Raises:
      UsageError: if finished results are of other settings or tasks.
      DataError: if they are of other weights.
    """
    world, env = envs.find(config.world), envs.make(config.world)
    policy = load_policy(world, policy_folder)
    tasks = test_tasks(world)
    configs = [
        AdaptConfig(
            env=config.world,
            method=method,
            policy=policy_folder,
            seeds=config.seeds,
            episodes=EPISODES,
            out=folder,
            hyper=hyper,
        )
        for folder, hyper in folders.items()
    ]
    for settings in configs:
        if settings.folder.exists():
            finished(settings.folder, settings, policy, tasks)
    # All variants count, finished or not, so that an interruption between two of them changes nothing.
    variants = {"variants": [deciding(settings, policy, tasks) for settings in configs]}
    mark = hashlib.sha256(json.dumps(variants).encode()).hexdigest()[:12]
    pieces = configs[0].folder.parent / f"{UNFINISHED}{mark}"
    complete = all(map(Path.exists, folders))
    if complete and not pieces.exists():
        return
    with claimed(pieces), farewell(kept):
        if not complete:
            print(f"adapting with {policy_folder or 'the released policy'}", file=sys.stderr)
            journal, meta = open_journal(pieces, variants, provenance())
            outcomes = adapt_all(world, env, policy, tasks, configs, journal)
            for settings, outcome in zip(configs, outcomes, strict=True):
                if not settings.folder.exists():
                    made = {**meta, "settings": deciding(settings, policy, tasks)}
                    save_outcome(settings.folder, settings, env, policy, tasks, outcome, made)
        shutil.rmtree(pieces)


def _place(config: ReproduceConfig, name: str, hyper: Any, method: str = "ucb") -> Path:
    """The folder of a row's results: that of this command if it exists, or published ones of as many seeds.

    Args:
      config: settings of the command.
      name: name of the row in a file name.
      hyper: hyper-parameters of its method; None for the defaults.
      method: name of its adaptation method.
    """
    own = config.folder / config.what / f"{name}-{config.seeds}seeds"
    settings = AdaptConfig(
        env=config.world, method=method, seeds=config.seeds, episodes=EPISODES, hyper=hyper
    )
    among = PUBLISHED / "ablations" / file_name(config.world) / config.what / name
    for place in () if own.exists() else (among, None):
        found = published(config, settings, place)
        if found is not None and read_summary(found)["num_seeds"] == config.seeds:
            return found
    return own


def table4(config: ReproduceConfig) -> list[Part]:
    """The maximum prompt length K and the exploration constant c, with the released policy (Table 4).

    The last K is that of the policy's recipe, the default of UCB, so published results of UCB have it.
    """
    world = envs.find(config.world)
    own = pretrain_preset(config.world, "fast").max_prompt_length

    def part(label: str, name: str, hyper: UcbHyper, together: str) -> Part:
        usual = None if name == f"K{own}" else hyper
        return Part(label, label, None, hyper, _place(config, name, usual), together)

    lengths = [
        part(f"K = {k}", f"K{k}", UCB.hyper_in(world, {"max_goals": k}), "K")
        for k in sorted({1, 2, 3, LONGEST, own})
    ]
    constants = [  # Eq. 3 as printed
        part(f"c = {c}", f"c{c}", UcbHyper(c=float(c), max_goals=LONGEST, scale=1.0), "c")
        for c in (0, 1, 10)
    ]
    return lengths + constants


def chosen(config: ReproduceConfig, names: Sequence[str]) -> Sequence[str]:
    """The ``names`` that ``--only`` selects; all of them if it is not given."""
    for name in config.only:
        if name not in names:
            raise nearest(name, names, f"row of {config.what}")
    return config.only or names


def compared(
    config: ReproduceConfig,
    names: Sequence[str],
    training_of: Callable[[str], PretrainConfig],
    label: str = "{}",
) -> list[Part]:
    """The parts of an ablation that trains a policy for each name that ``--only`` selects."""
    hyper, parts = UCB.hyper_in(envs.find(config.world)), []
    for name in chosen(config, names):
        training = training_of(name)
        results = config.folder / config.what / f"{training.folder.name}-{config.seeds}seeds"
        parts.append(Part(label.format(name), name, training, hyper, results, name))
    return parts


def demonstrators(config: ReproduceConfig) -> list[str]:
    """The names of the world's demonstrators, the default first."""
    return list(envs.find(config.world).demonstrators(envs.make(config.world)))


def table5(config: ReproduceConfig) -> list[Part]:
    """A policy for each demonstrator's dataset (Table 5).

    Raises:
      NotAvailableError: for a world with fewer than two demonstrators.
    """
    names = demonstrators(config)
    if len(names) < 2:
        raise NotAvailableError(
            f"table5 is not available for {config.world}, which has a single demonstrator: it compares "
            "datasets of several; name another world with --env"
        )
    return compared(config, sorted(names), lambda name: planned(config, name, name))


def figure8(config: ReproduceConfig) -> list[Part]:
    """A policy for each maximum prompt length K (Figure 8)."""
    first = demonstrators(config)[0]
    return compared(
        config,
        ("5", "10", "20", "40"),
        lambda length: planned(config, first, first, max_prompt_length=int(length)),
        "K = {}",
    )


def heads(config: ReproduceConfig) -> list[Part]:
    """A policy for each distribution of continuous actions; the authors' code uses the fixed Gaussian.

    Raises:
      NotAvailableError: for a world with discrete actions.
    """
    if envs.make(config.world).spec.discrete:
        raise NotAvailableError(
            f"heads is not available for {config.world}, whose actions are discrete: it compares "
            "distributions of continuous actions; name another world with --env"
        )
    names = [name for name in HEADS if name != "categorical"]
    return compared(config, names, lambda head: planned(config, head, head=head))


def plan(config: ReproduceConfig) -> list[Part]:
    """Our optimizer ``plan`` without one of its parts each, and UCB (not in the paper).

    Raises:
      NotAvailableError: for a world in which these parts are not used: one with continuous actions, or
        whose goals are not states.
    """
    spec = envs.make(config.world).spec
    if not (spec.goals_are_states and spec.discrete):
        raise NotAvailableError(
            f"plan is not available for {config.world}: it leaves out parts of the plan in worlds of "
            "discrete actions whose goals are states; name another world with --env"
        )
    world = envs.find(config.world)
    variants: dict[str, dict[str, Any]] = {
        "plan": {},
        "without steering": {"steer": 0},
        "without rehearsal": {"rehearse": 0},
        "without splicing": {"splice": False},
        "without frontiers": {"frontier": False},
    }
    parts = []
    for label in chosen(config, [*variants, "ucb"]):
        method = "ucb" if label == "ucb" else "plan"
        hyper = methods.find(method).hyper_in(world, variants.get(label))
        name = label.replace(" ", "-")
        results = _place(config, name, hyper, method)
        parts.append(Part(label, name, None, hyper, results, label, method))
    return parts


PLANS: dict[str, Callable[[ReproduceConfig], list[Part]]] = {
    "table4": table4,
    "table5": table5,
    "figure8": figure8,
    "heads": heads,
    "plan": plan,
}


def make(config: ReproduceConfig) -> list[Line]:
    """Run the missing trainings and adaptations of an ablation; returns the rows of its table.

    Raises:
      UsageError: for an unknown row, or a world in which the ablation is not available.
    """
    lines = []
    for _, group in groupby(PLANS[config.what](config), key=lambda part: part.together):
        parts = list(group)
        training = parts[0].training
        policy = None if training is None else trained(training)
        folders = {
            part.results: part.hyper for part in parts if PUBLISHED not in part.results.parents
        }
        if folders:
            adapted(config, policy, folders, parts[0].method)
        home = envs.find(config.world).home
        lines += [
            Line(part.label, part.results, paper_value(config.what, home, part.name))
            for part in parts
        ]
    return lines


def files_of(config: ReproduceConfig) -> tuple[Path, Path]:
    """The files of an ablation's table and learning curves."""
    place = config.folder / config.what
    return place.with_name(f"{config.what}.md"), place.with_name(f"{config.what}.png")


def as_text(config: ReproduceConfig, lines: Sequence[Line]) -> str:
    """The table in Markdown, below a line that says of what it is and what its trainings cost."""
    budget = ""
    if config.what not in TRAIN_NOTHING:
        steps, trajectories = config.num_steps, config.num_trajectories
        budget = f", {steps:,} gradient steps on {trajectories:,} trajectories each"
    who = "" if config.what == "plan" else ", UCB"
    return f"{config.world}{who}, {config.seeds} seeds{budget}\n\n{as_table(lines)}\n"


def as_table(lines: Sequence[Line]) -> str:
    """The table in Markdown, with a row for each line."""
    head = [
        "",
        "initial",
        "final (mean ± std over seeds)",
        "regret",
        "after 40",
        "paper: final",
        "gap",
    ]
    rows = []
    for line in lines:
        summary = read_summary(line.results)
        final = SeedSpread(summary["final_return"], summary["final_return_std_over_seeds"])
        rows.append(
            [
                line.label,
                f"{summary['initial_return']:.2f}",
                str(final),
                number(summary["regret"]),
                number(summary["regret_after_40"]),
                line.paper,
                gap(line.paper, summary["final_return"]),
            ]
        )
    return table(head, rows)


def save(config: ReproduceConfig, text: str, lines: Sequence[Line]) -> None:
    """Write the table and the learning curves of an ablation."""
    place, picture = files_of(config)
    place.parent.mkdir(parents=True, exist_ok=True)
    results = {line.label: load_results(line.results) for line in lines}
    write(picture, later(learning_curve, results, config.world))
    write_sealed(place, lambda path: path.write_text(text, encoding="utf-8"))
