"""Released policies with their model cards."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

import envs
from experiments.datasets import find_demonstrator
from experiments.figures import training_curve
from experiments.store.metrics import METRICS, read_metrics
from experiments.store.settings import saved_pretraining
from mgpo_jax.files import read_object
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.policy_files import CONFIG, WEIGHTS, read_policy, released_folder
from mgpo_jax.tasks import benchmark_tasks, save_tasks
from mgpo_jax.training import HIT

FOLLOWED = "eval/followed_return"
CARD = """# Multi-goal Transformer for {env}

| | |
| --- | --- |
| network | {num_layers} layers, width {embed_dim}, {num_heads} head(s), {num_weights:,} weights |
| prompts | up to {max_prompt_length} goals, {order} |
| data | {trajectories:,} demonstrations of {demonstrator}, seed {data_seed} |
| training | {steps:,} steps of {batch_size} trajectories, {optimizer}, {cpu_minutes:.0f} CPU-minutes |
| validation loss | {val_loss:.4f} nats an action, {correct} {val_accuracy:.4f} |
| greedy return of the prompt (g^M) | {initial:.3f} on {eval_tasks} tasks of the training's own |
| greedy return of a demonstration's prompt | {followed} |

Made by

    {command}

![loss and greedy returns while training](training.png)

Files: `weights.npz`, `config.json` (network, SHA-256 of the weights, all settings), `tasks.npz` (the
test tasks, in no dataset), `metrics.jsonl`. Results on them are in `results/` and the README.
"""


def world_of(policy: Path) -> Path:
    """Where the policy of a run is released: the folder of its world."""
    return released_folder(envs.find(read_policy(policy).made["env"]))


def cpu_minutes(rows: Sequence[dict[str, Any]]) -> float:
    """CPU time of a training, from its metrics."""
    starts = [0, *(row["step"] for row in rows)]
    spans = [row["step"] - start for start, row in zip(starts, rows, strict=False)]
    seconds = (row["cpu_seconds_per_step"] * n for row, n in zip(rows, spans, strict=True))
    return sum(seconds) / 60


def card(source: Path, policy: LoadedPolicy, rows: Sequence[dict[str, Any]]) -> str:
    """The text that describes a released policy."""
    network, made, last = policy.config, policy.made, rows[-1]
    settings = saved_pretraining(made["config"], source)
    world, env = envs.find(made["env"]), envs.make(made["env"])
    order = "with" if network.prompt_order else "without"
    return CARD.format(
        env=made["env"],
        num_layers=network.num_layers,
        embed_dim=network.embed_dim,
        num_heads=network.num_heads,
        num_weights=sum(leaf.size for leaf in jax.tree.leaves(policy.params)),
        max_prompt_length=network.max_prompt_length,
        order=f"{order} an order embedding",
        trajectories=settings["data"]["trajectories"],
        demonstrator=find_demonstrator(world, env, settings["data"]["demonstrator"])[0],
        data_seed=settings["data"]["data_seed"],
        steps=made["steps"],
        batch_size=settings["train"]["batch_size"],
        optimizer=settings["train"]["optimizer"],
        cpu_minutes=cpu_minutes(rows),
        val_loss=last["val/loss"],
        val_accuracy=last["val/accuracy"],
        initial=last["eval/initial_return"],
        followed=f"{last[FOLLOWED]:.3f} on the same tasks" if FOLLOWED in last else "-",
        correct="accuracy" if env.spec.discrete else f"share within {HIT} in all dimensions",
        eval_tasks=settings["eval_tasks"],
        command=" ".join(read_object(source / "meta.json")["command"]),
    )


def release(source: Path, folder: Path) -> None:
    """Write the released form of a finished pre-training run to a new folder."""
    policy = read_policy(source / "policy")
    rows = read_metrics(source / METRICS)
    text = card(source, policy, rows)
    world, env = envs.find(policy.made["env"]), envs.make(policy.made["env"])
    folder.mkdir(parents=True)
    for name in (WEIGHTS, CONFIG):
        shutil.copy(source / "policy" / name, folder / name)
    shutil.copy(source / METRICS, folder)
    training_curve(rows).savefig(folder / "training.png")
    save_tasks(folder / "tasks.npz", benchmark_tasks(env, world.num_test_tasks))
    (folder / "README.md").write_text(text)
