"""``--dry-run``: prints estimates of the work, and does none of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from envs.errors import UsageError
from experiments import adapt, pretrain
from experiments.inventory import price_of
from experiments.parsing import parse
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.presets import pretrain_default
from experiments.store.settings import PretrainConfig
from experiments.store.speeds import SPEEDS, measured, shipped_rates

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
    words = ["--env", "envs.maze:MAZE15", "--dry-run"]  # its place is no name that was measured
    adapt.main(parse(AdaptConfig, words, adapt.adapt_default))
    assert "unknown: no similar run" in capsys.readouterr().out
    adapt.main(parse(AdaptConfig, [*words, "--json"], adapt.adapt_default))
    assert json.loads(capsys.readouterr().out)["cpu_seconds"] is None
    assert not list(tmp_path.iterdir())


def test_the_speed_is_known_without_published_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only a clone has them; an installed package has the rates in a file."""
    monkeypatch.chdir(tmp_path)
    adapt.main(parse(AdaptConfig, ["--dry-run", "--json"], adapt.adapt_default))
    found = json.loads(capsys.readouterr().out)
    assert found["searches"] == 150
    assert found["cpu_seconds"] == pytest.approx(
        sum(found["episodes"].values()) * shipped_rates("maze15")["ucb"]
    )


def test_the_speeds_in_the_package_are_those_of_the_published_results() -> None:
    assert json.loads(SPEEDS.read_text()) == measured(ROOT / "results")


def test_json_is_for_estimates(tmp_path: Path) -> None:
    words = ["--json", "--out", str(tmp_path / "new")]
    with pytest.raises(UsageError, match="--json prints the estimate of --dry-run"):
        pretrain.main(parse(PretrainConfig, words, pretrain_default))
    assert not (tmp_path / "new").exists()


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


def test_a_training_costs_as_much_as_its_batches_are_large() -> None:
    """The released policy of ``crafter`` learned from larger batches than the preset has."""
    costs = {}
    for env, size in (("maze15", 64), ("maze15", 32), ("crafter", 16), ("crafter", 32)):
        words = ["--env", env, "--steps", "8000", "--batch-size", str(size)]
        costs[env, size] = price_of(parse(PretrainConfig, words, pretrain_default))
    assert costs["maze15", 32] == pytest.approx(costs["maze15", 64] / 2)
    assert costs["crafter", 16] == pytest.approx(costs["crafter", 32] / 2)
    assert costs["crafter", 32] == pytest.approx(8_000 * 2.176, rel=1e-3)


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
    assert found["observations"] == "float32[6]"
    assert found["goals"] == "2 numbers"
    assert found["actions"] == "5 discrete"
    assert found["batches"] == "64 trajectories in parts of 16, at most 201 kB of input"
    assert "time" in found["CPU"]
    assert "about " in found["CPU"]
    pretrain.main(
        parse(PretrainConfig, ["--steps", "4000", "--dry-run", "--json"], pretrain_default)
    )
    again = json.loads(capsys.readouterr().out)
    assert (again["weights"], again["steps"]) == (606_853, 4_000)
    assert again["batches"]["bytes"] == 64 * 64 * (4 * (6 + 2 * 1 + 2 * 2) + 1)
    assert not list(tmp_path.iterdir())
