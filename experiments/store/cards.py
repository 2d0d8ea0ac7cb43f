"""Released policies with their model cards."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

import envs
from envs.base import Environment
from envs.errors import DataError, UsageError, printable, shown
from envs.registry import WORLDS, World
from experiments.demonstrators import find_demonstrator
from experiments.figures import training_curve
from experiments.store.initial import INIT
from experiments.store.layout import TASKS
from experiments.store.metrics import METRICS, RESUME, cpu_seconds_of_training, read_metrics
from experiments.store.provenance import read_meta
from experiments.store.runs import META, PICTURE, POLICY
from experiments.store.settings import NO_WORLD, PretrainConfig, pretraining_from
from mgpo_jax.dataset import variant_counts
from mgpo_jax.files import new_folder, write_text
from mgpo_jax.kinds import MULTI_GOAL, Kind, kind_of
from mgpo_jax.losses import HIT
from mgpo_jax.policy import LoadedPolicy, check_fits
from mgpo_jax.policy_files import CONFIG, GOALS, WEIGHTS, read_policy
from mgpo_jax.released import released_folder
from mgpo_jax.tasks import benchmark_tasks, save_tasks

FOLLOWED = "eval/followed_return"
CARD = """# {title} for {env}

| | |
| --- | --- |
{facts}
| data | {data}{variants} |{begun}
| training | {steps:,} steps of {batch_size} trajectories, {optimizer}, {cpu_minutes:.0f} CPU-minutes |
| validation loss | {val_loss:.4f} nats per action; {correct}: {val_accuracy:.4f} |
| {acting} return of {watched} | {initial:.3f} on {eval_tasks} validation tasks |{followed}

Made by

    {command}

![loss and {acting} returns while training](training.png)

Files: `weights.npz`, `config.json` (network, SHA-256 of the weights, all settings), {files}`metrics.jsonl`.
Results {where} are in `results/` and the README.
"""


METRICS_SHOWN = (
    "train/loss", "val/loss", "val/accuracy", "eval/initial_return", "cpu_seconds_per_step"
)  # fmt: skip


class Finished(NamedTuple):
    """A pre-training run that can be released."""

    source: Path
    world: World
    policy: LoadedPolicy
    settings: PretrainConfig
    rows: list[dict[str, Any]]
    """Its metrics."""
    command: str
    variants: dict[str, int]
    """Number of trajectories of each variant of the world in its dataset; empty if unknown."""

    @property
    def released(self) -> Path:
        """The folder of the world's released policy."""
        return released_folder(self.world, self.kind.name)

    @property
    def kind(self) -> Kind:
        """The kind of its network."""
        return kind_of(self.policy.config)


def read_run(source: Path, env: str | None = None) -> Finished:
    """Read a finished run.

    Args:
      source: its folder.
      env: its world, by name or as module:attribute, if the user gave one.

    Raises:
      DataError: if a file is missing or damaged, or the policy does not fit the world that it names.
      UsageError: if the run has no policy, or is from another world than ``env``.
    """
    policy, path = read_policy(source / POLICY), source / POLICY / CONFIG
    given = envs.find(env) if env is not None else None  # imports it, so that files may name it
    name, settings = policy.made.get("env"), policy.made.get("config")
    if name is None or not isinstance(settings, dict):
        raise DataError(f"{path} lacks made.env or made.config; {RESUME}")
    if name == NO_WORLD:
        raise UsageError(
            f"{source} was trained on data of no world, for which nothing is released; copy the folder "
            f"{source / 'policy'}, which is complete, and load it with mgpo_jax.load_policy(path=...)"
        )
    world = WORLDS.known(name, path, "--env")
    if given is not None and given is not world:
        raise UsageError(f"--env {env}, but the policy in {source} was made for {name}")
    check_fits(policy.config, world.make().spec, f"the policy in {source}")
    config = pretraining_from(settings, path)
    if config.init is not None and "init_sha256" not in policy.made:
        raise DataError(f"{path} has made.config.init, but lacks made.init_sha256; {RESUME}")
    if config.env != name:
        raise DataError(
            f"{path}: made.env is {shown(name)}, made.config.env is {shown(config.env)}; {RESUME}"
        )
    rows = read_metrics(source / METRICS, METRICS_SHOWN)
    meta = read_meta(source / META, RESUME)
    variants = variant_counts(Path(meta.dataset), meta.dataset_sha256) if meta.dataset else {}
    command = " ".join(_without_out(meta.command)) or "(not known)"
    return Finished(source, world, policy, config, rows, command, variants)


def _without_out(command: Sequence[str]) -> list[str]:
    """A command without ``--out FOLDER``, which says nothing about the policy."""
    shown, words = [], iter(command)
    for word in words:
        if word == "--out":
            next(words, None)
        elif not word.startswith("--out="):
            shown.append(word)
    return shown


def card(run: Finished) -> str:
    """The model card of a released policy, in Markdown."""
    settings, last, env = run.settings, run.rows[-1], run.world.make()
    num_weights = sum(leaf.size for leaf in jax.tree.leaves(run.policy.params))
    facts = run.kind.load().facts(run.policy.config)
    facts = {**facts, "network": f"{facts['network']}, {num_weights:,} weights"}
    acting = "greedy" if run.world.judged.mode == "greedy" else "sampled"
    followed = (
        f"\n| {acting} return of a demonstration's prompt | {last[FOLLOWED]:.3f} on the same tasks |"
        if FOLLOWED in last
        else ""
    )
    tested = run.kind.name == MULTI_GOAL
    tasks = "`tasks.npz` (the\ntest tasks, which no dataset contains), " if tested else ""
    goals = "`goals.npz`\n(a sample of the training goals), " if run.policy.seen_goals else ""
    return CARD.format(
        title=run.kind.title,
        env=settings.env,
        facts="\n".join(f"| {name} | {text} |" for name, text in facts.items()),
        watched=run.kind.watched,
        files=goals + tasks,
        where="on them" if tested else "of the methods that use it",
        data=_data(run, env),
        variants=_variants(run),
        begun=_begun(run),
        steps=last["step"],
        batch_size=settings.train.batch_size,
        optimizer=settings.train.optimizer,
        cpu_minutes=(cpu_seconds_of_training(run.rows) or 0) / 60,
        val_loss=last["val/loss"],
        val_accuracy=last["val/accuracy"],
        acting=acting,
        initial=last["eval/initial_return"],
        followed=followed,
        correct="accuracy"
        if env.spec.discrete
        else f"share of actions within {HIT} in every dimension",
        eval_tasks=settings.eval_tasks,
        command=printable(run.command),
    )


def _data(run: Finished, env: Environment) -> str:
    """The text of a card on the dataset: demonstrations, or trajectories from elsewhere."""
    data = run.settings.data
    if data.data_folder is not None:
        return (
            f"{data.trajectories:,} trajectories of the dataset {printable(data.data_folder.name)}"
        )
    name, _ = find_demonstrator(run.world, env, data.demonstrator)
    return f"{data.trajectories:,} demonstrations of {name}, seed {data.data_seed}"


def _variants(run: Finished) -> str:
    """The text of a card on the variants of the world in the dataset; empty without any."""
    counts = [f"{count:,} in {printable(name)}" for name, count in run.variants.items()]
    return f" ({', '.join(counts)})" if counts else ""


def _begun(run: Finished) -> str:
    """The rows of a card on the policy that a training started from; empty for random weights.

    The second row says how that policy was trained, according to its copy in the run.
    """
    if run.settings.init is None:
        return ""
    row = f"\n| initialized from | {_origin(run.settings.init, run.policy.made)} |"
    folder = run.source / INIT
    if not (folder / CONFIG).is_file():
        return row
    made = read_policy(folder).made
    if not isinstance(made.get("config"), dict):
        return row
    before = pretraining_from(made["config"], folder / CONFIG)
    text = (
        f"{before.train.steps:,} steps of {before.train.batch_size} trajectories, "
        f"{before.data.trajectories:,} demonstrations, seed {before.data.data_seed}"
    )
    if before.init is not None:
        text += f"; initialized from {_origin(before.init, made)}"
    return f"{row}\n| that policy was trained for | {text} |"


def _origin(place: Path, made: Mapping[str, Any]) -> str:
    """The policy that a training started from, in words."""
    sha256 = printable(str(made.get("init_sha256", "(not known)")))
    return f"the weights of the policy {printable(str(place))}, SHA-256 {sha256}"


def release(run: Finished, folder: Path) -> None:
    """Write the released files of a run to a new folder, which appears only when it is complete."""
    with new_folder(folder) as place:
        for name in (WEIGHTS, CONFIG, GOALS):
            if (run.source / POLICY / name).is_file():  # older runs have no goals
                shutil.copy(run.source / POLICY / name, place / name)
        shutil.copy(run.source / METRICS, place)
        training_curve(run.rows, run.kind.watched).savefig(place / PICTURE)
        if run.kind.name == MULTI_GOAL:
            tasks = benchmark_tasks(run.world.make(), run.world.num_test_tasks)
            save_tasks(place / TASKS, tasks)
        write_text(place / "README.md", card(run))
