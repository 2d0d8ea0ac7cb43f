"""The sdist and the wheel contain all that users need, and the wheel works beside packages of our names.

The wheel is made of the sdist, and installed into an environment of its own. The packages that it needs are
those of the running environment, which is on the path there. Its ``.pth`` files are not read, so that an
editable installation cannot supply what the wheel lacks.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("mgpo_jax", "envs", "experiments")
BUILD = """
import sys
from setuptools import build_meta
getattr(build_meta, sys.argv[1])(sys.argv[2])
"""


def clean() -> dict[str, str]:
    """The environment variables, without those that say where packages are."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


def done(command: list[str], **options: Any) -> str:
    """What a command printed; it must succeed."""
    options = {"env": clean(), **options}
    ended = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert not ended.returncode, ended.stderr
    return ended.stdout


def mgpo(folder: Path, *words: str) -> str:
    """What the installed script prints, in a folder that has packages of our names."""
    return done([str(folder / "venv/bin/mgpo"), *words], cwd=folder / "own")


def build(folder: Path, source: Path, what: str) -> Path:
    """Build an sdist or a wheel of a folder with setuptools."""
    tools = {**clean(), "PYTHONPATH": str(folder / "tools")}
    done([sys.executable, "-c", BUILD, f"build_{what}", str(folder)], cwd=source, env=tools)
    (path,) = folder.glob("mgpo_jax-*.tar.gz" if what == "sdist" else "mgpo_jax-*.whl")
    return path


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An sdist; its folder is used for everything else."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "install", "-q", "--target", str(folder / "tools")]
    got = subprocess.run([*pip, "setuptools>=77"], capture_output=True, text=True, check=False)
    if got.returncode and "No matching distribution found for setuptools" in got.stderr:
        pytest.skip("there is no package index to build a wheel with")
    assert not got.returncode, got.stderr
    source = folder / "source"  # building leaves files behind
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    return build(folder, source, "sdist")


@pytest.fixture(scope="module")
def wheel(sdist: Path) -> Path:
    """A wheel made of the sdist."""
    with tarfile.open(sdist) as archive:
        archive.extractall(sdist.parent / "unpacked", filter="data")
    (source,) = (sdist.parent / "unpacked").iterdir()
    return build(sdist.parent, source, "wheel")


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    """A folder with an environment that has the wheel, and with a user's folder ``own``."""
    folder = wheel.parent
    venv.create(folder / "venv")
    python = str(folder / "venv/bin/python")
    pip = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        python,
        "install",
        "-q",
        "--no-deps",
        "--no-index",
    ]
    done([*pip, str(wheel)])
    (site,) = folder.glob("venv/lib/python*/site-packages")
    places = {sysconfig.get_path(name) for name in ("purelib", "platlib")}
    (site / "needed.pth").write_text("\n".join(sorted(places)))
    for name in PACKAGES[1:]:
        (folder / "own" / name).mkdir(parents=True)
        (folder / "own" / name / "__init__.py").write_text("raise ImportError('a stranger')")
    (folder / "own" / "data").mkdir()
    return folder


def listed() -> list[str]:
    """The files of the packages that git knows."""
    command = ["git", "ls-files", *PACKAGES]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if ended.returncode:
        pytest.skip("this is no clone")
    return ended.stdout.split()


def test_every_file_of_the_packages_is_in_the_sdist_and_in_the_wheel(
    sdist: Path, wheel: Path
) -> None:
    with tarfile.open(sdist) as archive:
        in_sdist = {name.partition("/")[2] for name in archive.getnames()}
    with zipfile.ZipFile(wheel) as archive:
        in_wheel = set(archive.namelist())
    wanted = set(listed())
    assert wanted - in_sdist == set()
    assert wanted - in_wheel == set()
    for name in (
        "mgpo_jax/pretrained/maze15/weights.npz",
        "mgpo_jax/pretrained/maze15/tasks.npz",
        "experiments/store/paper.toml",
        "experiments/store/speeds.json",
    ):
        assert name in in_sdist & in_wheel
    said = re.search(r"The wheel has (\d+) MB", (ROOT / "docs/install.md").read_text())
    assert said is not None
    assert wheel.stat().st_size / 1e6 == pytest.approx(int(said[1]), abs=3)


def test_the_packages_are_those_of_the_wheel(installed: Path) -> None:
    code = f"import {', '.join(PACKAGES)}\nfor package in ({', '.join(PACKAGES)}): print(package.__file__)"
    python = str(installed / "venv/bin/python")
    places = done([python, "-c", code], cwd=installed).split()
    assert [Path(place).is_relative_to(installed / "venv") for place in places] == [True] * 3


def test_it_is_found_before_packages_of_the_same_names(installed: Path) -> None:
    worlds = {
        world["name"]: world for world in json.loads(mgpo(installed, "list", "--json"))["worlds"]
    }
    assert {"maze15", "maze30", "gridworld", "kitchen"} <= worlds.keys()
    assert worlds["maze15"]["networks"]["mgpo"] > 1_000_000
    assert worlds["maze15"]["cpu_seconds_of_adapt"] > 1
    module = [str(installed / "venv/bin/python"), "-m", "mgpo_jax", "--version"]
    assert done(module, cwd=installed / "own").startswith("mgpo ")


def test_it_adapts_the_released_policy(installed: Path) -> None:
    (site,) = installed.glob("venv/lib/python*/site-packages")
    with np.load(site / "mgpo_jax/pretrained/maze15/tasks.npz") as tasks:
        np.savez(installed / "mine.npz", **{name: tasks[name][:2] for name in tasks})
    words = "adapt --tasks ../mine.npz --seeds 1 --episodes 3 --no-figures"
    assert "maze15, ucb: 2 tasks x 1 seeds x 3 episodes" in mgpo(installed, *words.split())
    summary = json.loads((installed / "own/runs/adapt/maze15/ucb-seed0/summary.json").read_text())
    assert summary["num_tasks"] == 2
