"""Ablations by one command: what is finished stays, what is not goes on, the table says what it is of."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import pytest

import mgpo_jax.rollout
from experiments import reproduce
from experiments.configs import PretrainConfig, pretrain_preset
from experiments.reproduce import ReproduceConfig, main
from experiments.results import load_results
from experiments.tasks import benchmark_tasks
from mgpo_jax.errors import DataError, UsageError


def tiny_preset(env: str, preset: str) -> PretrainConfig:
    assert preset == "fast"
    smoke = pretrain_preset(env, "smoke")
    train = replace(smoke.train, batch_size=8, part_size=4, bucket=64)
    return replace(
        smoke, train=train, embed_dim=8, num_layers=1, num_heads=2, holdout=4, eval_tasks=2
    )


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Trainings of two steps and adaptations of two episodes to two tasks."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MGPO_DATA", raising=False)
    monkeypatch.setattr(reproduce, "pretrain_preset", tiny_preset)
    monkeypatch.setattr(reproduce, "EPISODES", 2)
    monkeypatch.setattr(mgpo_jax.rollout, "NUM_SEGMENTS", 1)
    few = lambda env: jax.tree.map(lambda leaf: leaf[:2], benchmark_tasks(env))  # noqa: E731
    monkeypatch.setattr(reproduce, "benchmark_tasks", few)
    return tmp_path


def test_table5_from_data_to_table(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = ReproduceConfig(what="table5", only=("astar2",), steps=2, episodes=24, seeds=1)
    main(config)
    folder = tiny / "runs" / "reproduce" / "maze15"
    text = (folder / "table5.md").read_text()
    head, _, *rows = [line for line in text.splitlines() if line.startswith("|")]
    assert "2 gradient steps on 24 trajectories each" in text
    assert head.split("|")[2].strip() == "initial"
    (row,) = rows
    label, initial, *_, paper = (cell.strip() for cell in row.strip("|").split("|"))
    assert (label, paper) == ("astar2", "-0.36 ± 0.02")
    results = load_results(folder / "table5" / "astar2-k5-2steps-24episodes-1seeds")
    assert results.returns.shape == (1, 2, 2)
    assert float(initial) == pytest.approx(results.eval_returns[:, :, 0].mean(), abs=0.01)
    assert (folder / "table5.png").stat().st_size > 0

    def never(*args: Any, **options: Any) -> None:
        raise AssertionError("what is finished was done again")

    monkeypatch.setattr(reproduce, "pretrain", never)
    monkeypatch.setattr(reproduce, "run_variants", never)
    (folder / "table5.md").unlink()
    main(config)
    assert (folder / "table5.md").read_text() == text

    summary = folder / "table5" / "astar2-k5-2steps-24episodes-1seeds" / "summary.json"
    summary.write_text(json.dumps({**json.loads(summary.read_text()), "policy_sha256": "0" * 64}))
    with pytest.raises(DataError, match=r"are not those .* \(0{12}\): remove .*1seeds"):
        main(config)


def test_a_stopped_training_goes_on(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[PretrainConfig] = []
    monkeypatch.setattr(reproduce, "pretrain", asked.append)
    config = ReproduceConfig(what="figure8", steps=2)
    policy = reproduce.trained(config, "astar4", "astar4", max_prompt_length=10)
    policy.parent.mkdir(parents=True)
    reproduce.trained(config, "astar4", "astar4", max_prompt_length=10)
    assert [one.resume for one in asked] == [False, True]
    for one in asked:
        assert (one.out, one.max_prompt_length) == (policy.parent, 10)
        assert (one.data.demonstrator, one.train.steps) == ("astar4", 2)
    policy.mkdir()
    reproduce.trained(config, "astar4", "astar4", max_prompt_length=10)
    assert len(asked) == 2


def test_heads_differ_in_nothing_else(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[PretrainConfig] = []
    adapted: list[Path] = []
    monkeypatch.setattr(reproduce, "pretrain", asked.append)
    monkeypatch.setattr(
        reproduce, "adapted", lambda config, policy, folders: adapted.extend(folders)
    )
    lines = reproduce.heads(ReproduceConfig(what="heads", env="kitchen", steps=2))
    assert [line.label for line in lines] == ["gaussian", "fixed_gaussian", "mixture", "binned"]
    assert [line.results for line in lines] == adapted
    assert [one.head for one in asked] == [line.label for line in lines]
    same = {replace(one, head=None, out=None) for one in asked}
    assert len(same) == 1
    assert same.pop().data.episodes == 9_000


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (ReproduceConfig(what="tabel5"), "did you mean 'table5'"),
        (ReproduceConfig(what="table5", env="gridworld"), "no table5 for gridworld"),
        (ReproduceConfig(what="heads"), "no heads for maze15; choose --env kitchen"),
        (ReproduceConfig(what="table5", only=("astar3",)), "did you mean 'astar"),
        (ReproduceConfig(what="figure8", only=("41",)), "row of figure8"),
        (ReproduceConfig(what="table4", steps=0), "--steps must be at least 1"),
    ],
)
def test_usage_errors(config: ReproduceConfig, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        main(config)
