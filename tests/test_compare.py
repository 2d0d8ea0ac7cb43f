"""``experiments.compare``: paired comparisons of published results."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envs.errors import UsageError
from experiments.compare import CompareConfig, main
from experiments.figures import performance_profiles
from experiments.pairing import differing
from experiments.store.result_files import load_results
from experiments.store.statistics import performance_profile

RESULTS = Path(__file__).parent.parent / "results"
UCB, PLAN = RESULTS / "maze15" / "ucb", RESULTS / "maze15" / "plan"


def rows_of(text: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]


def test_differences_are_paired_by_task(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(CompareConfig(runs=(UCB, PLAN, UCB), csv=tmp_path / "tasks.csv"))
    done = capsys.readouterr()
    assert "warning" not in done.err
    _, _, first, plan, again = rows_of(done.out)
    returns = {
        folder: load_results(folder).eval_returns[:, :, -1].mean(axis=0) for folder in (UCB, PLAN)
    }
    change = returns[PLAN] - returns[UCB]
    value, low, high = (float(part.strip("[],")) for part in plan[3].split())
    assert value == pytest.approx(change.mean(), abs=1e-3)
    assert 0 < low < value < high
    better, equal, worse = (int(part) for part in plan[5].split("/"))
    assert (better, worse) == (np.sum(change > 1e-6), np.sum(change < -1e-6))
    assert better + equal + worse == 50
    assert first[3:] == ["", "", ""]
    assert again[3].startswith("0.000")
    assert again[5] == "0 / 50 / 0"

    head, *lines = (tmp_path / "tasks.csv").read_text().splitlines()
    seeds = [f"{folder} seed {index}" for folder in (UCB, PLAN) for index in range(3)]
    assert head.split(",") == ["task", "optimum", *map(str, (UCB, PLAN, UCB)), *seeds]
    assert len(lines) == 50
    cells = [float(cell) for cell in lines[7].split(",")]
    alone = [load_results(folder).eval_returns[:, 7, -1] for folder in (UCB, PLAN)]
    assert cells[5:] == pytest.approx(np.concatenate(alone).tolist(), abs=1e-4)
    assert cells[:5] == pytest.approx(
        [7, load_results(UCB).optimal_returns[7], *(returns[f][7] for f in (UCB, PLAN, UCB))],
        abs=1e-4,
    )


def test_a_comparison_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    main(CompareConfig(runs=(UCB, PLAN)))
    row = rows_of(capsys.readouterr().out)[3]
    main(CompareConfig(runs=(UCB, PLAN), json=True))
    found = json.loads(capsys.readouterr().out)
    first, plan = found["runs"]
    assert (first["run"], first["method"], found["warnings"]) == (str(UCB), "ucb", [])
    assert "difference" not in first
    for cell, name in ((3, "difference"), (4, "improvement")):
        assert row[cell] == "{value:.3f} [{low:.3f}, {high:.3f}]".format(**plan[name])
    assert row[5] == "{better} / {equal} / {worse}".format(**plan["tasks"])


def test_other_budgets_are_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other"
    shutil.copytree(PLAN, other)
    path = other / "summary.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "num_episodes": 40}))
    main(CompareConfig(runs=(UCB, other), json=True))
    out, err = capsys.readouterr()
    told = f"the runs have different budgets of episodes: {UCB} 100, {other} 40"
    assert err == f"warning: {told}\n"
    assert json.loads(out)["warnings"] == [told]


def test_what_makes_it_unequal_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other"
    shutil.copytree(PLAN, other)
    path = other / "summary.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "policy_sha256": "0" * 64}))
    main(CompareConfig(runs=(UCB, other)))
    said = capsys.readouterr().err
    assert "warning: the runs have different weights" in said
    assert f"{other} 000000000000\n" in said


def test_only_hashes_are_cut() -> None:
    """Names of worlds are written out, since their first letters may be the same."""
    plan = load_results(PLAN)
    other = replace(plan, summary={**plan.summary, "env": "maze15-with-doors"})
    (said,) = differing([PLAN, UCB], [plan, other])
    assert said == f"the runs have different worlds: {PLAN} maze15, {UCB} maze15-with-doors"


def test_a_profile_is_the_share_of_scores_above_each_threshold() -> None:
    scores = np.array([[0.0, 1.0, 2.0, 2.0], [0.0, 1.0, 2.0, 4.0]])
    thresholds = np.array([-1.0, 0.0, 0.5, 2.0, 4.0, 5.0])
    profile = performance_profile(scores, thresholds)
    np.testing.assert_allclose(profile.share, [1, 1, 0.75, 0.5, 0.125, 0])
    assert profile.low is not None
    assert profile.high is not None
    assert np.all(profile.low <= profile.share)
    assert np.all(profile.share <= profile.high)
    # Only the seeds of the last task differ, so that only its score is uncertain.
    np.testing.assert_allclose((profile.high - profile.low)[:4], 0)
    assert performance_profile(scores[:1], thresholds).low is None


def test_profiles_are_drawn_by_regret_where_optima_are_known(tmp_path: Path) -> None:
    main(CompareConfig(runs=(UCB, PLAN), profile=tmp_path / "profile.png"))
    assert (tmp_path / "profile.png").read_bytes().startswith(b"\x89PNG")
    known, unknown = (
        performance_profiles({"ucb": load_results(RESULTS / world / "ucb")}).axes[0]
        for world in ("maze15", "crafter-map")
    )
    assert known.get_xlabel() == "regret of at most"
    assert unknown.get_xlabel() == "return of at least"
    line = known.get_lines()[0]
    last = float(line.get_ydata()[-1])  # at a regret of almost nothing
    solved = load_results(UCB).summary["solved_optimally"]
    assert last == pytest.approx(solved, abs=0.01)


@pytest.mark.parametrize("place", ["profile.jpg", "taken.png", "nowhere/profile.png"])
def test_profiles_are_pictures_of_their_own(tmp_path: Path, place: str) -> None:
    (tmp_path / "taken.png").write_text("mine")
    with pytest.raises(UsageError, match="--profile"):
        main(CompareConfig(runs=(UCB, PLAN), profile=tmp_path / place))
    assert (tmp_path / "taken.png").read_text() == "mine"


@pytest.mark.parametrize(
    ("runs", "says"),
    [
        ((), "needs two result folders or more, found none"),
        ((UCB,), "found .*ucb; usage"),
        ((UCB, RESULTS / "gridworld" / "ucb"), "of different tasks"),
    ],
)
def test_what_cannot_be_compared(runs: tuple[Path, ...], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        main(CompareConfig(runs=runs))
