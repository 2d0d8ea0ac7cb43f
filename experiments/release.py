"""Release a trained policy: ``python -m experiments.release runs/pretrain/maze15/fast-seed0``.

Puts weights, config, the world's test tasks and a model card into ``pretrained/ENV``, where every
other command finds them by default.
"""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import jax
import tyro

from experiments.collect import find_demonstrator
from experiments.configs import PRETRAINED, make_env
from experiments.figures import training_curve
from experiments.runtime import Common, refuse_existing, run
from experiments.tasks import benchmark_tasks, save_tasks
from mgpo_jax.checkpoint import CONFIG, WEIGHTS, load_policy_files
from mgpo_jax.errors import UsageError
from mgpo_jax.pretrain import HIT


@dataclass(frozen=True, kw_only=True)
class ReleaseConfig(Common):
    """Settings of ``experiments.release``."""

    source: tyro.conf.Positional[Path]
    """Folder of a finished pre-training run."""
    out: Path | None = None
    """Folder to write (default: pretrained/ENV)."""


FOLLOWED = "eval/followed_return"
CARD = """# Multi-goal Transformer for {env}

| | |
| --- | --- |
| network | {num_layers} layers, width {embed_dim}, {num_heads} head(s), {num_weights:,} weights |
| prompts | up to {max_prompt_length} goals, {order} |
| data | {episodes:,} demonstrations of {demonstrator}, seed {data_seed} |
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


def main(config: ReleaseConfig) -> None:
    """Package a finished pre-training run as a released policy."""
    policy = config.source / "policy"
    if not policy.is_dir():
        raise UsageError(f"{config.source} has no finished policy; let its training end first")
    network, params, made = load_policy_files(policy)
    env = make_env(made["env"])
    folder = config.out or PRETRAINED / env.spec.name
    refuse_existing(folder, "remove it", "choose another with --out")
    rows = [json.loads(row) for row in (config.source / "metrics.jsonl").read_text().splitlines()]
    settings, last = made["config"], rows[-1]
    steps_between = [
        b["step"] - a for a, b in zip([0, *(r["step"] for r in rows)], rows, strict=False)
    ]
    cpu = sum(r["cpu_seconds_per_step"] * n for r, n in zip(rows, steps_between, strict=True))
    meta = json.loads((config.source / "meta.json").read_text())

    text = CARD.format(
        env=made["env"],
        num_layers=network.num_layers,
        embed_dim=network.embed_dim,
        num_heads=network.num_heads,
        num_weights=sum(leaf.size for leaf in jax.tree.leaves(params)),
        max_prompt_length=network.max_prompt_length,
        order="with an order embedding" if network.prompt_order else "without an order embedding",
        episodes=settings["data"]["episodes"],
        demonstrator=find_demonstrator(env, settings["data"]["demonstrator"])[0],
        data_seed=settings["data"]["data_seed"],
        steps=made["steps"],
        batch_size=settings["train"]["batch_size"],
        optimizer=settings["train"]["optimizer"],
        cpu_minutes=cpu / 60,
        val_loss=last["val/loss"],
        val_accuracy=last["val/accuracy"],
        initial=last["eval/initial_return"],
        followed=f"{last[FOLLOWED]:.3f} on the same tasks" if FOLLOWED in last else "-",
        correct="accuracy" if env.spec.discrete else f"share within {HIT} in all dimensions",
        eval_tasks=settings["eval_tasks"],
        command=" ".join(meta["command"]),
    )
    folder.mkdir(parents=True)
    for name in (WEIGHTS, CONFIG):
        shutil.copy(policy / name, folder / name)
    shutil.copy(config.source / "metrics.jsonl", folder)
    training_curve(folder / "metrics.jsonl").savefig(folder / "training.png")
    save_tasks(folder / "tasks.npz", benchmark_tasks(env))
    (folder / "README.md").write_text(text)
    print(f"released in {folder}", file=sys.stderr)


if __name__ == "__main__":
    run(ReleaseConfig, main)
