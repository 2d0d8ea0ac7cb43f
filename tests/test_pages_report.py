"""The report under node, with a document that has no layout: addresses, timelines, arms and tasks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pages_js import in_node, needs_node

from experiments.pages.build import SCRIPTS
from experiments.pages.colors import run_colors
from experiments.pages.packing import packed

ROOT = Path(__file__).parents[1]
MODULES = {
    name: SCRIPTS / f"{name}.js" for name in ("report", "address", "timeline", "log", "pace")
}
NUM = 9  # episodes of the runs below


def run_data(label: str, color: str, final: list[float], **arrays: np.ndarray) -> dict[str, Any]:
    """A run of one seed on some tasks, which begins at 0 in each and ends at a return."""
    shape = (1, len(final), NUM)
    found = {
        "returns": np.tile(np.arange(NUM, dtype=np.float32), (1, len(final), 1)),
        "evalEpisodes": np.array([1, NUM], np.uint32),
        "evalReturns": np.array([[[0, value] for value in final]], np.float32),
        "goals": np.array([[1, 0], [0, 1]], np.float32),
    }
    assert found["returns"].shape == shape
    (colors,) = run_colors([color])
    return {
        "label": label, "colors": colors, "facts": [["method", label]], "comparison": "", "note": "",
        "arrays": packed(found | arrays),
    }  # fmt: skip


def prompts(num_tasks: int) -> dict[str, np.ndarray]:
    """The same prompt in every episode: the first goal, then the second."""
    shape = (1, num_tasks, NUM)
    choice = np.ones(shape, np.uint8)
    choice[0, 0, 0] = 0  # the first appearance
    return {
        "prompts": np.array([[1, 2]], np.uint8),
        "choice": choice,
        "best": np.zeros(shape, np.uint8),
        "greedy": np.ones(shape, np.uint8),
    }


def report_of(*runs: dict[str, Any], optimum: list[float] | None = None) -> dict[str, Any]:
    num = len(optimum or (1, 2))
    return {
        "world": {"name": "tiny", "summary": "", "facts": {}, "parts": ["left", "right"]},
        "tasks": [{"task": None, "text": ""}] * num,
        "optimum": optimum,
        "withEpisodes": True,
        "notes": [],
        "runs": list(runs),
    }


def in_report(data: dict[str, Any], body: str) -> Any:
    begin = """
    const texts = (id) => $(id).children.map((child) => child.textContent);
    const key = (key) => document.fire("keydown", { key, target: { matches: () => false } });
    """
    return in_node(MODULES, begin + body, data, with_document=True)


@needs_node
def test_an_address_without_a_run_is_of_the_first_run() -> None:
    found = in_report({}, """
    const here = { run: 2, task: 1, seed: 1, episode: 6 };
    return ["", "#3,1,58", "#3,1,58,1", "#4", "#<b>,1"].map((hash) => address.placeOf(hash, here))
      .concat([address.addressOf(here), address.addressOf({ ...here, run: 0 })]);
    """)  # fmt: skip
    assert found == [
        {"run": 2, "task": 1, "seed": 1, "episode": 6},
        {"run": 0, "task": 3, "seed": 1, "episode": 57},
        {"run": 1, "task": 3, "seed": 1, "episode": 57},
        {"run": 0, "task": 4, "seed": 0, "episode": 6},
        {"run": 0, "task": 0, "seed": 1, "episode": 6},
        "#1,1,7,2", "#1,1,7",
    ]  # fmt: skip


@needs_node
@pytest.mark.parametrize("optimum", [None, [1.0, 2.25]])
def test_the_line_of_the_optimum_is_named_where_there_is_one(optimum: list[float] | None) -> None:
    data = report_of(run_data("one", "#0072b2", [1, 2]), optimum=optimum)
    said = in_report(data, """await report.main([null], data); return $("returns").textContent;""")
    assert ("Dashed line: optimum. Click" in said) == (optimum is not None)
    assert "Large: this episode. " in said


@needs_node
def test_a_browser_that_refuses_new_addresses_stops_nothing() -> None:
    """Safari and Firefox throw after some calls. They are not called for each of many quick steps."""
    data = report_of(run_data("one", "#0072b2", [1, 2]))
    titles, calls = in_report(data, """
    let calls = 0;
    history.replaceState = () => {
      calls++;
      throw new Error("SecurityError");
    };
    await report.main([null], data);
    const titles = [];
    for (let i = 0; i < 5; i++) {
      key("ArrowLeft");
      titles.push($("stage-title").textContent);
    }
    await later(500);
    key("ArrowLeft");
    titles.push($("stage-title").textContent);
    return [titles, calls];
    """)  # fmt: skip
    assert titles == [f"Task 0, seed 0, episode {NUM - 1 - i}" for i in range(6)]
    assert calls == 1


@needs_node
def test_a_run_without_prompts_shows_none() -> None:
    """Not those of the run that was shown before."""
    data = report_of(
        run_data("one", "#0072b2", [1, 2], **prompts(2)), run_data("two", "#d55e00", [1, 2])
    )
    found = in_report(data, """
    await report.main([null], data);
    const first = texts("chips");
    $("run").value = "1";
    $("run").fire("change");
    return [first, texts("chips"), texts("best"), $("kind").textContent];
    """)  # fmt: skip
    assert found == [["1left", "2right"], ["none"], ["none"], "two"]


@needs_node
@pytest.mark.parametrize(
    ("order", "shown", "values"),
    [
        (0, "the mean return at the end", ["0: 0.50", "1: 2.00"]),
        (1, "the gain in mean return", ["1: 2.00", "0: 0.50"]),
        (2, "the regret of the mean return at the end", ["0: 0.50", "1: 0.25"]),
        (3, "by how much two ended higher", ["0: 1.00", "1: -1.00"]),
    ],
)
def test_tasks_show_what_they_are_sorted_by(order: int, shown: str, values: list[str]) -> None:
    one = run_data("one", "#0072b2", [0.5, 2.0])
    data = report_of(one, run_data("two", "#d55e00", [1.5, 1.0]), optimum=[1.0, 2.25])
    found = in_report(data, f"""
    await report.main([null], data);
    $("sort").selectedIndex = {order};
    $("sort").fire("change");
    return [texts("tasks"), $("tasks-note").textContent];
    """)  # fmt: skip
    assert found[0] == values
    assert found[1].startswith(f"Below each task: its number and {shown}.")


@needs_node
def test_a_timeline_has_a_row_for_each_part_wherever_it_was_reached() -> None:
    """Goals of Crafter with places: named parts, whether the place is known, and where it is."""
    parts = [f"part {i}" for i in range(22)]
    goals = [[float(i == part) for i in range(22)] + [1, part / 8, 0.5] for part in range(22)]
    goals.append([1.0] * 22 + [0, 0, 0])
    goals.append([0.0] * 22 + [1, 2, 3])
    found = in_report({"parts": parts, "goals": goals}, """
    const reached = data.goals.map((goal, step) => ({ step, goal: Float32Array.from(goal) }));
    return timeline.timelineRows(data.parts, reached, (goal) => `at ${goal[23]}`);
    """)  # fmt: skip
    assert found == {"names": [*parts, "all", "at 2"], "rows": list(range(24))}


@needs_node
def test_marks_of_a_timeline_stay_on_it_however_many_goals_there_are() -> None:
    found = in_report({}, """
    const reached = Array.from({ length: 60 }, (_, step) => ({ step, goal: Float32Array.of(step) }));
    return timeline.timelineRows([], reached, (goal) => `goal ${goal[0]}`);
    """)  # fmt: skip
    assert len(found["names"]) == 40
    assert found["names"][-1] == "other goals"
    assert found["rows"] == [min(row, 39) for row in range(60)]


@needs_node
def test_a_table_of_arms_has_the_returns_of_its_episodes() -> None:
    """Three arms, of which the first acts twice and is then replaced; 255 stands for no arm."""
    rows = [0, 0, 1, 255, 0, 1, 0, 2, 255]
    pulls = [1, 2, 1, 9, 3, 2, 1, 1, 9]
    arms = {
        "arm": np.array(rows, np.uint8).reshape(1, 1, NUM),
        "pulls": np.array(pulls, np.uint8).reshape(1, 1, NUM),
    }
    own = {**prompts(1), "choice": np.zeros((1, 1, NUM), np.uint8)}  # each episode has its own
    own["prompts"] = np.tile(np.array([[1, 2]], np.uint8), (NUM, 1))
    own["prompts"][6] = [0, 2]  # the prompt that replaces the first arm
    data = run_data("one", "#0072b2", [1.0], **own, **arms)
    found = in_report(data, """
    const of = await log.Log.of(data);
    const say = ({ goals, pulls, mean, isNew, isChanged }) => [goals.length, pulls, mean, isNew, isChanged];
    return [0, 3, 5, 6, 8].map((episode) => of.arms(0, 0, episode).map(say));
    """)  # fmt: skip
    assert found == [
        [[2, 1, 0, True, True]],
        [[2, 2, 0.5, False, False], [2, 1, 2, False, False]],
        [[2, 3, 5 / 3, False, False], [2, 2, 3.5, False, True]],
        [[1, 1, 6, True, True], [2, 2, 3.5, False, False]],
        [[1, 1, 6, False, False], [2, 2, 3.5, False, False], [2, 1, 7, False, False]],
    ]
