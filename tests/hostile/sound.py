"""Tiny sound inputs for the fuzz suite: a policy, a result, tasks, datasets, and two training runs."""

from __future__ import annotations

import fcntl
import importlib
import json
import os
import shutil
from contextlib import chdir
from hashlib import sha256
from pathlib import Path

import numpy as np

from .grammar_npz import read
from .work import EVALUATION, replaced

NUM_TASKS = 2
PRETRAIN = (
    "--preset smoke --trajectories 40 --holdout 8 --embed-dim 8 --num-layers 1 --batch-size 8 "
    "--part-size 4 --bucket 64 --eval-tasks 2 --steps 4 --save-every 2 --eval-every 2 --out run"
)
COLLECT = "--trajectories 40"
ADAPT = (
    "--policy policy --tasks tasks.npz --seeds 1 --episodes 4 --eval-every 2 --eval-episodes 1 "
    "--no-figures --out result"
)
TRAP = "open('trap_was_here', 'w').close()\nWORLD = METHOD = 1\n"


def run(command: str, words: str) -> None:
    """Run a command in this process; it must succeed."""
    try:
        importlib.import_module(f"experiments.{command}").command(words.split())
    except SystemExit as stop:
        if stop.code:
            raise RuntimeError(f"{command} {words} ended with {stop.code}") from None


def make(folder: Path) -> Path:
    """Make the material in a folder unless it exists; of several processes, one makes it."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with open(folder.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            partial = folder.with_suffix(".partial")
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            with chdir(partial):
                _make()
            partial.rename(folder)
    return folder


def _collect_with_noise() -> None:
    """Make the dataset of the runs, as if its demonstrator recorded intended actions."""
    run("collect", COLLECT)
    (folder,) = Path("data/maze15").iterdir()
    path, manifest = folder / "trajectories.npz", folder / "manifest.json"
    arrays = read(path)
    np.savez_compressed(path, allow_pickle=False, **arrays, intended=arrays["actions"])
    document = json.loads(manifest.read_text())
    document["sha256"] = sha256(path.read_bytes()).hexdigest()
    manifest.write_text(json.dumps(document))


def _judge_by_sampling(folder: Path) -> None:
    """Change a result as if its world judged by sampled actions and named two goals."""
    from experiments.store.statistics import gain_over_tasks

    arrays = read(folder / "results.npz")
    returns = arrays["eval_returns"]
    achieved = np.full((*returns.shape, 2), 0.5, np.float32)
    np.savez_compressed(
        folder / "results.npz", allow_pickle=False, **arrays, eval_achieved=achieved
    )
    gain, *interval = gain_over_tasks(returns[:, :, -1], returns[:, :, 0])
    summary = json.loads((folder / "summary.json").read_text())
    summary["fresh"] = {"episodes": 1, "gain": gain, "gain_95": interval}
    summary["achieved"] = {"one": [0.5, 0.5], "two": [0.5, 0.5]}
    (folder / "summary.json").write_text(json.dumps(summary))


def _make() -> None:
    """Make everything in the current folder."""
    from mgpo_jax.tasks import test_tasks
    from mgpo_jax.trees import named_leaves

    os.environ.pop("MGPO_DATA", None)
    _collect_with_noise()
    with replaced(EVALUATION):
        run("pretrain", PRETRAIN)
    shutil.copytree("run/policy", "policy")
    with replaced(EVALUATION):
        run("pretrain", PRETRAIN.replace("--out run", "--out begun --init policy"))
    for name in ("policy", "checkpoints"):  # as if killed before the first checkpoint
        shutil.rmtree(f"begun/{name}")
    Path("begun/training.png").unlink()
    leaves = named_leaves(test_tasks("maze15"), "task")
    arrays = {name: np.asarray(leaf)[:NUM_TASKS] for name, leaf in leaves.items()}
    np.savez_compressed("tasks.npz", allow_pickle=False, **arrays)
    run("adapt", ADAPT)
    _judge_by_sampling(Path("result"))
    shutil.copytree("result", "old/maze15/table4/K1-1seeds")
    np.savez(
        "flat.npz",
        observations=np.arange(12.0).reshape(6, 2),
        actions=np.arange(6) % 3,
        lengths=np.array([2, 4]),
    )
    Path("file.txt").write_text("a file\n")
    Path("trap.py").write_text(TRAP)
    Path("empty").mkdir()
    Path("full").mkdir()
    Path("full/note.txt").write_text("a file in a folder\n")
    Path("dangling").symlink_to("nowhere")


ALWAYS = ("file.txt", "trap.py", "empty", "full", "dangling")
"""Files and folders that are in the current folder of every case."""


def copy(sound: Path, names: tuple[str, ...], here: Path) -> None:
    """Copy some material to a new current folder."""
    here.mkdir(parents=True)
    for name in dict.fromkeys((*names, *ALWAYS)):
        source = sound / name
        if source.is_dir():
            shutil.copytree(source, here / name, symlinks=True)
        else:
            shutil.copy(source, here / name, follow_symlinks=False)
