"""Sound material for the fuzz suite, all tiny: policy, result, tasks, dataset, a done and a begun run."""

from __future__ import annotations

import fcntl
import importlib
import os
import shutil
from contextlib import chdir
from pathlib import Path

import numpy as np

from .work import EVALUATION, replaced

NUM_TASKS = 2
PRETRAIN = (
    "--preset smoke --trajectories 40 --holdout 8 --embed-dim 8 --num-layers 1 --batch-size 8 "
    "--part-size 4 --bucket 64 --eval-tasks 2 --steps 4 --save-every 2 --eval-every 2 --out run"
)
ADAPT = (
    "--policy policy --tasks tasks.npz --seeds 1 --episodes 4 --eval-every 2 --eval-episodes 1 "
    "--no-figures --out result"
)
TRAP = "open('trap_was_here', 'w').close()\nWORLD = METHOD = 1\n"


def run(command: str, words: str) -> None:
    """One command in this process, which has to succeed."""
    try:
        importlib.import_module(f"experiments.{command}").command(words.split())
    except SystemExit as stop:
        if stop.code:
            raise RuntimeError(f"{command} {words} ended with {stop.code}") from None


def make(folder: Path) -> Path:
    """The material in a folder; made if it is not there, by one process if several ask."""
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


def _make() -> None:
    """Everything, in the current folder."""
    from mgpo_jax.tasks import test_tasks
    from mgpo_jax.trees import named_leaves

    os.environ.pop("MGPO_DATA", None)
    with replaced(EVALUATION):
        run("pretrain", PRETRAIN)
    shutil.copytree("run/policy", "policy")
    with replaced(EVALUATION):
        run("pretrain", PRETRAIN.replace("--out run", "--out begun --init policy"))
    for name in ("policy", "checkpoints"):  # as if it had been killed before its first checkpoint
        shutil.rmtree(f"begun/{name}")
    Path("begun/training.png").unlink()
    leaves = named_leaves(test_tasks("maze15"), "task")
    arrays = {name: np.asarray(leaf)[:NUM_TASKS] for name, leaf in leaves.items()}
    np.savez_compressed("tasks.npz", allow_pickle=False, **arrays)
    run("adapt", ADAPT)
    shutil.copytree("result", "old/maze15/table4/K1-1seeds")
    Path("file.txt").write_text("a file\n")
    Path("trap.py").write_text(TRAP)
    Path("empty").mkdir()
    Path("full").mkdir()
    Path("full/note.txt").write_text("a file in a folder\n")
    Path("dangling").symlink_to("nowhere")


ALWAYS = ("file.txt", "trap.py", "empty", "full", "dangling")
"""What lies in the current folder of every case."""


def copy(sound: Path, names: tuple[str, ...], here: Path) -> None:
    """Copies of some material as a new current folder."""
    here.mkdir(parents=True)
    for name in dict.fromkeys((*names, *ALWAYS)):
        source = sound / name
        if source.is_dir():
            shutil.copytree(source, here / name, symlinks=True)
        else:
            shutil.copy(source, here / name, follow_symlinks=False)
