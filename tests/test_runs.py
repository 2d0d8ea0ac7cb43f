"""What a resumed run is compared with: the identity of the run, and its devices and versions."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.store.provenance import Meta, revision
from experiments.store.runs import changes, identity, say_what_differs
from experiments.store.settings import PretrainConfig

BEFORE = {
    "devices": ["TFRT_CPU_0", "TFRT_CPU_1"],
    "versions": {"jax": "0.10.2", "numpy": "2.0", "flax": "0.12.8"},
}


def test_the_same_machine_and_versions_need_no_word(capsys: pytest.CaptureFixture[str]) -> None:
    say_what_differs(BEFORE, BEFORE, "run")
    assert capsys.readouterr().err == ""


def test_other_devices_and_versions_are_said_in_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    now = {"devices": ["cuda:0"], "versions": {"jax": "0.11.2", "numpy": "2.0"}}
    say_what_differs(BEFORE, now, "run")
    assert capsys.readouterr().err == (
        "run was begun with 2 x TFRT_CPU (now 1 x cuda), jax '0.10.2' (now 0.11.2), "
        "flax '0.12.8' (now None): the result may differ in its last bits\n"
    )


def test_fewer_cores_are_said(capsys: pytest.CaptureFixture[str]) -> None:
    say_what_differs(BEFORE, {**BEFORE, "devices": ["TFRT_CPU_0"]}, "run")
    assert "2 x TFRT_CPU (now 1 x TFRT_CPU)" in capsys.readouterr().err


def test_a_run_is_known_by_what_decides_about_its_weights() -> None:
    config = PretrainConfig()
    same = replace(config, out=Path("elsewhere"), eval_every=7, resume=True, tb=True)
    assert identity(same, "ab") == identity(config, "ab")
    others = [
        replace(config, train=replace(config.train, seed=1)),
        replace(config, data=replace(config.data, data_seed=1)),
        replace(config, embed_dim=64),
    ]
    identities = {identity(config, "cd"), *(identity(other, "ab") for other in others)}
    assert len(identities - {identity(config, "ab")}) == 4


def test_what_changed_is_told_by_name() -> None:
    assert changes({"a": 1, "b": 2}, {"a": 1, "b": 2}) == ""
    assert changes({"a": 1, "b": "x"}, {"a": 2, "c": 3}) == "a 1 -> 2; b 'x' -> None; c None -> 3"


def test_the_hardware_in_words() -> None:
    gpus = Meta(devices=["cuda:0", "cuda:1"], device_kinds=["NVIDIA H100 80GB HBM3"])
    assert gpus.hardware == "2 x cuda (NVIDIA H100 80GB HBM3)"
    assert not gpus.on_cpus
    for cpu in ("cpu:0", "TFRT_CPU_0"):
        assert Meta(devices=[cpu], device_kinds=["cpu"]).on_cpus
    assert Meta(devices=["cpu:0"], device_kinds=["cpu"]).hardware == "1 x cpu"
    assert Meta().on_cpus  # files of the first version record no devices


def test_the_revision_is_that_of_the_code_alone(tmp_path: Path) -> None:
    """Not that of a repository which the environment of an installed copy lies in."""
    installed = tmp_path / ".venv" / "site-packages"
    installed.mkdir(parents=True)
    (tmp_path / "file").touch()
    user = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    for words in (("init", "-q"), ("add", "file"), (*user, "commit", "-q", "-m", "first")):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    assert revision(installed) == "unknown"
    assert re.fullmatch(r"[0-9a-f]{12}", revision(tmp_path))
    assert revision(tmp_path / "nowhere") == "unknown"
