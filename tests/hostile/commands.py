"""Three long commands in a small world, and checks that interruptions do not change their results."""

from __future__ import annotations

import hashlib
import json
import shutil
import signal
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .processes import Server, Trap

WORLD = "--env own_world:WORLD"
VARIES = ("cpu_seconds", "cpu_seconds_per_step", "episodes_per_cpu_second", "out", "resume")
"""Entries of JSON documents that differ from run to run, or depend on how a command was called."""


@dataclass(frozen=True)
class Long:
    """A long command, and the folder that it makes."""

    line: str
    out: str

    @property
    def resumed(self) -> str:
        return f"{self.line} --resume"


PRETRAIN = Long(
    f"pretrain {WORLD} --preset smoke --trajectories 40 --holdout 8 --embed-dim 8 --num-layers 1 "
    "--num-heads 2 --batch-size 8 --part-size 4 --eval-tasks 2 --optimizer adamw --steps 20 "
    "--save-every 3 --eval-every 4 --out run",
    "run",
)
ADAPT = Long(
    f"adapt {WORLD} --policy policy --seeds 1 --episodes 12 --eval-every 2 --no-figures --out result",
    "result",
)
COLLECT = Long(f"collect {WORLD} --trajectories 1200 --out dataset", "dataset")
LONG = {"pretrain": PRETRAIN, "adapt": ADAPT, "collect": COLLECT}


class Reference:
    """The results of uninterrupted commands, and copies of what they need.

    Args:
      folder: the folder that they run in.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def make(self, server: Server) -> None:
        """Run the commands once, and the training once more until it is killed."""
        self.folder.mkdir()
        assert server.run(f"collect {WORLD} --trajectories 40", self.folder).code == 0
        for name, long in LONG.items():
            done = server.run(
                long.line, self.folder, count=str(self.folder.parent / f"{name}.count")
            )
            assert done.code == 0, done.err
            if long is PRETRAIN:
                shutil.copytree(self.folder / "run/policy", self.folder / "policy")
        (half := self.folder / "half").mkdir()
        self.furnish(half)
        trap = Trap(round(0.8 * self.operations("pretrain")))
        assert server.run(PRETRAIN.line, half, trap).code == -signal.SIGKILL
        shutil.move(half / "run", self.folder / "half_run")

    def operations(self, name: str) -> int:
        """The number of operations of a command that change files."""
        return int((self.folder.parent / f"{name}.count").read_text())

    def furnish(self, folder: Path, *made: str) -> Path:
        """Copy the dataset and the policy that the commands need, and results of some of them."""
        for name in ("data", "policy", *made):
            shutil.copytree(self.folder / name, folder / name)
        return folder

    def check(self, folder: Path, long: Long) -> None:
        """Check that the result of a command is the same bit for bit, and that it left nothing else."""
        found, wanted = contents(folder / long.out), contents(self.folder / long.out)
        assert found == wanted
        litter = [
            str(path.relative_to(folder))
            for path in folder.rglob("*")
            if any(word in path.name for word in (".partial", ".lock", ".writing", ".aside"))
        ]
        assert litter == []


def contents(folder: Path) -> dict[str, Any]:
    """The contents of a result folder, by file name, without checkpoints and entries that vary."""
    return {
        str(path.relative_to(folder)): _content(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.relative_to(folder).parts[0].startswith("checkpoints")
    }


def _content(path: Path) -> Any:
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as file:
            return digest(dict(file))
    if path.suffix == ".jsonl":
        return [_lasting(json.loads(line)) for line in path.read_text().splitlines()]
    if path.suffix == ".json" and path.name != "meta.json":
        return _lasting(json.loads(path.read_text()))
    return "there"


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """A hash of names, types, shapes and bits."""
    whole = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        whole.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        whole.update(np.ascontiguousarray(array).tobytes())
    return whole.hexdigest()


def _lasting(value: Any) -> Any:
    """A JSON value without the entries that vary."""
    if isinstance(value, dict):
        return {k: _lasting(v) for k, v in value.items() if k not in VARIES}
    return [_lasting(v) for v in value] if isinstance(value, list) else value
