"""The wheel contains all that an installed package needs, and works beside packages with our names."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("mgpo_jax", "envs", "experiments")


def installed(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """A command of the unpacked wheel, in a folder that has packages of our names."""
    for name in PACKAGES[1:]:
        (folder / "own" / name).mkdir(parents=True, exist_ok=True)
        (folder / "own" / name / "__init__.py").write_text("raise ImportError('a stranger')")
    (folder / "own" / "data").mkdir(exist_ok=True)
    env = {**os.environ, "PYTHONPATH": str(folder / "site")}
    command = [sys.executable, "-m", "mgpo_jax", *words]
    return subprocess.run(
        command, cwd=folder / "own", env=env, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which ``site`` is the unpacked wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"  # building leaves files behind
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder)]
    command = [*pip, str(source)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    if built.returncode and "No matching distribution found for setuptools" in built.stderr:
        pytest.skip("there is no package index to build a wheel with")
    assert not built.returncode, built.stderr
    (path,) = folder.glob("mgpo_jax-*.whl")
    zipfile.ZipFile(path).extractall(folder / "site")
    return folder


def test_every_file_of_the_packages_is_in_the_wheel(wheel: Path) -> None:
    listed = subprocess.run(
        ["git", "ls-files", *PACKAGES], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("this is no clone")
    missing = [name for name in listed.stdout.split() if not (wheel / "site" / name).is_file()]
    assert missing == []


def test_it_is_found_before_packages_of_the_same_names(wheel: Path) -> None:
    done = installed(wheel, "list", "--json")
    assert not done.returncode, done.stderr
    worlds = {world["name"]: world for world in json.loads(done.stdout)["worlds"]}
    assert {"maze15", "maze30", "gridworld", "kitchen"} <= worlds.keys()
    assert worlds["maze15"]["networks"]["mgpo"] > 1_000_000


def test_it_adapts_the_released_policy(wheel: Path) -> None:
    with np.load(wheel / "site/mgpo_jax/pretrained/maze15/tasks.npz") as tasks:
        np.savez(wheel / "mine.npz", **{name: tasks[name][:2] for name in tasks})
    done = installed(
        wheel, "adapt", "--tasks", "../mine.npz", "--seeds", "1", "--episodes", "3", "--no-figures"
    )
    assert not done.returncode, done.stderr
    assert "maze15, ucb: 2 tasks x 1 seeds x 3 episodes" in done.stdout
    summary = json.loads((wheel / "own/runs/adapt/maze15/ucb-seed0/summary.json").read_text())
    assert summary["num_tasks"] == 2
