"""What a plan knew, as a report shows it: recomputed from recorded episodes, and checked independently."""

from __future__ import annotations

import itertools
import json
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_results import ENV, made_results
from pages_js import NODE, needs_node

import experiments.store.results as store
from envs.errors import DataError
from envs.registry import WORLDS, World
from envs.specs import EnvSpec
from envs.wrappers import Wrapper
from experiments.pages.build import SCRIPTS, Bundle, as_text
from experiments.pages.packing import packed
from experiments.pages.plans import plan_of
from experiments.store.result_files import load_results
from experiments.store.results import Results
from mgpo_jax.outcomes import Reached

ROOT = Path(__file__).parents[1]
PLAN = {"rehearse": 0, "steer": 0}


def few(results: Results, num: int) -> Results:
    """The same with the first tasks alone."""
    cut = lambda part: None if part is None else part[:, :num]  # noqa: E731
    reached = None
    if results.reached is not None:
        counts = results.reached.counts
        kept = np.repeat(np.arange(counts.shape[1]) < num, counts.shape[2])
        kept = np.repeat(np.tile(kept, counts.shape[0]), counts.ravel())
        reached = Reached(counts[:, :num], results.reached.steps[kept], results.reached.goals[kept])
    return store.Results(
        config=results.config,
        tasks={name: array[:num] for name, array in results.tasks.items()},
        returns=results.returns[:, :num],
        choices={name: array[:, :num] for name, array in results.choices.items()},
        best={name: array[:, :num] for name, array in results.best.items()},
        eval_episodes=results.eval_episodes,
        eval_returns=results.eval_returns[:, :num],
        optimal_returns=results.optimal_returns[:num],
        lengths=cut(results.lengths),
        keys=cut(results.keys),
        actions=cut(results.actions),
        reached=reached,
    )


@pytest.fixture(scope="module")
def maze() -> tuple[Results, dict[str, np.ndarray]]:
    results = few(load_results(ROOT / "results/maze15/plan"), 2)
    return results, plan_of(results)


@pytest.fixture(scope="module")
def grid() -> tuple[Results, dict[str, np.ndarray]]:
    results = few(load_results(ROOT / "results/gridworld/plan"), 3)
    return results, plan_of(results)


def cells(arrays: dict[str, np.ndarray], place: tuple[int, int]) -> np.ndarray:
    """The goals that one search found, as cells of a maze of side 15."""
    places = arrays["known"][place]
    return np.rint(arrays["knownGoals"][places[places > 0] - 1] * 15).astype(int)


def ways_of(arrays: dict[str, np.ndarray]) -> dict[tuple[int, int, int], np.ndarray]:
    """The shortest known way after every episode, as states."""
    found, at, counts = {}, 0, arrays["wayCounts"].astype(int)
    for place in np.ndindex(*counts.shape):
        if counts[place]:
            found[place] = arrays["ways"][at : at + counts[place] - 1]
            at += counts[place] - 1
        else:
            found[place] = found[(*place[:2], place[2] - 1)] if place[2] else arrays["ways"][:0]
    assert at == len(arrays["ways"])
    return found


def test_a_map_has_the_visits_that_are_on_record(maze: Any) -> None:
    results, arrays = maze
    for place in np.ndindex(3, 2, 100):
        _, goals = results.reached_in(*place)
        walked = np.rint(goals * 15).astype(int).tolist()
        walked.append([13, 7])  # where an episode starts
        counts = [walked.count(cell) for cell in cells(arrays, place[:2]).tolist()]
        found = arrays["visits"][place]
        assert found[: len(counts)].tolist() == counts
        assert sum(counts) == found.sum() == len(walked)


def test_a_way_is_a_shortest_one_of_those_that_episodes_took(maze: Any) -> None:
    """Breadth-first search over the moves on record."""
    results, arrays = maze
    ways = ways_of(arrays)
    for seed, task in np.ndindex(3, 2):
        states = cells(arrays, (seed, task)).tolist()
        moves: dict[tuple[int, ...], set[tuple[int, ...]]] = {}
        goal = tuple(np.rint(results.task_goals[task] * 15).astype(int).tolist())
        for episode in range(100):
            _, goals = results.reached_in(seed, task, episode)
            walked = [(13, 7), *map(tuple, np.rint(goals * 15).astype(int).tolist())]
            for before, after in itertools.pairwise(walked):
                moves.setdefault(before, set()).add(after)
            layer, seen, steps = {(13, 7)}, {(13, 7)}, 0
            while layer and goal not in layer:
                layer = {cell for one in layer for cell in moves.get(one, ())} - seen
                seen, steps = seen | layer, steps + 1
            way = [(13, 7), *(tuple(states[state]) for state in ways[seed, task, episode])]
            assert len(way) - 1 == (steps if layer else 0)
            assert all(after in moves[before] for before, after in itertools.pairwise(way))
            verified = arrays["verified"][seed, task, episode]
            assert verified == 0 or verified >= len(way) - 1 > 0


def test_an_order_is_confirmed_from_its_start_and_its_next_goal_is_never_ruled_out(
    grid: Any,
) -> None:
    results, arrays = grid
    for seed, task, episode in np.ndindex(3, 3, 100):
        places = arrays["known"][seed, task]
        goals = arrays["knownGoals"][places[places > 0] - 1].argmax(axis=1)
        order = [int(thing) for thing in results.tasks["order"][task] if thing >= 0]
        row = arrays["prefix"][seed, task, episode]
        prefix = goals[row[row > 0] - 1].tolist()
        assert prefix == order[: len(prefix)]
        if arrays["complete"][seed, task, episode]:
            assert prefix == order
        else:
            out = arrays["excluded"][seed, task, episode, : len(goals)]
            assert not {order[len(prefix)], *prefix} & set(goals[out > 0].tolist())
    assert arrays["complete"][:, :, -1].all()
    assert arrays["excluded"].any()


def test_an_order_follows_from_the_goals_reached_where_no_actions_are_kept(grid: Any) -> None:
    results, arrays = grid
    found = plan_of(replace(results, actions=None))
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)


def test_a_record_that_a_plan_does_not_come_to_is_named(maze: Any, grid: Any) -> None:
    for results, place in ((maze[0], (1, 1, 70)), (grid[0], (1, 1, 70))):
        goals = results.best["prompt.goals"].copy()
        goals[place] = goals[place][::-1]
        changed = replace(results, best={**results.best, "prompt.goals": goals})
        with pytest.raises(DataError, match="gives different prompts from the recorded ones"):
            plan_of(changed)
    with pytest.raises(DataError, match="hold no actions"):
        plan_of(replace(maze[0], actions=None))
    assert plan_of(replace(maze[0], config={**maze[0].config, "method": "gcbc"})) == {}


@dataclass(frozen=True)
class Uncertain(Wrapper):
    """A world of which nothing is certain."""

    @property
    def spec(self) -> EnvSpec:
        return replace(self.env.spec, goals_are_states=False, deterministic=False)


def likeness(one: np.ndarray, other: np.ndarray) -> float:
    """The kernel of ``mgpo_jax.planning.worths``, goal by goal and pair by pair."""

    def shared(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
        near = [[np.exp(-((x - y) ** 2).sum() / 0.5) for y in b] for x in a]
        pairs = sum(
            near[i][j] * near[k][m]
            for i in range(len(a)) for k in range(i + 1, len(a))
            for j in range(len(b)) for m in range(j + 1, len(b))
        )  # fmt: skip
        return sum(map(sum, near)), pairs

    both, own, others = shared(one, other), shared(one, one), shared(other, other)
    parts = [
        1.0 if a == b == 0 else c / np.sqrt(max(a * b, 1e-12))
        for a, b, c in zip(own, others, both, strict=True)
    ]
    return (parts[0] + parts[1]) / 2


def worth(prompts: list[np.ndarray], returns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The posterior of prompts that were tried, each in one episode."""
    noise = max(returns.std(), 1e-3)
    between = (0.3 * noise) ** 2
    kernel = between * np.array([[likeness(a, b) for b in prompts] for a in prompts])
    gain = kernel @ np.linalg.inv(kernel + noise**2 * np.eye(len(prompts)))
    mean = returns.mean() + gain @ (returns - returns.mean())
    return mean, np.sqrt(between - np.diag(gain @ kernel))


@pytest.fixture
def worths(monkeypatch: pytest.MonkeyPatch) -> Results:
    """8 episodes under prompts of 1 to 3 goals, of which the fifth is the second once more."""
    find = WORLDS.find
    uncertain = World(name="uncertain", make=lambda: Uncertain(ENV))
    monkeypatch.setattr(
        WORLDS, "find", lambda name: uncertain if name == "uncertain" else find(name)
    )
    rng, shape = np.random.default_rng(3), (2, 2, 8)
    masks = np.arange(3) >= rng.integers(0, 3, shape)[..., None]
    goals = np.where(masks[..., None], rng.uniform(size=(*shape, 3, 2)), 0).astype(np.float32)
    masks[:, :, 4], goals[:, :, 4] = masks[:, :, 1], goals[:, :, 1]
    returns = rng.normal(size=shape).astype(np.float32)
    best = {"prompt.goals": goals.copy(), "prompt.mask": masks.copy()}
    for place in np.ndindex(*shape):
        tried = [goals[(*place[:2], e)][masks[(*place[:2], e)]] for e in range(place[2] + 1)]
        held = (*place[:2], int(worth(tried, returns[place[:2]][: place[2] + 1])[0].argmax()))
        best["prompt.goals"][place], best["prompt.mask"][place] = goals[held], masks[held]
    return made_results(
        returns=returns,
        choices={"prompt.goals": goals, "prompt.mask": masks, "greedy": np.zeros(shape, bool)},
        best=best,
        actions=None,
        reached=None,
        config={"env": "uncertain", "method": "plan", "policy": None, "hyper": PLAN},
    )


def test_an_estimate_is_that_of_a_gaussian_process(worths: Results) -> None:
    arrays = plan_of(worths)
    goals, masks = worths.choices["prompt.goals"], worths.choices["prompt.mask"]
    for seed, task, episode in np.ndindex(2, 2, 8):
        tried = [goals[seed, task, e][masks[seed, task, e]] for e in range(episode + 1)]
        mean, std = worth(tried, worths.returns[seed, task, : episode + 1])
        distinct = [e for e in np.argsort(-mean, kind="stable").tolist() if e != 4][:5]
        number = arrays["worthEpisode"][seed, task, episode]
        assert (number[number > 0] - 1).tolist() == distinct
        for name, wanted in (("worthMean", mean), ("worthStd", std)):
            found = arrays[name][seed, task, episode, : len(distinct)]
            np.testing.assert_allclose(found, wanted[distinct], atol=1e-4)
    goals = worths.best["prompt.goals"] + np.float32(0.5)
    with pytest.raises(DataError, match="gives different prompts from the recorded ones"):
        plan_of(replace(worths, best={**worths.best, "prompt.goals": goals}))


def in_node(results: Results, arrays: dict[str, np.ndarray], call: str) -> Any:
    """What a method of ``Log`` in the page says of arrays."""
    assert NODE is not None
    shape = results.returns.shape
    numbers = np.arange(np.prod(shape), dtype=np.uint32).reshape(shape)
    more = {
        "returns": results.returns.astype(np.float32),
        "evalEpisodes": np.ones(1, np.uint32),
        "evalReturns": results.returns[..., :1].astype(np.float32),
        # Every episode has a prompt of its own, its number.
        "choice": np.zeros(shape, np.uint8),
        "prompts": np.arange(1, numbers.size + 1, dtype=np.uint32)[:, None],
        "goals": numbers.reshape(-1, 1).astype(np.float32),
    }
    bundle = Bundle()
    log = f"{bundle.add(SCRIPTS / 'log.js')}.Log"
    data = as_text({"label": "", "colors": {}, "facts": [], "arrays": packed(more | arrays)})
    plain = "(_, value) => (ArrayBuffer.isView(value) ? Array.from(value) : value)"
    script = (
        f"{bundle.source}{log}.of(JSON.parse(require('fs').readFileSync(0, 'utf8')))"
        f".then((log) => console.log(JSON.stringify({call}, {plain})));"
    )
    done = subprocess.run(
        [NODE, "-e", script], input=data, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@needs_node
def test_the_page_reads_what_was_written(maze: Any, grid: Any, worths: Results) -> None:
    results, arrays = maze
    found = in_node(results, arrays, "log.map(1, 1, 40)")
    visits = arrays["visits"][1, 1, :41].sum(axis=0, dtype=int)
    assert found["visits"] == visits[visits > 0].tolist()
    known = cells(arrays, (1, 1))
    assert (
        np.rint(np.array(found["goals"]) * 15).tolist() == known[visits[: len(known)] > 0].tolist()
    )
    way = known[ways_of(arrays)[1, 1, 40]]
    assert np.rint(np.array(found["way"]) * 15).tolist() == way.tolist()
    assert found["verified"] == arrays["verified"][1, 1, 40]

    results, arrays = grid
    episode = int(np.argmax(arrays["excluded"][2, 0].any(axis=-1)))
    found = in_node(results, arrays, f"log.order(2, 0, {episode})")
    goals = arrays["knownGoals"][arrays["known"][2, 0][arrays["known"][2, 0] > 0] - 1]
    row = arrays["prefix"][2, 0, episode]
    assert found["confirmed"] == goals[row[row > 0] - 1].tolist()
    assert found["excluded"] == goals[arrays["excluded"][2, 0, episode][: len(goals)] > 0].tolist()
    assert found["isComplete"] == bool(arrays["complete"][2, 0, episode])

    arrays = plan_of(worths)
    found = in_node(worths, arrays, "log.worths(1, 0, 6)")
    number = arrays["worthEpisode"][1, 0, 6]
    assert [row["first"] for row in found] == (number[number > 0] - 1).tolist()
    assert [row["goals"] for row in found] == [[[16 + row["first"]]] for row in found]
    assert [row["tries"] for row in found] == [1] * len(found)
    np.testing.assert_allclose(
        [row["std"] for row in found], arrays["worthStd"][1, 0, 6, : len(found)]
    )
