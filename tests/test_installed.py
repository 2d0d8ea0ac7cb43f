"""``experiments.list`` and ``experiments.info``: networks, extras and folders, as text and as JSON."""

from __future__ import annotations

import json
from importlib import metadata
from pathlib import Path

import pytest

import envs
from envs.errors import UsageError
from envs.installing import how_to_install, how_to_reinstall
from experiments import info, installed
from experiments import list as listing
from experiments.info import InfoConfig
from experiments.installed import Extra, released_networks, size_of
from experiments.list import ListConfig
from experiments.store.extras import import_extra

ROOT = Path(__file__).parents[1]


def test_extras_are_those_of_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    required = [
        "jax<0.12,>=0.10",
        'numpy>=2; extra == "fast"',
        'no-such-package[more]>=1; extra == "fast"',
        "jax ; python_version >= '3.11' and extra == 'plain'",
        'pytest; extra == "dev"',
    ]
    monkeypatch.setattr(installed.metadata, "requires", lambda name: required)
    fast = Extra("fast", ("numpy", "no-such-package"), ("no-such-package",))
    assert installed.extras() == [fast, Extra("plain", ("jax",), ())]
    assert str(fast) == "fast: no-such-package missing; pip install 'mgpo-jax[fast]'"
    assert str(installed.extras()[1]) == "plain: installed"


def test_what_is_missing_is_installed_without_a_clone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "version", lambda name: "0.1.0")
    assert how_to_install("onnx") == "pip install 'mgpo-jax[onnx]'"
    assert how_to_install() == "pip install 'mgpo-jax'"
    assert how_to_reinstall("craftax").endswith(" 'craftax==0.1.0'")
    with pytest.raises(
        UsageError, match=r"^none\.such is not .*run `pip install 'mgpo-jax\[tb\]'`$"
    ):
        import_extra("none.such", "tb")


def test_a_clone_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", version)
    assert how_to_install("onnx") == f"pip install '{ROOT}[onnx]'"
    assert how_to_reinstall("craftax").endswith(" 'craftax'")


def test_no_message_needs_a_clone() -> None:
    """``pip install -e .`` only works in a clone, and most users have a wheel."""
    sources = [
        path for name in ("envs", "mgpo_jax", "experiments") for path in (ROOT / name).rglob("*.py")
    ]
    assert len(sources) > 200
    assert [path.name for path in sources if "install -e" in path.read_text()] == []


def test_networks_and_sizes(tmp_path: Path) -> None:
    kinds = {
        network.kind: network.num_bytes for network in released_networks(envs.find("gridworld"))
    }
    assert kinds.keys() == {"mgpo", "ptgm", "spirl"}
    assert min(kinds.values()) > 1_000_000
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a").write_bytes(b"123")
    (tmp_path / "b").write_bytes(b"4")
    assert size_of(tmp_path) == 4
    assert size_of(tmp_path / "nowhere") == 0


def test_what_is_there_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    listing.main(ListConfig(json=True))
    found = json.loads(capsys.readouterr().out)
    worlds = {world["name"]: world for world in found["worlds"]}
    assert worlds["kitchen-stock"]["networks"] == worlds["kitchen"]["networks"]
    assert worlds["maze15"]["cpu_seconds_per_episode"]["ucb"] < 0.01
    assert 5 < worlds["maze15"]["cpu_seconds_of_adapt"] < 100
    assert worlds["kitchen-native"]["cpu_seconds_of_adapt"] is None
    assert {method["name"]: method["network"] for method in found["methods"]}["ptgm"] == "ptgm"
    info.main(InfoConfig(json=True))
    found = json.loads(capsys.readouterr().out)
    assert {"numpy", "orbax-checkpoint", "gymnasium"} <= found["versions"].keys()
    assert len(found["devices"]) >= 1
    assert found["folders"]["compiled programs"]["bytes"] >= 0


def test_what_is_there_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    listing.main(ListConfig())
    text = capsys.readouterr().out
    assert "released networks: mgpo 2.5 MB, ptgm 2.5 MB" in text
    assert "starts from the network spirl" in text
    assert "spirl 1.4 MB; adapt takes about " in text
    info.main(InfoConfig())
    text = capsys.readouterr().out
    assert "extra " in text
    assert "memory " in text
