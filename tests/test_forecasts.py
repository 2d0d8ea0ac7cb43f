"""``--dry-run``: prints estimates of the work, and does none of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments import adapt, pretrain
from experiments.parsing import parse
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.presets import pretrain_default
from experiments.store.settings import PretrainConfig

ROOT = Path(__file__).parents[1]


def test_an_adaptation_is_only_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)  # published results tell the speed
    words = f"--episodes 40 --seeds 2 --sweep c=1,2 --dry-run --out {tmp_path}/new"
    adapt.main(parse(AdaptConfig, words.split(), adapt.adapt_default))
    found = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()[2:])
    assert found["searches"] == "50 tasks x 2 seeds x 2 variants"
    assert found["episodes"] == "8,000 for searching, 1,000 for evaluation"  # after 1, 10, .., 40
    assert found["steps"] == f"at most {9_000 * 64:,}"
    assert found["network"] == "606,853 weights"
    assert "time" in found["CPU"]
    assert "about " in found["CPU"]
    assert not (tmp_path / "new").exists()


def test_what_was_never_measured_is_not_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    adapt.main(parse(AdaptConfig, ["--dry-run"], adapt.adapt_default))
    assert "unknown: no similar run" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


def test_a_training_that_goes_on_from_a_policy_tells_its_schedule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    policy = str(ROOT / "mgpo_jax/pretrained/maze15")
    words = ["--init", policy, "--steps", "1000", "--learning-rate", "1e-3", "--dry-run"]
    pretrain.main(parse(PretrainConfig, words, pretrain_default))
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "schedule" in line]
    assert said.startswith("schedule: 1,000 gradient steps of ")
    assert "the learning rate rises to 0.001 within " in said


def test_a_training_is_only_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    pretrain.main(parse(PretrainConfig, ["--steps", "4000", "--dry-run"], pretrain_default))
    out, err = capsys.readouterr()
    assert "schedule: 4,000 gradient steps of 64 trajectories, which is 2.6 epochs" in err
    found = dict(line.split(maxsplit=1) for line in out.splitlines()[2:])
    assert found["trajectories"] == "100,000, 200 of them held out"
    assert found["network"] == "606,853 weights"  # as the released policy has
    assert found["tokens"] == f"at most {5 + 2 * 64 - 1:,} a trajectory"
    assert "time" in found["CPU"]
    assert "about " in found["CPU"]
    assert not list(tmp_path.iterdir())
