"""``experiments.check`` and ``--obs-noise official``: a world against its official program."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_results import ENV, SIDE, TINY, made_results
from test_results import policy_in, with_summary

from envs.checks import Report
from envs.errors import DataError, UsageError
from envs.maze.env import NORTH, MazeRunner
from envs.official import Official, Own, play
from envs.registry import WORLDS
from envs.wrappers import Noisy
from experiments.check import CheckConfig
from experiments.check import main as check
from experiments.evaluation import Noise, cells, evaluate_cases, noises, open_case
from experiments.store.result_files import save_results
from mgpo_jax.files import hash_file

WIDTHS = (0.5, 0.25, 0.0, 0.0, 0.0, 0.0)


def cell(goal: np.ndarray) -> str:
    row, column = (goal * SIDE).round().astype(int)
    return f"cell {row} {column}"


def official_of(horizon: int) -> Official:
    """In place of an official program: the world itself, with another horizon."""
    other = MazeRunner(name="other", side=SIDE, horizon=horizon)
    return Official(
        name="mazes 1.0",
        episode=lambda task: Own(other, task, cell),
        goal_name=cell,
        task_name=lambda task: f"to {np.asarray(task.goal).tolist()}",
        obs_noise=WIDTHS,
    )


@pytest.fixture
def register(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes the tiny world known, with an official program."""

    def do(official: Any) -> None:
        monkeypatch.setitem(WORLDS._registered, "tiny", replace(TINY, official=official))

    do(lambda env: official_of(ENV.horizon))
    return do


@pytest.fixture
def result(tmp_path: Path, register: Any) -> Path:
    """An adaptation of an untrained policy, made by hand."""
    sha256 = policy_in(tmp_path / "policy", 0)
    config = {"env": "tiny", "method": "ucb", "policy": str(tmp_path / "policy")}
    save_results(tmp_path / "result", with_summary(made_results(config=config), sha256))
    return tmp_path / "result"


class Northward:
    """Acts in the same way whatever it sees."""

    def reset(self, obs: np.ndarray) -> np.ndarray:
        return self.act(obs)

    def act(self, obs: np.ndarray) -> np.ndarray:
        return np.array(NORTH)


def checked(folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], str]:
    """What the command writes, and what it prints."""
    out = folder.with_name("check.json")
    check(CheckConfig(runs=(folder,), out=out))
    return json.loads(out.read_text()), capsys.readouterr().out


def test_a_world_agrees_with_itself(result: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written, text = checked(result, capsys)
    assert [(row["seed"], row["task"]) for row in written["rows"]] == [
        (0, 0),
        (0, 1),
        (1, 0),
        (1, 1),
    ]
    for row in written["rows"]:
        assert row["here"] == row["there"]
        assert row["agrees"]
        assert row["prompt"] == ["cell 3 3", "cell 1 5" if row["task"] == 0 else "cell 5 1"]
        assert row["here"]["steps"] == list(range(1, row["here"]["length"] + 1))
    (summary,) = written["summaries"]
    counted = ("prompts", "agreeing", "same_return")
    assert [summary[f"num_{name}"] for name in counted] == [4, 4, 4]
    assert summary["return"] == summary["official_return"]
    assert summary["adapted"] == pytest.approx(-0.25)  # made by hand, not by this policy
    assert summary["results_sha256"] == hash_file(result / "results.npz")
    assert summary["policy_sha256"] == hash_file(result.with_name("policy") / "weights.npz")
    assert {"command", "revision", "versions", "devices"} <= written.keys()
    assert "4 of 4 prompts reach the same goals in the same order, 4 have the same return" in text
    assert text.count("the same |") == 4
    assert "to [1, 5]" in text


def test_findings_as_json(
    result: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    written, _ = checked(result, capsys)
    check(CheckConfig(runs=(result,), json=True))
    printed = json.loads(capsys.readouterr().out)
    assert printed == {name: written[name] for name in ("summaries", "rows")}

    reports = iter([Report("maze15", ("it is broken",), facts={"steps": 3.0})])
    monkeypatch.setattr("envs.check_world", lambda name: next(reports), raising=False)
    with pytest.raises(DataError, match="faults found in maze15"):
        check(CheckConfig(runs=(Path("maze15"),), json=True))
    (report,) = json.loads(capsys.readouterr().out)["worlds"].values()
    assert (report["faults"], report["facts"]) == (["it is broken"], {"steps": 3.0})


def test_a_difference_is_shown(result: Path, register: Any, capsys: Any) -> None:
    register(lambda env: official_of(horizon=3))
    written, text = checked(result, capsys)
    for row in written["rows"]:
        assert not row["agrees"]
        assert not row["same_return"]
        assert (row["here"]["length"], row["there"]["length"]) == (6, 3)
        assert row["here"]["reached"][:3] == row["there"]["reached"]
    assert "0 of 4 prompts reach the same goals in the same order, 0 have the same return" in text
    assert "the same |" not in text


def test_a_world_without_an_official_program(result: Path, register: Any) -> None:
    register(None)
    with pytest.raises(
        UsageError,
        match="tiny has no official implementation to compare with; worlds that have one: kit",
    ):
        check(CheckConfig(runs=(result,)))
    with pytest.raises(UsageError, match="tiny has no official implementation to compare"):
        open_case(result, None, noises(["official"], ()))


def test_an_official_program_that_is_not_installed(result: Path, register: Any) -> None:
    def missing(env: Any) -> Official:
        raise ImportError("mazes are missing: pip install mazes")

    register(missing)
    with pytest.raises(UsageError, match="pip install mazes"):
        check(CheckConfig(runs=(result,)))


def test_stepped_by_hand_it_is_the_world(register: Any) -> None:
    """Up from row 5 to the wall above row 1, at a cost of 0.1 a step."""
    found = play(Northward(), Own(ENV, made_results().task(0), cell))
    rows = (4, 3, 2, 1, 1, 1)
    assert found.reached == tuple(f"cell {row} 3" for row in rows)
    assert found.steps == (1, 2, 3, 4, 5, 6)
    assert (found.return_, found.length) == (pytest.approx(-0.6), 6)


def test_noise_of_the_official_program(result: Path) -> None:
    """It is what the program says, and a row beside others."""
    sizes = noises(["official", 0.5], [])
    assert sizes == [Noise(obs="official"), Noise(obs=0.5)]
    case = open_case(result, None, sizes)
    assert [env for _, env in case.behind] == [Noisy(ENV, obs_range=WIDTHS), Noisy(ENV, 0.5)]
    disturbed = open_case(
        result, None, [Noise(action=0.25), Noise("official", 0.5), Noise(0.1, 0.2)]
    )
    assert [env for _, env in disturbed.behind] == [
        Noisy(ENV, action_noise=0.25),
        Noisy(ENV, action_noise=0.5, obs_range=WIDTHS),
        Noisy(ENV, 0.1, 0.2),
    ]
    rows = list(evaluate_cases([case], episodes=2, seed=0))
    assert [row["obs_noise"] for row in rows] == ["official", 0.5]
    assert [cells(row)[5] for row in rows] == ["observations official", "observations 0.5"]
    json.dumps(rows)


def test_noise_of_an_official_program_that_adds_none(result: Path, register: Any) -> None:
    register(lambda env: replace(official_of(6), obs_noise=()))
    with pytest.raises(UsageError, match=r"--obs-noise official: mazes 1.0 adds no noise"):
        open_case(result, None, noises(["official"], ()))
