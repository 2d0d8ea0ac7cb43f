"""The pages' JavaScript against JAX, in node and Chromium: rules, logits, greedy paths and searches."""

from __future__ import annotations

import html as markup
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from pages_js import Greedy, differences, in_node, needs_node, played, run_js, searches

import envs
from envs.registry import World
from experiments.pages.build import SCRIPTS, html, script_of
from experiments.pages.packing import unpacked
from experiments.pages.playground import world_data
from experiments.pages.report import report_data
from experiments.pages.worlds import page_of, tasks_in_page
from experiments.store.result_files import load_results
from experiments.store.rows import read_row
from mgpo_jax.policy_files import load_policy
from mgpo_jax.tasks import test_tasks as released_tasks

ROOT = Path(__file__).parents[1]
TOLERANCE = 1e-4  # of logits; both sides have the same weights in half precision
BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


@pytest.fixture(scope="module")
def maze() -> Greedy:
    return played(envs.find("maze15"), num=5, prompts=2)


@pytest.fixture(scope="module")
def grid() -> Greedy:
    return played(envs.find("gridworld"), num=3, prompts=1)


def check_parity(greedy: Greedy, found: Any) -> None:
    largest, same = differences(greedy, found)
    assert largest.max() < TOLERANCE
    assert all(same)
    assert [case["return_"] for case in found["cases"]] == greedy.episodes.return_.tolist()
    assert all(case["done"] for case in found["cases"])


@needs_node
def test_logits_paths_and_returns_of_mazes_are_those_of_jax(maze: Greedy) -> None:
    check_parity(maze, run_js(envs.find("maze15"), maze.data))


@needs_node
def test_logits_paths_and_returns_of_gridworld_are_those_of_jax(grid: Greedy) -> None:
    check_parity(grid, run_js(envs.find("gridworld"), grid.data))


@needs_node
@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("const EPSILON = 1e-6", "const EPSILON = 1e-5"),
        ("this.network.max_prompt_length - goals.length", "0"),
        ("this.time, this.numSteps++)", "this.time, ++this.numSteps)"),
        ("sum / Math.sqrt(size)", "sum / Math.sqrt(width)"),
        ("Math.max(value, 0)", "(value > 0 ? value : 0.01 * value)"),
    ],
    ids=["epsilon", "alignment", "time", "heads", "activation"],
)
def test_errors_in_the_decoder_are_found(maze: Greedy, right: str, wrong: str) -> None:
    def change(source: str) -> str:
        assert source.count(right) == 1
        return source.replace(right, wrong)

    largest, _ = differences(maze, run_js(envs.find("maze15"), maze.data, change))
    assert not largest.max() < TOLERANCE


@pytest.mark.slow
@needs_node
@pytest.mark.parametrize(
    ("name", "num", "prompts"), [("maze15", 50, 3), ("gridworld", 50, 3), ("maze30", 12, 1)]
)
def test_many_whole_episodes_are_those_of_jax(name: str, num: int, prompts: int) -> None:
    world = envs.find(name)
    greedy = played(world, num, prompts)
    found = run_js(world, greedy.data)
    largest, same = differences(greedy, found)
    steps = int(greedy.episodes.trajectory.length.sum())
    print(
        f"{name}: {len(same)} episodes, {steps} steps, {largest.max():.1e}, {sum(same)} same paths"
    )
    check_parity(greedy, found)


def check_searches(world: World, which: list[int], num_episodes: int) -> None:
    data, outcomes = searches(world, which, num_episodes)
    compare_searches(run_js(world, data)["searches"], outcomes)


def compare_searches(results: Any, outcomes: list[Any]) -> None:
    """XLA may multiply by 1 / side where the page divides: goals are equal but for their last bit."""
    for found, wanted in zip(results, outcomes, strict=True):
        for ours, theirs in zip(found["episodes"], wanted["episodes"], strict=True):
            np.testing.assert_allclose(ours["goals"], theirs["goals"], atol=1e-6)
            assert ours["actions"] == theirs["actions"]
            assert ours["return_"] == theirs["return_"]
        np.testing.assert_allclose(found["best"], wanted["best"], atol=1e-6)


@pytest.mark.slow
@needs_node
def test_a_search_in_mazes_is_that_of_jax() -> None:
    check_searches(envs.find("maze15"), [3], 24)


@needs_node
def test_a_search_in_gridworld_is_that_of_jax() -> None:
    """It has chance, and keeps rewarded goals."""
    check_searches(envs.find("gridworld"), [1], 12)


@pytest.fixture(scope="module")
def maze_search() -> tuple[dict[str, Any], list[Any]]:
    """Searches of a few episodes on three mazes, in which several arms compete."""
    return searches(envs.find("maze15"), [3, 0, 7], 16)


@needs_node
def test_a_short_search_in_mazes_is_that_of_jax(maze_search: Any) -> None:
    data, outcomes = maze_search
    compare_searches(run_js(envs.find("maze15"), data)["searches"], outcomes)


@needs_node
@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("Math.log(total)) / (2 * pulls)", "Math.log(total)) / 2"),
        ("acts = this.numTold % 2 === 1;", "acts = this.numTold % 3 === 1;"),
        ("if (return_ >= this.bestEpisode.return_)", "if (return_ < this.bestEpisode.return_)"),
        ("place(a) - place(b)", "place(b) - place(a)"),
    ],
    ids=["bound", "turns", "best episode", "order"],
)
def test_errors_in_the_search_are_found(maze_search: Any, right: str, wrong: str) -> None:
    def change(source: str) -> str:
        assert source.count(right) == 1
        return source.replace(right, wrong)

    data, outcomes = maze_search
    with pytest.raises((AssertionError, KeyError)):
        compare_searches(run_js(envs.find("maze15"), data, change)["searches"], outcomes)


@pytest.mark.slow
@needs_node
def test_a_search_in_large_mazes_is_that_of_jax() -> None:
    check_searches(envs.find("maze30"), [2], 4)


@needs_node
@pytest.mark.parametrize("name", ["maze15", "maze30", "gridworld"])
def test_the_optimum_of_a_page_is_that_of_the_world(name: str) -> None:
    """On all test tasks."""
    world = envs.find(name)
    page, tasks = page_of(world), released_tasks(world)
    best = np.asarray(jax.jit(jax.vmap(world.make().optimal_return))(tasks))
    assert page.script is not None
    given = {"facts": page.facts, "tasks": [row["task"] for row in tasks_in_page(page, tasks)]}
    body = "return data.tasks.map((task) => page.world.optimum(data.facts, task));"
    found = in_node({"page": page.script}, body, given)
    np.testing.assert_allclose(found, best, atol=1e-5)
    assert len(set(found)) > 1 or name == "gridworld"


RANDOM = """
let state = 7; // of a generator by Marsaglia, so that every run of the test has the same tasks
const random = () => {
  state ^= state << 13;
  state ^= state >>> 17;
  state ^= state << 5;
  return (state >>> 0) / 2 ** 32;
};
const tasks = Array.from({ length: data.num }, () => page.world.sampleTask(data.facts, random));
return tasks.map((task) => ({ task, optimum: page.world.optimum(data.facts, task) }));
"""


def sampled_tasks(name: str, num: int) -> tuple[dict[str, Any], list[Any]]:
    page = page_of(envs.find(name))
    assert page.script is not None
    facts = dict(page.facts)
    return facts, in_node({"page": page.script}, RANDOM, {"facts": facts, "num": num})


@needs_node
@pytest.mark.parametrize(("name", "num"), [("maze15", 200), ("maze30", 20)])
def test_random_mazes_of_a_page_have_the_right_size_and_can_be_solved(name: str, num: int) -> None:
    """Walls surround them, and the target is another free cell, within reach of the start."""
    facts, found = sampled_tasks(name, num)
    side, start = facts["side"], tuple(facts["start"])
    for row in found:
        rows, goal = row["task"]["rows"], tuple(row["task"]["goal"])
        assert [len(line) for line in rows] == [side] * side
        assert set("".join(rows)) == {"#", "."}
        assert {rows[0], rows[-1]} == {"#" * side}
        assert all(line[0] == line[-1] == "#" for line in rows)
        assert rows[start[0]][start[1]] == rows[goal[0]][goal[1]] == "."
        assert goal != start
        steps = shortest(rows, start, goal)
        assert 0 < steps <= facts["horizon"]
        wanted = facts["goalReward"] - facts["stepPenalty"] * steps
        assert row["optimum"] == pytest.approx(wanted, abs=1e-6)
    assert len({tuple(row["task"]["rows"]) for row in found}) == num


def shortest(rows: list[str], start: tuple[int, int], goal: tuple[int, int]) -> int:
    """The number of steps between two cells of a maze by breadth-first search, or -1."""
    layer, seen, steps = {start}, {start}, 0
    while layer and goal not in layer:
        around = {(r + d, c + e) for r, c in layer for d, e in ((0, 1), (1, 0), (0, -1), (-1, 0))}
        layer = {(r, c) for r, c in around if rows[r][c] == "."} - seen
        seen, steps = seen | layer, steps + 1
    return steps if layer else -1


@needs_node
def test_random_orders_of_a_page_have_distinct_objects_and_every_length() -> None:
    facts, found = sampled_tasks("gridworld", 300)
    orders = [row["task"] for row in found]
    num = len(facts["objects"])
    assert all(len(set(order)) == len(order) for order in orders)
    assert {len(order) for order in orders} == set(range(facts["fewest"], num + 1))
    assert {order[0] for order in orders} == set(range(num))


@pytest.mark.slow
@needs_node
@pytest.mark.parametrize("name", ["maze15", "gridworld"])
def test_whole_searches_are_those_of_jax(name: str) -> None:
    check_searches(envs.find(name), [0, 7, 19], 100)


@needs_node
@pytest.mark.parametrize("folder", ["maze15/ucb", "gridworld/ucb", "maze30/explore"])
def test_the_rules_play_saved_actions_to_the_saved_returns(folder: str) -> None:
    """All episodes of some tasks of published results."""
    place = ROOT / "results" / folder
    results = load_results(place)
    data = report_data({place: results}, [read_row(place)])
    arrays = unpacked(data["runs"][0]["arrays"])
    ends = np.cumsum(arrays["lengths"].ravel())
    replays, returns = [], []
    for place_ in list(np.ndindex(*arrays["lengths"].shape))[:: 7 if "30" in folder else 3]:
        at = np.ravel_multi_index(place_, arrays["lengths"].shape)
        start, end = ends[at] - arrays["lengths"].ravel()[at], ends[at]
        replays.append(
            {
                "task": data["tasks"][place_[1]]["task"],
                "start": arrays["starts"][place_].tolist() if "starts" in arrays else None,
                "actions": arrays["actions"][start:end].tolist(),
            }
        )
        returns.append(float(results.returns[place_]))
    world = results.world
    given = {"worlds": [world_data(world, load_policy(world))], "replays": replays}
    found = run_js(world, given)["replays"]
    assert [row["return_"] for row in found] == returns
    assert all(row["done"] for row in found)


def found_in_browser(world: World, data: dict[str, Any], folder: Path) -> Any:
    """The result of ``check`` in Chromium, under the page's own security policy, from a file."""
    script = page_of(world).script
    page = html("<main></main>\n", script_of(SCRIPTS / "parity.js", [script]), data)
    (folder / "page.html").write_text(page)
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=60000",
        "--dump-dom",
    ]
    profile = f"--user-data-dir={folder}/profile"
    command = [str(BROWSER), *flags, profile, (folder / "page.html").as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    result = re.search(r'<pre id="result">(.*?)</pre>', done.stdout, re.S)
    assert result, done.stderr
    return json.loads(markup.unescape(result[1]))


@pytest.mark.skipif(BROWSER is None, reason="no Chromium on the PATH")
def test_a_browser_finds_the_same_as_jax_in_gridworld(grid: Greedy, tmp_path: Path) -> None:
    check_parity(grid, found_in_browser(envs.find("gridworld"), grid.data, tmp_path))


@pytest.mark.skipif(BROWSER is None, reason="no Chromium on the PATH")
def test_a_browser_finds_the_same_as_jax_in_mazes(
    maze: Greedy, maze_search: Any, tmp_path: Path
) -> None:
    """Logits, paths and returns, and a search."""
    data, outcomes = maze_search
    found = found_in_browser(envs.find("maze15"), {**maze.data, **data}, tmp_path)
    check_parity(maze, found)
    compare_searches(found["searches"], outcomes)
