"""Summaries and tables: what rows state, files that contradict each other, and no raw text from files."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_results import LUCKY, TINY, made_results
from test_architecture import call_without_jax

import envs.kitchen
from envs.errors import DataError, MissingExtraError, UsageError
from envs.registry import WORLDS
from examples import achieved, over_time
from experiments.store.paper import paper_final
from experiments.store.result_files import load_results, save_results
from experiments.store.results import Results
from experiments.store.rows import HEAD, STATED, Row, comparison, read_row
from experiments.store.seals import check_replaceable, is_sealed, sealed, write_sealed
from experiments.store.summary import read_summary, solvable_tasks, summarize
from experiments.store.summary_text import printed
from experiments.store.tables import block, shortened, table
from experiments.table import TableConfig, main

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results"
PUBLISHED = sorted(path.parent for path in RESULTS.rglob("summary.json"))
ONE_PUBLISHED = RESULTS / "maze15" / "ucb"
OTHER_SETTINGS = {  # of published results that the paper's number may not stand beside
    "gridworld/ucb-as-printed": "keep_rewarded=false",
    "ablations/gridworld/without-prior/ptgm": "kl=0",
    "ablations/kitchen/without-prior/ptgm": "kl=0",
    "ablations/maze15/without-prior/ptgm": "kl=0",
    "ablations/maze15/without-prior/ptgm-goal": "kl=0",
    "ablations/gridworld/without-prior/ptgm-goal": "kl=0",
    "ablations/gridworld/spirl-sampled": "judged_by=sample",
    "ablations/gridworld/ucb-5-goals": "max_goals=5",
    "ablations/maze15/behind-noise/plan-action": "action_noise=0.1",
    "ablations/maze15/behind-noise/plan-full": "num_states=48",
    "ablations/maze15/behind-noise/plan-obs": "obs_noise=0.02",
    "ablations/maze15/behind-noise/ucb-action": "action_noise=0.1",
    "ablations/maze15/behind-noise/ucb-obs": "obs_noise=0.02",
    "ablations/maze30/plan/without-frontiers": "frontier=false",
    "ablations/maze30/plan/without-rehearsal": "rehearse=0",
    "ablations/maze30/plan/without-splicing": "splice=false",
    "ablations/maze30/plan/without-steering": "steer=0",
    **{f"ablations/maze15/table4/K{k}": f"max_goals={k}" for k in (1, 2, 3)},
    "ablations/maze15/table4/c0": "max_goals=5, c=0, scale=1",
    "ablations/maze15/table4/c1": "max_goals=5, scale=1",
    "ablations/maze15/table4/c10": "max_goals=5, c=10, scale=1",
    **{
        f"ablations/maze15/paper-recipe/{m}": "policy=results/ablations/maze15/paper-recipe/policy"
        for m in ("ucb", "bpe", "explore", "grips", "bbt")
    },
}
KITCHEN = Path(__file__).parent / "data" / "results_of_format_1"


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """The world of the made results, under its name."""
    monkeypatch.setitem(WORLDS._registered, "tiny", TINY)


def summary_of(results: Results) -> dict[str, Any]:
    return summarize(
        results, policy_sha256="0" * 64, num_episodes=88, num_failed=0, cpu_seconds=2.0
    )


def saved(folder: Path, **changes: Any) -> Path:
    """Made results of the world ``tiny`` as a folder."""
    results = made_results(**changes)
    save_results(folder, replace(results, summary=summary_of(results)))
    return folder


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A copy of published results, to be changed."""
    shutil.copytree(ONE_PUBLISHED, tmp_path / "ucb")
    return tmp_path / "ucb"


@pytest.fixture
def with_parts(tmp_path: Path) -> Path:
    """Published results of Kitchen as this version writes them, with the numbers of parts."""
    folder = tmp_path / "kitchen"
    shutil.copytree(KITCHEN, folder)
    write_parts(folder, num_parts=(np.load(KITCHEN / "tasks.npz")["order"] >= 0).sum(axis=1))
    change(folder / "summary.json", part_shares=counted(KITCHEN))
    return folder


def write_parts(folder: Path, **arrays: np.ndarray) -> None:
    with np.load(folder / "results.npz") as file:
        kept = {name: array for name, array in file.items() if name != "num_parts"}
    np.savez(folder / "results.npz", **kept, **arrays)


def counted(folder: Path) -> list[list[float]]:
    """p_k of results of Kitchen, from their files."""
    order = np.load(folder / "tasks.npz")["order"]
    final = np.load(folder / "results.npz")["eval_returns"][:, :, -1]
    lengths = (order >= 0).sum(axis=1)
    searches = [(round(x * n), n) for row in final for x, n in zip(row, lengths, strict=True)]
    most = int(lengths.max())
    having = [[done >= k for done, n in searches if n >= k] for k in range(1, most + 1)]
    return [[sum(each) / len(each), len(each)] for each in having]


def change(path: Path, **changes: Any) -> None:
    document = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({k: v for k, v in document.items() if v is not ...}))


def cells(row: Row) -> dict[str, str]:
    head, _, line = comparison([row]).splitlines()
    parts = [re.split(r" (?<!\\)\| ", text[2:-2]) for text in (head, line)]
    return dict(zip(*parts, strict=True))


@pytest.mark.parametrize(
    "folder", PUBLISHED, ids=lambda folder: str(folder.relative_to(RESULTS)).replace("/", "-")
)
def test_published_results_have_rows(folder: Path) -> None:
    row = read_row(folder)
    public = folder.parent.name == "radt"  # the mazes of others
    assert row.tasks == ("own" if public else "test")
    found = cells(row)
    assert found["folder"] == str(folder)
    one_seed = row.summary["num_seeds"] == 1
    assert ("±" in found["final (mean ± std over seeds)"]) != one_seed
    assert ("[" in found["IQM [95 %]"]) != one_seed
    named = OTHER_SETTINGS.get(str(folder.relative_to(RESULTS)), "")
    differing = [text for text in found["settings"].split(", ") if text.split("=")[0] not in STATED]
    assert re.sub("policy=[0-9a-f]{12}", "policy=..", ", ".join(differing)) == named
    assert bool(named) == ("ablations" in folder.parts or folder.name == "ucb-as-printed")
    paper = paper_final(found["env"], found["method"])
    assert found["paper: final"] == ("" if named or public else paper)


def test_the_published_table_is_that_of_the_results(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    worlds = (
        "maze15", "maze30", "gridworld", "kitchen", "kitchen-stock", "kitchen-mjx", "radt",
        "crafter-symbolic", "crafter-map", "crafter",
    )  # fmt: skip
    methods = (
        "plan", "ucb", "bpe", "explore", "grips", "bbt", "ucb-seed1", "ucb-seed2",
        "reinforce", "reinforce-careful", "ppo", "ppo-careful",
        "ptgm", "ptgm-goal", "ptgm-ppo", "ptgm-random", "ptgm-prior", "ptgm-oracle",
        "spirl", "spirl-prior",
    )  # fmt: skip
    folders = [Path("results", world, method) for world in worlds for method in methods]
    main(TableConfig(runs=tuple(folder for folder in folders if folder.exists())))
    assert capsys.readouterr().out == Path("results/table.md").read_text()


def test_the_table_of_the_plan_is_that_of_the_results() -> None:
    """Of `docs/plan.md`: regret or return after some numbers of episodes, and the CPU time."""
    text = (ROOT / "docs" / "plan.md").read_text()
    (rows,) = re.findall(r"\| world \| method \| 10 \|.*\n\| ---.*\n((?:\|.*\n)+)", text)
    world, measure, num = "", "", 0
    for line in rows.splitlines():
        name, method, *numbers = (cell.strip(" *") for cell in line.strip("|").split("|"))
        if name:
            world, measure = name.split(", ")
        folder = RESULTS / {"RA-DT's mazes": "radt"}.get(world, world) / method.lower()
        results = load_results(folder)
        shown = [float(number) for number in numbers]
        after = np.searchsorted(results.eval_episodes, (10, 20, 40, 100))
        means = results.eval_returns[:, :, after].mean(axis=(0, 1))
        if measure == "regret":
            means = np.mean(results.optimal_returns) - means
        np.testing.assert_allclose(shown[:4], means, atol=0.00051)
        assert shown[4] == round(read_summary(folder)["cpu_seconds"])
        num += 1
    assert num == 12


def test_the_published_tables_over_time_are_those_of_the_results(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Each stands below the command that prints it."""
    text = (ROOT / "docs/results.md").read_text()
    shown = re.findall(r"    python -m examples.over_time ((?:.|\\\n)+?)\n\n((?:\|.*\n)+)", text)
    assert len(shown) == 5
    for words, wanted in shown:
        line = "echo " + words.replace("\\\n", " ")
        folders = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True)
        over_time.main([ROOT / folder for folder in folders.stdout.split()])
        assert capsys.readouterr().out == wanted


def test_the_published_table_of_achievements_is_that_of_the_results() -> None:
    """It stands below the command that prints it."""
    text = (ROOT / "docs/results.md").read_text()
    ((words, shown),) = re.findall(r"    python -m examples.achieved (.+)\n\n((?:\|.*\n)+)", text)
    assert achieved.achieved_table([ROOT / run for run in words.split()]) + "\n" == shown


def test_a_table_needs_no_jax(with_parts: Path) -> None:
    """Only results of an older version that may be made of parts have to ask their world."""
    lines = [f"table results/maze15/ucb results/gridworld/bpe {with_parts}"]
    assert call_without_jax(lines) == ["0|False|"]


@pytest.mark.parametrize("run", [RESULTS / "kitchen" / "ucb", KITCHEN], ids=["now", "format 1"])
def test_parts_of_older_results_are_counted(run: Path) -> None:
    """From the tasks and the returns of their single episodes."""
    pytest.importorskip("mujoco")
    row = read_row(run)
    shares = row.summary["part_shares"]
    assert shares is not None
    np.testing.assert_allclose(shares, counted(run))
    assert [num for _, num in shares] == [75, 75, 69, 57, 24]
    found = cells(row)
    assert list(found)[len(HEAD) :] == ["p1", "p2", "p3", "p4", "p5"]
    if run != KITCHEN:
        wanted = ["1.00 (75)", "1.00 (75)", "0.94 (69)", "0.81 (57)", "0.62 (24)"]
        assert list(found.values())[len(HEAD) :] == wanted


def test_older_results_of_several_episodes_have_no_parts(tmp_path: Path) -> None:
    """Neither by the world's record, nor by their settings."""
    assert read_row(RESULTS / "gridworld" / "ucb").summary["part_shares"] is None
    shutil.copytree(KITCHEN, tmp_path / "run")
    change(tmp_path / "run" / "config.json", eval_episodes=10)
    assert read_row(tmp_path / "run").summary["part_shares"] is None


def test_parts_are_unknown_where_an_older_world_is_not_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def missing() -> None:
        raise MissingExtraError("the kitchen needs mujoco")

    monkeypatch.setattr(envs.kitchen, "import_mujoco", missing)
    row = read_row(KITCHEN)
    assert row.summary["part_shares"] is None
    assert list(cells(row)) == list(HEAD)


def test_a_table_has_columns_of_parts_where_a_row_has_them(with_parts: Path) -> None:
    mazes, kitchen = read_row(ONE_PUBLISHED), read_row(with_parts)
    assert list(cells(mazes)) == [*HEAD, "success rate", "SPL"]
    lines = [line.split(" | ") for line in comparison([mazes, kitchen]).splitlines()]
    assert {len(line) for line in lines} == {len(HEAD) + 2 + 5}
    assert lines[0][-5:] == ["p1", "p2", "p3", "p4", "p5 |"]
    assert lines[2][-5:] == ["", "", "", "", " |"]
    assert lines[3][-5:] == ["1.00 (75)", "0.89 (75)", "0.77 (69)", "0.72 (57)", "0.50 (24) |"]


SHARES = counted(KITCHEN)
FALSE_SHARES = {
    "another share": [*SHARES[:4], [0.4, 24]],
    "another number": [*SHARES[:4], [SHARES[4][0], 25]],
    "one too few": SHARES[:4],
    "one too many": [*SHARES, [1.0, 3]],
    "unknown": None,
}


@pytest.mark.parametrize("name", FALSE_SHARES)
def test_parts_are_those_of_the_results(with_parts: Path, name: str) -> None:
    assert read_row(with_parts).summary["part_shares"] == [tuple(pair) for pair in SHARES]
    change(with_parts / "summary.json", part_shares=FALSE_SHARES[name])
    with pytest.raises(DataError, match=r"part_shares is .*, but results\.npz gives 1, 75, 0\.89"):
        read_row(with_parts)


def test_parts_need_single_episodes_and_their_numbers(with_parts: Path) -> None:
    says = r"part_shares is 1, 75, .*, but results\.npz gives unknown; adapt again"
    change(with_parts / "config.json", eval_episodes=10)
    with pytest.raises(DataError, match=says):
        read_row(with_parts)
    change(with_parts / "config.json", eval_episodes=1)
    assert read_row(with_parts).summary["part_shares"] is not None
    write_parts(with_parts)
    with pytest.raises(DataError, match=says):
        read_row(with_parts)


def test_parts_of_a_place_are_checked_where_they_are_told(with_parts: Path) -> None:
    """How often its policies are judged is unknown, since it is not imported."""
    for name in ("summary.json", "config.json"):
        change(with_parts / name, env="no_such_module:WORLD", method="ucb")
    assert cells(read_row(with_parts))["p5"] == "0.50 (24)"
    change(with_parts / "summary.json", part_shares=None)
    assert list(cells(read_row(with_parts))) == list(HEAD)
    change(with_parts / "summary.json", part_shares=SHARES[:3])
    with pytest.raises(DataError, match="part_shares is"):
        read_row(with_parts)


def test_a_policy_that_was_not_released_is_stated() -> None:
    row = read_row(KITCHEN)
    assert row.settings == {"policy": "2d3d3ab0106b"}
    assert cells(row)["paper: final"] == ""  # which is that of the released policy


@pytest.mark.parametrize(
    ("changes", "settings", "fair"),
    [
        ({}, {}, True),
        ({"seed": 4}, {"seed": "4"}, True),
        ({"policy": "runs/mine"}, {"policy": "runs/mine"}, False),
        ({"eval_episodes": 3}, {"eval_episodes": "3"}, False),
        ({"eval_every": 5}, {"eval_every": "5"}, True),
        ({"hyper": {"max_goals": None, "keep_rewarded": True, "c": 2.0}}, {"c": "2"}, False),
        ({"hyper": {"max_goals": 7, "c": 1}}, {"max_goals": "7"}, False),
        ({"policy": "x" * 300}, {"policy": "x" * 28 + "..." + "x" * 28}, False),
        ({"figures": False, "out": "elsewhere", "debug": True}, {}, True),
    ],
)
def test_settings_that_differ_from_the_defaults(
    copied: Path, changes: dict[str, Any], settings: dict[str, str], fair: bool
) -> None:
    change(copied / "config.json", **changes)
    row = read_row(copied)
    assert row.settings == settings
    assert row.like_the_paper == fair
    found = cells(row)
    assert found["settings"] == ", ".join(f"{name}={text}" for name, text in settings.items())
    assert (found["paper: final"] == "-0.41 ± 0.10") == fair


def test_test_tasks_are_known_by_what_they_are(copied: Path) -> None:
    """Whatever the settings say."""
    change(copied / "config.json", tasks="mine.npz", validation=False)
    assert read_row(copied).tasks == "test"
    with np.load(copied / "tasks.npz") as file:
        tasks = dict(file)
    tasks["goal"][3] = tasks["goal"][4]
    np.savez(copied / "tasks.npz", **tasks)
    row = read_row(copied)
    assert (row.tasks, cells(row)["paper: final"]) == ("own", "")
    change(copied / "config.json", tasks=None)
    assert read_row(copied).tasks == "own"
    change(copied / "config.json", validation=True)
    assert read_row(copied).tasks == "validation"


def test_tasks_of_a_world_without_released_ones(tmp_path: Path, tiny: None) -> None:
    folder = saved(tmp_path / "run")
    assert read_row(folder).tasks == "test"
    change(folder / "config.json", tasks="mine.npz")
    assert read_row(folder).tasks == "own"
    assert cells(read_row(folder))["tasks x seeds x episodes"] == "2 x 2 x 20"


def test_another_budget_is_not_the_papers(tmp_path: Path, copied: Path) -> None:
    row = read_row(copied)
    other = row._replace(summary={**row.summary, "num_episodes": 50})
    assert (cells(row)["paper: final"], cells(other)["paper: final"]) == ("-0.41 ± 0.10", "")


def test_a_place_is_shown_and_never_imported(copied: Path) -> None:
    """The module of the world does not exist, so that importing it would fail."""
    for name in ("summary.json", "config.json"):
        change(copied / name, env="no_such_module:WORLD", method="no_such_module:METHOD")
    row = read_row(copied)
    found = cells(row)
    assert (found["env"], found["method"]) == ("no_such_module:WORLD", "no_such_module:METHOD")
    assert row.settings == {"keep_rewarded": "true", "c": "1"}  # what the defaults are is unknown
    assert found["paper: final"] == ""


WRONG = {
    "a number is missing": ({"regret": ...}, "lacks regret"),
    "null": ({"final_return": None}, "final_return must be a number, found None"),
    "text": ({"initial_return": "-1.5"}, "initial_return must be a number, found '-1.5'"),
    "true": ({"final_return": True}, "final_return must be a number, found True"),
    "NaN": ({"regret": float("nan")}, "regret"),
    "infinity": ({"cpu_seconds": float("inf")}, "cpu_seconds"),
    "too much": ({"solved_optimally": 7.3}, "solved_optimally must be at most 1, found 7.3"),
    "too little": ({"num_seeds": 0}, "num_seeds must be at least 1, found 0"),
    "half an interval": ({"final_return_iqm_95": [1.0]}, r"final_return_iqm_95"),
    "a share above 1": ({"part_shares": [[1.5, 3]]}, "must be at most 1, found 1.5"),
    "half a share": ({"part_shares": [[0.5]]}, r"part_shares"),
    "a share of none": ({"part_shares": [[0.5, 0]]}, "must be at least 1, found 0"),
    "no shares": ({"part_shares": []}, "part_shares must have at least 1 entries"),
    "many shares": ({"part_shares": [[1.0, 3]] * 21}, "part_shares must have at most 20 entries"),
    "a list": ({"env": ["maze15"]}, r"env must be text, found \['maze15'\]"),
    "no world": ({"env": "maze51"}, "unknown world 'maze51'; did you mean 'maze15'"),
    "no method": ({"method": "ubc"}, "unknown method 'ubc'; did you mean 'ucb'"),
    "an escape": ({"env": "\x1b[31mmaze15"}, r"unknown world '\\x1b\[31mmaze15'"),
    "two lines": ({"env": "maze15\n"}, r"unknown world 'maze15\\n'"),
    "a cell": ({"env": "a | b"}, r"unknown world 'a \| b'"),
    "long": ({"env": "m" * 300}, "env"),
    "no hash": ({"policy_sha256": "abc"}, "policy_sha256"),
    "unknown": ({"speed": 3}, "has the unknown entry speed"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_numbers_are_named_with_the_way_out(copied: Path, name: str) -> None:
    changes, says = WRONG[name]
    change(copied / "summary.json", **changes)
    with pytest.raises(DataError, match=says) as error:
        read_summary(copied)
    text = str(error.value)
    assert str(copied / "summary.json") in text
    assert text.endswith("adapt again with `python -m experiments.adapt`")
    assert text.isprintable()


@pytest.mark.parametrize("content", ["[]", "3", "{", "null", '"a"', ""])
def test_what_is_no_summary_is_refused(copied: Path, content: str) -> None:
    (copied / "summary.json").write_text(content)
    with pytest.raises(
        DataError, match=r"summary\.json (is not readable JSON|does not hold a JSON)"
    ):
        read_summary(copied)
    (copied / "summary.json").unlink()
    with pytest.raises(DataError, match=r"summary\.json is missing; adapt again"):
        read_summary(copied)


CONTRADICTIONS = {
    "initial_return": 1e12,
    "final_return": -0.3,
    "final_return_std_over_seeds": 0.5,
    "final_return_iqm": 0.0,
    "final_return_iqm_95": [-1.0, 1.0],
    "num_tasks": 10**12,
    "num_seeds": 4,
    "num_episodes": 99,
    "regret": 0.0,
    "regret_after_40": 0.1,
    "regret_std_over_seeds": 0.0,
    "optimal_return": -0.205,
    "solved_optimally": 0.99,
    "unsolvable_tasks": 51,
    "best_episode_return": 0.9,
}


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_a_summary_of_other_results_is_refused(copied: Path, name: str) -> None:
    value = CONTRADICTIONS[name]
    change(copied / "summary.json", **{name: value})
    with pytest.raises(DataError, match=rf"summary\.json: {name} is .*, but results\.npz gives"):
        read_row(copied)


def test_an_optimum_is_that_of_the_results(copied: Path) -> None:
    """A regret that fits a false optimum is refused as well."""
    summary = read_summary(copied)
    assert summary["optimal_return"] is not None
    change(
        copied / "summary.json",
        optimal_return=summary["final_return"],
        regret=0.0,
        regret_after_40=0.0,
        solved_optimally=1.0,
    )
    with pytest.raises(DataError, match=r"optimal_return is .*, but results\.npz gives -0\.072"):
        read_row(copied)


def test_the_share_solved_allows_for_tasks_that_nobody_can_solve(copied: Path) -> None:
    share = read_summary(copied)["solved_optimally"]
    assert share == pytest.approx(0.73, abs=0.01)
    change(copied / "summary.json", unsolvable_tasks=2, solved_optimally=share - 0.04)
    assert cells(read_row(copied))["solved optimally"] == "69 % (2 tasks unsolvable)"
    change(copied / "summary.json", solved_optimally=share - 0.05)
    with pytest.raises(DataError, match=r"solved_optimally is 0\.6766"):
        read_row(copied)
    change(copied / "summary.json", unsolvable_tasks=40, solved_optimally=share)
    with pytest.raises(DataError, match=r"solved_optimally is .*, but results\.npz gives 0\.2"):
        read_row(copied)


def test_files_of_different_adaptations_are_refused(copied: Path) -> None:
    change(copied / "config.json", method="bpe")
    with pytest.raises(DataError, match=r"config\.json and summary\.json name different worlds or"):
        read_row(copied)


def test_optimum_and_solved_are_known_together(copied: Path) -> None:
    unknown = dict.fromkeys(
        ("optimal_return", "regret", "regret_after_40", "regret_std_over_seeds")
    )
    change(copied / "summary.json", **unknown)
    with pytest.raises(DataError, match=r"optimal_return is unknown, but results\.npz gives"):
        read_row(copied)
    with np.load(copied / "results.npz") as file:
        arrays = {name: array for name, array in file.items() if name != "optimal_returns"}
    np.savez(copied / "results.npz", **arrays)
    with pytest.raises(
        DataError, match=r"solved_optimally is 0\.7266.*, but results\.npz gives unknown"
    ):
        read_row(copied)
    change(copied / "summary.json", solved_optimally=None)
    assert cells(read_row(copied))["solved optimally"] == ""


def test_one_seed_prints_no_spread(tmp_path: Path, tiny: None) -> None:
    several = made_results()
    one = {name: getattr(several, name)[:1] for name in ("returns", "eval_returns", "actions")}
    parts = {name: array[:1] for name, array in several.choices.items()}
    folder = saved(tmp_path / "run", **one, choices=parts, best=parts, reached=None)
    summary = json.loads((folder / "summary.json").read_text())
    nothing = ("final_return_std_over_seeds", "final_return_iqm_95", "regret_std_over_seeds")
    assert [summary[name] for name in nothing] == [None] * 3
    for text in (printed(summary), comparison([read_row(folder)]).splitlines()[2]):
        assert "±" not in text
        assert not re.search(r"\[-?\d", text)
    # Older versions wrote a spread of 0 and an interval without a width.
    change(folder / "summary.json", **dict.fromkeys((nothing[0], nothing[2]), 0.0))
    change(folder / "summary.json", final_return_iqm_95=[0.0, 0.0])
    assert [read_summary(folder)[name] for name in nothing] == [None] * 3
    assert "±" not in comparison([read_row(folder)]).splitlines()[2]


def test_a_task_that_nobody_can_solve_never_counts_as_solved(tmp_path: Path, tiny: None) -> None:
    """The second goal is cut off: the worst return is then the best one, and no regret is left."""
    results = made_results()
    mazes = results.tasks["maze"].copy()
    mazes[1][4, 1] = mazes[1][5, 2] = 1
    evals = np.stack([results.eval_returns[:, 0], np.full((2, 2), -0.6)], axis=1)
    cut_off = made_results(
        tasks={**results.tasks, "maze": mazes},
        eval_returns=evals.astype(np.float32),
        optimal_returns=np.array([0.5, -0.6], np.float32),
    )
    assert solvable_tasks(cut_off).tolist() == [True, False]
    summary = summary_of(cut_off)
    assert (summary["solved_optimally"], summary["unsolvable_tasks"]) == (0, 1)
    assert "unsolvable tasks 1 of 2 (never within the horizon)" in printed(summary)
    save_results(tmp_path / "run", replace(cut_off, summary=summary))
    assert cells(read_row(tmp_path / "run"))["solved optimally"] == "0 % (1 tasks unsolvable)"
    solved = summary_of(made_results())
    assert solved["unsolvable_tasks"] == 0
    assert "unsolvable" not in printed(solved)


ACHIEVED = np.zeros((2, 2, 2, 2), np.float32)
ACHIEVED[:, :, 0, 0], ACHIEVED[:, 0, 1, 0], ACHIEVED[..., 1] = 0.25, 0.5, 1.0


@pytest.fixture
def lucky(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Results of a world that is judged by sampled actions and has names for its goals."""
    monkeypatch.setitem(WORLDS._registered, "tiny", LUCKY)
    return saved(tmp_path / "lucky", eval_achieved=ACHIEVED)


def test_worlds_judged_by_sampling_have_a_lucky_and_a_fresh_return(lucky: Path) -> None:
    summary = read_summary(lucky)
    fresh = summary["fresh"]
    assert (fresh["episodes"], summary["best_episode_return"]) == (4, -1.0)
    # Of the four searches, -3, -1, -2 and -2 at first, -1, 0, -1 and 1 in the end.
    assert fresh["gain"] == pytest.approx(1.75)
    low, high = fresh["gain_95"] or (0, 0)
    assert low == pytest.approx(1.5)
    assert high == pytest.approx(2.0)
    found = cells(read_row(lucky))
    assert found["best single episode"] == "-1.00"
    assert found["fresh"] == "-0.25 (4 sampled)"
    assert found["fresh - initial [95 % over tasks]"] == "1.750 [1.500, 2.000]"
    text = printed(summary)
    assert re.search(r"fresh +-0\.250 \(the final return, of 4 sampled episodes", text)
    assert re.search(r"minus initial +1\.750 \[1\.500, 2\.000\] \(95 % over tasks\)", text)
    change(lucky / "summary.json", fresh={**fresh, "gain": 3.0})
    with pytest.raises(DataError, match=r"gain is 3, but results\.npz gives 1\.75"):
        read_row(lucky)


def test_the_number_of_sampled_episodes_may_be_a_setting(lucky: Path) -> None:
    results = load_results(lucky)
    fewer = replace(results, config={**results.config, "eval_episodes": 2})
    assert summary_of(fewer)["fresh"]["episodes"] == 2


def test_named_goals_are_counted(lucky: Path) -> None:
    np.testing.assert_array_equal(load_results(lucky).eval_achieved, ACHIEVED)
    summary = read_summary(lucky)
    assert summary["achieved"] == {"down": (0.25, 0.25), "right": (1.0, 1.0)}
    found = cells(read_row(lucky))
    assert found["goals achieved"] == "62.5 %"
    assert found["score"] == f"{(26 * 101) ** 0.5 - 1:.2f}"
    text = printed(summary)
    assert re.search(
        r"score +50\.24 \(initially 50\.24; geometric mean over goals of 1 plus the perc", text
    )
    assert re.search(r"down +25\.0 % \(initially 25\.0 %\)", text)
    change(lucky / "summary.json", achieved={"down": [0.25, 0.3], "right": [1.0, 1.0]})
    says = r"achieved is 0\.25, 0\.3, 1, 1, but results\.npz gives 0\.25, 0\.25, 1, 1"
    with pytest.raises(DataError, match=says):
        read_row(lucky)
    change(lucky / "summary.json", achieved=...)
    with pytest.raises(DataError, match="achieved is unknown"):
        read_row(lucky)


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ({}, "achieved must have at least 1 entries"),
        ({"down": [0.5, 1.5]}, "achieved.down.1 must be at most 1, found 1.5"),
        ({"down": [0.5]}, "achieved.down"),
        ({"down": ["x", 0.5]}, "achieved.down.0 must be a number, found 'x'"),
        ([0.5], r"achieved must be an object, found \[0.5\]"),
    ],
)
def test_shares_that_are_none(lucky: Path, value: Any, says: str) -> None:
    change(lucky / "summary.json", achieved=value)
    with pytest.raises(DataError, match=says):
        read_summary(lucky)


def test_other_worlds_have_no_further_columns(tmp_path: Path, tiny: None) -> None:
    folder = saved(tmp_path / "plain")
    assert not {"fresh", "achieved"} & read_summary(folder).keys()
    assert "eval_achieved" not in np.load(folder / "results.npz")
    assert list(cells(read_row(folder))) == list(HEAD)


def test_the_defaults_of_a_method_are_those_of_the_world(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    own = replace(TINY, method_defaults={"ucb": {"scale": 3.0}})
    monkeypatch.setitem(WORLDS._registered, "tiny", own)
    folder = saved(tmp_path / "own")
    for scale, shown in ((3.0, {}), (1.0, {"scale": "1"})):
        config = {"env": "tiny", "method": "ucb", "hyper": {"c": 1.0, "scale": scale}}
        (folder / "config.json").write_text(json.dumps(config))
        assert {k: v for k, v in read_row(folder).settings.items() if k != "policy"} == shown


def test_cells_stay_cells() -> None:
    rows = [["a|b", "two\nlines", "\x1b[31mred", "x\u202ey"]]
    text = table(["w", "x", "y", "z"], rows)
    assert text.splitlines()[2] == r"| a\|b | two\nlines | \x1b[31mred | x\u202ey |"
    plain = table(["w", "x", "y", "z"], rows, markdown=False)
    assert plain.splitlines()[1] == r"a|b two\nlines \x1b[31mred x\u202ey"
    assert block("a\nb", [("c\r", "d")]).splitlines() == [r"a\nb", "----", r"c\r d"]
    assert shortened("a" * 60) == "a" * 60
    assert shortened("a" * 30 + "b" * 31) == "a" * 28 + "..." + "b" * 28


def test_folders_are_escaped(tmp_path: Path) -> None:
    folder = tmp_path / "a|b\nc\x1b[31m"
    shutil.copytree(ONE_PUBLISHED, folder)
    text = comparison([read_row(folder)])
    assert len(text.splitlines()) == 3
    assert r"a\|b\nc\x1b[31m" in text
    assert len(re.findall(r"(?<!\\)\|", text.splitlines()[2])) == len(HEAD) + 2 + 1


@pytest.mark.parametrize("suffix", [".md", ".png", ".gif"])
def test_only_what_was_written_by_a_command_is_replaced(tmp_path: Path, suffix: str) -> None:
    path, content = tmp_path / f"made{suffix}", bytes(range(256)) * 2
    check_replaceable([path])
    write_sealed(path, lambda place: place.write_bytes(content))
    assert path.read_bytes() == sealed(content, suffix)
    check_replaceable([path])
    write_sealed(path, lambda place: place.write_bytes(content + content))
    assert is_sealed(path.read_bytes(), suffix)
    whole = path.read_bytes()
    for changed in (content, whole[:-1], whole[1:], whole + b"\n", b"x" + whole[1:], b""):
        path.write_bytes(changed)
        with pytest.raises(
            UsageError, match=r"would be overwritten, but .*move it away, or call mom"
        ):
            check_replaceable([path], "call mom")
        assert path.read_bytes() == changed
    path.unlink()
    path.symlink_to(tmp_path / "nowhere")
    with pytest.raises(UsageError, match="would be overwritten"):
        check_replaceable([path])
    assert [other.name for other in tmp_path.iterdir()] == [path.name]
