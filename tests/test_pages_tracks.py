"""Episodes that are replayed for a page: the agent's track, how many are replayed, and Crafter's map."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from made_results import ENV, MAZE, TINY, made_results
from pages_js import NODE, needs_node

import experiments.pages.tracks as tracks
from envs.page import Page
from experiments.pages.build import Bundle
from experiments.pages.tracks import tracks_of
from experiments.store.result_files import load_results

ROOT = Path(__file__).parents[1]
NORTH, EAST, STAY = 1, 2, 4
MOVES = {NORTH: (-1, 0), EAST: (0, 1), STAY: (0, 0)}


@pytest.mark.parametrize(("most", "stride"), [(10_000, 1), (170, 3)])
def test_tracks_are_the_ways_of_the_agents(
    most: int, stride: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 2 x 2 x 20 episodes of up to 6 steps; of too many steps, every third episode is played again."""
    monkeypatch.setattr(tracks, "MOST_STEPS", most)
    monkeypatch.setattr(tracks, "BATCH", 32)
    rng = np.random.default_rng(0)
    actions = rng.choice([NORTH, EAST, STAY], (2, 2, 20, 6)).astype(np.uint8)
    lengths = rng.integers(3, 7, (2, 2, 20))
    actions[np.arange(6) >= lengths[..., None]] = 255
    results = made_results(actions=actions, reached=None)
    with_record = made_results(actions=actions)  # which says that every episode had four steps
    for one in (results, with_record):
        vars(one)["world"] = TINY  # which is not registered
    assert 2 * most < lengths.sum() <= 3 * most or most >= lengths.sum()
    page = Page(track=lambda state: jnp.append(state.position, 250))
    found = tracks_of(results, page)
    assert found["track"].dtype == np.uint8
    ends = np.cumsum(found["trackCounts"].ravel(), dtype=int)
    for at, place in enumerate(np.ndindex(2, 2, 20)):
        if place[2] % stride:
            assert found["trackCounts"][place] == 0
            continue
        cell, way = ENV.start, [ENV.start]
        for action in actions[place][: lengths[place]].tolist():
            to = cell[0] + MOVES[action][0], cell[1] + MOVES[action][1]
            cell = cell if MAZE[to] else to
            way.append(cell)
        rows = found["track"][:, ends[at] - len(way) : ends[at]].cumsum(axis=1, dtype=np.uint8)
        assert rows[:2].T.tolist() == [list(one) for one in way]
        assert (rows[2] == 250).all()
    fitting = np.where(lengths == 4, found["trackCounts"], 0)
    np.testing.assert_array_equal(tracks_of(with_record, page)["trackCounts"], fitting)
    assert found["trackStride"] == [stride]
    assert tracks_of(results, Page()) == {}
    assert tracks_of(made_results(actions=None), page) == {}


@pytest.mark.slow
def test_crafters_tracks_are_what_its_pictures_make_of_what_was_seen() -> None:
    """Of one published episode, which the pictures derive from the agent's views."""
    pytest.importorskip("craftax", reason="craftax is not installed")
    import jax

    from envs.crafter.page import track
    from envs.crafter.pictures import unlocks_of, way_of
    from envs.episodes import replay
    from experiments.pages.tracks import Tracked

    results = load_results(ROOT / "results/crafter-symbolic/ucb")
    place = (0, 0, 0)
    assert results.keys is not None
    assert results.actions is not None
    assert results.lengths is not None
    env, length = results.world.make(), jnp.int32(results.lengths[place])

    @jax.jit
    def both(key: Any, task: Any, actions: Any) -> Any:
        played = [replay(jax.random.wrap_key_data(key), one, task, actions, length)
                  for one in (env, Tracked(env, track))]  # fmt: skip
        return played

    episode, tracked = both(results.keys[place], results.task(0), results.actions[place])
    rows = np.concatenate([tracked.trajectory.obs[:length], tracked.last_obs[None]])
    np.testing.assert_array_equal(rows[:, :2], way_of(episode))
    steps = np.flatnonzero(rows[:, 2])
    assert [(int(rows[step, 2]) - 1, int(step)) for step in steps] == unlocks_of(episode)


FACTS = {
    "side": 64, "unit": 8.0, "places": True, "kinds": [["collected", "#009E73"], ["placed", "#0072B2"]],
    "promptColor": "#D55E00", "achievements": ["collect wood", "place table", "eat cow"],
    "achievementColors": ["#009E73", "#0072B2", "#CC79A7"], "blocks": ["grass", "tree"],
    "blockColors": ["#00ff00", "#007700"],
}  # fmt: skip


def in_node(expression: str) -> Any:
    """What Crafter's module says, with the ``arcs``, ``rects``, ``boxes`` and ``texts`` that it drew."""
    assert NODE is not None
    bundle = Bundle()
    world = f"{bundle.add(ROOT / 'envs/crafter/page.js')}.world"
    script = f"""{bundle.source}
    const world = {world}, facts = {json.dumps(FACTS)}, arcs = [], rects = [];
    const boxes = [], texts = [];
    const arc = (x, y, radius) => arcs.push([x, y, radius]);
    const kinds = {{ arc, fillRect: (...sizes) => rects.push(sizes),
      roundRect: (...sizes) => boxes.push(sizes), fillText: (text) => texts.push(text) }};
    const context = new Proxy({{}}, {{ get: (_, name) => kinds[name] ?? (() => 0), set: () => true }});
    console.log(JSON.stringify({expression}));"""
    done = subprocess.run([NODE, "-e", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@needs_node
def test_crafters_page_tells_what_was_unlocked_and_where() -> None:
    rows = "[[32, 32, 0], [32, 33, 1], [32, 33, 3]]"
    assert in_node(f"world.moments({rows})")[1] == {"row": 32, "column": 33, "unlocked": 0}
    told = in_node(f"world.tell(facts, {{ moments: world.moments({rows}) }})")
    assert told == (
        "Map of 64 by 64 cells. Agent at row 32, column 33 after 2 steps. "
        "Unlocked: collect wood in step 1, eat cow in step 2."
    )
    names = ["[0, 1, 0]", "[1, 1, 1]", "[0, 0, 0]", "[1, 0, 0, 1, -2, 0.5]", "[1, 0, 0, 0, 0, 0]"]
    assert [in_node(f"world.goalName(facts, Float32Array.from({name}))") for name in names] == [
        "place table", "all achievements", "none", "collect wood at (16, 36)", "collect wood",
    ]  # fmt: skip


@needs_node
def test_marks_on_crafters_map_do_not_cover_each_other() -> None:
    """Eight achievements and nine goals in one place, on a map whose equal cells are drawn together."""
    rows = [[32, 32, 0]] + [[32, 33, 1 + step % 3] for step in range(8)]
    at = [(0, 1), (0, 1), (0, 1), (0, 1.5), (0, 1), (0, 2), (0, 3), (0, 2), (0, 1)]
    goals = [[1, 0, 0, 1, down / 8, right / 8] for down, right in at] + [[1, 1, 1, 0, 0, 0]]
    task = ["a" * 64] * 63 + ["a" * 60 + "bbaa"]
    scene = f"""{{ task: {json.dumps(task)}, moments: world.moments({json.dumps(rows)}),
      goals: {json.dumps(goals)}.map((goal) => Float32Array.from(goal)) }}"""
    arcs, rects, boxes, texts = in_node(
        f"(world.draw(context, facts, {scene}, {{}}), [arcs, rects, boxes, texts])"
    )
    assert len(rects) == 63 + 3
    discs = [[x - radius, y - radius, 2 * radius, 2 * radius] for x, y, radius in arcs[:-1]]
    assert len(discs) == 8
    # Goals 1 to 3, 5 and 9 share a cell, goal 4 is rounded to that of 6 and 8, and 7 is alone.
    assert texts == ["S", *"12345678", "1\N{EN DASH}3,..", "4,..", "7"]
    marks = np.array([*(box[:4] for box in boxes), *discs])
    assert len(marks) == 1 + 8 + 3
    low, high = marks[:, :2], marks[:, :2] + marks[:, 2:]
    both = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)  # of what two share
    covered = both.clip(0).prod(axis=-1)[np.triu_indices(len(marks), 1)]
    assert covered.max() < 0.25 * np.pi * 1.25**2
    assert np.ptp(low, axis=0).max() < 20


@needs_node
def test_crafters_legend_names_what_its_map_shows() -> None:
    """Colors of achievements, and of the prompt where goals have places."""
    legend = dict(in_node("world.legend(facts)"))
    assert legend["#009E73"].endswith("; collected")
    assert legend["#0072B2"] == "placed"
    assert "goals of the prompt" in legend["#D55E00"]
    assert "#D55E00" not in dict(in_node("world.legend({ ...facts, places: false })"))


@needs_node
def test_crafters_map_counts_the_visits_of_episodes() -> None:
    """Each visited cell is covered once, besides the map; the agent's way is drawn in any case."""
    walks = (
        "[[[32, 32, 0], [32, 33, 0]], [[32, 32, 0], [33, 32, 0], [32, 32, 0]]].map(world.moments)"
    )
    task = json.dumps(["a" * 64] * 64)
    scene = f"{{ task: {task}, goals: [], moments: {walks}[0], earlier: {walks} }}"
    rects = in_node(f"(world.draw(context, facts, {scene}, {{}}), rects)")
    assert sorted(rects[64:]) == [[32, 32, 1, 1], [32, 33, 1, 1], [33, 32, 1, 1]]
    without = in_node(
        f"(world.draw(context, facts, {{ ...{scene}, earlier: undefined }}, {{}}), rects)"
    )
    assert without == rects[:64]


@needs_node
def test_gridworld_shows_repeated_goals_and_the_order_of_switching() -> None:
    """A goal that a prompt has twice shows both numbers, and so does an object that is switched twice."""
    bundle = Bundle()
    world = f"{bundle.add(ROOT / 'envs/gridworld/page.js')}.world"
    facts = {"side": 5, "horizon": 9, "objects": [[1, 1], [3, 3]], "letters": "AB", "fewest": 1}
    switches = [[0, 0], [0, 1], [1, 1], [1, 0]]  # B, A, and B once more
    moments = [
        {"row": 0, "column": 0, "isOn": [bool(on) for on in isOn], "numSolved": 0}
        for isOn in switches
    ]
    goals = [[1, 0], [0, 1], [1, 0]]
    script = f"""{bundle.source}
    const facts = {json.dumps(facts)}, texts = [];
    const kinds = {{ fillText: (text, x, y) => texts.push([text, Math.round(x), Math.round(y)]) }};
    const context = new Proxy({{}}, {{ get: (_, name) => kinds[name] ?? (() => 0), set: () => true }});
    const scene = {{ task: [1, 0], goals: {json.dumps(goals)}.map((goal) => Float32Array.from(goal)),
      moments: {json.dumps(moments)} }};
    {world}.draw(context, facts, scene, {{}});
    console.log(JSON.stringify([texts, {world}.tell(facts, scene)]));"""
    assert NODE is not None
    done = subprocess.run([NODE, "-e", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    texts, told = json.loads(done.stdout)
    assert ["1,3", 1, 1] in texts  # at the corners of the cells of A and B
    assert ["2", 3, 3] in texts
    assert ["2", 1, 2] in texts
    assert ["1,3", 3, 4] in texts
    assert "switched: B, A, B; on: A" in told
