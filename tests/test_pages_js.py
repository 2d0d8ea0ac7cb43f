"""The pages' JavaScript against JAX, in node and Chromium: rules, logits, greedy paths and searches."""

from __future__ import annotations

import html as markup
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pages_js import Greedy, differences, needs_node, played, run_js, searches

import envs
from envs.registry import World
from experiments.pages.build import SCRIPTS, html, script_of
from experiments.pages.packing import unpacked
from experiments.pages.playground import world_data
from experiments.pages.report import report_data
from experiments.pages.worlds import page_of
from experiments.store.result_files import load_results
from experiments.store.rows import read_row
from mgpo_jax.policy_files import load_policy

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
    """XLA may multiply by 1 / side where the page divides: goals are equal but for their last bit."""
    data, outcomes = searches(world, which, num_episodes)
    for found, wanted in zip(run_js(world, data)["searches"], outcomes, strict=True):
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


@pytest.mark.skipif(BROWSER is None, reason="no Chromium on the PATH")
def test_a_browser_finds_the_same_as_jax(grid: Greedy, tmp_path: Path) -> None:
    """Under the page's own security policy, from a file."""
    script = page_of(envs.find("gridworld")).script
    (tmp_path / "page.html").write_text(
        html("<main></main>\n", script_of(SCRIPTS / "parity.js", [script]), grid.data)
    )
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=60000",
        "--dump-dom",
    ]
    command = [
        str(BROWSER),
        *flags,
        f"--user-data-dir={tmp_path}/profile",
        (tmp_path / "page.html").as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    result = re.search(r'<pre id="result">(.*?)</pre>', done.stdout, re.S)
    assert result, done.stderr
    check_parity(grid, json.loads(markup.unescape(result[1])))
