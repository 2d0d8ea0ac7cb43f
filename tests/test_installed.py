"""``experiments.list`` and ``experiments.info``: networks, extras and folders, as text and as JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import envs
from experiments import info, installed
from experiments import list as listing
from experiments.info import InfoConfig
from experiments.installed import Extra, released_networks, size_of
from experiments.list import ListConfig


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
    assert {method["name"]: method["network"] for method in found["methods"]}["ptgm"] == "ptgm"
    info.main(InfoConfig(json=True))
    found = json.loads(capsys.readouterr().out)
    assert found["versions"]["numpy"]
    assert len(found["devices"]) >= 1
    assert found["folders"]["compiled programs"]["bytes"] >= 0


def test_what_is_there_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    listing.main(ListConfig())
    text = capsys.readouterr().out
    assert "released networks: mgpo 2.5 MB, ptgm 2.5 MB" in text
    assert "starts from the network spirl" in text
    info.main(InfoConfig())
    text = capsys.readouterr().out
    assert "extra " in text
    assert "memory " in text
