"""The world Crafter: initial states, tasks, observations, randomness, pictures, and a missing package.

The rules themselves are compared with the Python program in tests/test_crafter_official.py.
"""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.crafter import extra
from envs.errors import MissingExtraError, UsageError


class TestMissingPackage:
    @pytest.fixture(autouse=True)
    def _fresh(self):
        extra.check_extra.cache_clear()
        yield
        extra.check_extra.cache_clear()

    def test_absent(self, monkeypatch):
        def version(name):
            raise importlib.metadata.PackageNotFoundError(name)

        monkeypatch.setattr(extra, "version", version)
        with pytest.raises(
            UsageError, match=r"needs craftax 1\.6\.1 or newer: pip install '.*\[crafter\]'$"
        ):
            envs.make("crafter-symbolic")

    def test_too_old(self, monkeypatch):
        monkeypatch.setattr(extra, "version", lambda name: "1.5.0")
        with pytest.raises(UsageError, match=r"needs craftax 1\.6\.1 or newer, found 1\.5\.0: pip"):
            envs.make("crafter")

    def test_incomplete(self, monkeypatch):
        monkeypatch.setattr(extra, "version", lambda name: "1.10.0")
        monkeypatch.setattr(extra.importlib.util, "find_spec", lambda name: None)
        with pytest.raises(MissingExtraError, match="has no textures"):
            extra.check_extra()


pytest.importorskip("craftax")
from craftax.craftax_classic.constants import SOLID_BLOCKS  # noqa: E402

from envs.crafter import rules  # noqa: E402
from envs.crafter.env import Crafter, CrafterState, CrafterTask  # noqa: E402
from envs.crafter.pictures import (  # noqa: E402
    color_of,
    crafter_pictures,
    joined,
    kinds,
    marks_of,
    places_of,
    unlocks_of,
    way_of,
)
from envs.crafter.tiles import agent_picture, picture, tiles  # noqa: E402
from envs.crafter.view import (  # noqa: E402
    ACHIEVEMENTS,
    ACTIONS,
    ASLEEP,
    BLOCKS,
    COLUMNS,
    FLOWN_OVER,
    LIGHT,
    NUM_BLOCKS,
    NUM_CELLS,
    NUM_CODES,
    NUM_COUNTS,
    OBS_SIZE,
    PLACE_AMONG_POSSIBLE,
    PLACED,
    POSSIBLE,
    ROWS,
    WALKED,
)
from envs.drawing import Shown  # noqa: E402
from envs.episodes import Agent, run_episode  # noqa: E402

ENV = Crafter(name="crafter-symbolic", horizon=40)
NUM_LANES = 8
GRASS = BLOCKS.index("grass")


def wanders(key, memory, state, timestep):
    """Mostly walks, and sometimes does anything."""
    keys = jax.random.split(key, 3)
    move = jax.random.randint(keys[0], (), 1, 6)
    anything = jax.random.randint(keys[1], (), 0, len(ACTIONS))
    action = jnp.where(jax.random.uniform(keys[2]) < 0.7, move, anything)
    place = state.world.player_position
    memory = jnp.roll(memory, 1, axis=0).at[0].set(place)
    return action, jnp.zeros((), bool), memory


WANDERER = Agent(
    begin=lambda key, task, state, timestep: wanders(
        key, jnp.zeros((ENV.horizon, 2), jnp.int32), state, timestep
    ),
    proceed=wanders,
    decisions=lambda memory: memory,
)


@pytest.fixture(scope="module")
def played():
    """Some short episodes, with where the agent really was at each of its decisions, latest first."""
    tasks = jax.vmap(ENV.sample_task)(jax.random.split(jax.random.key(1), NUM_LANES))
    run = jax.jit(jax.vmap(lambda key, task: run_episode(key, ENV, WANDERER, task)))
    episodes = run(jax.random.split(jax.random.key(2), NUM_LANES), tasks)
    return tasks, jax.tree.map(np.asarray, episodes)


def test_spec():
    spec = ENV.spec
    assert (spec.obs.shape, spec.goal_dim, spec.action_dim) == ((85,), 22, 17)
    assert spec.return_range == (-0.9, 22.0)
    assert not spec.deterministic
    assert not spec.reward_confirms_goals
    assert spec.layout.num_cells + spec.layout.num_counts + 6 == OBS_SIZE
    assert np.prod(spec.layout.code_sizes) == NUM_CODES
    assert ENV.goal_names == ACHIEVEMENTS
    pixels = Crafter(name="crafter", horizon=40, pixels=True).spec
    assert str(pixels.obs) == "uint8[64, 64, 3]"
    assert (
        envs.make("crafter-symbolic").spec.horizon == envs.make("crafter-map").spec.horizon == 500
    )
    assert (
        replace(envs.make("crafter").spec, name="crafter-symbolic")
        == envs.make("crafter-symbolic").spec
    )


def test_tasks_and_goals(key):
    task = ENV.sample_task(key)
    np.testing.assert_array_equal(ENV.task_goal(task), np.ones(22))
    assert np.isnan(ENV.optimal_return(task))
    goal = np.asarray(ENV.sample_goal(key))
    assert sorted(goal) == [0] * 21 + [1]
    a, b = (ENV.fingerprint(CrafterTask(jnp.uint32(seed))) for seed in (1, 1 + (1 << 24)))
    assert not np.array_equal(a, b)


@pytest.mark.parametrize(
    ("seed", "message"),
    [
        (np.array(3), r"seed must have shape \[N\], found \[\]"),
        (np.zeros((3, 1), int), r"seed must have shape \[N\], found \[3, 1\]"),
        (np.array([1.5]), "must hold integers, found float64"),
        (np.array(["a"]), "must hold integers, found <U1"),
        (np.array([0, -1]), "task 1: a seed is a whole number from 0 to 4294967295, found -1"),
        (np.array([1 << 32]), "task 0: a seed is a whole number .* found 4294967296"),
    ],
)
def test_bad_tasks(seed, message):
    with pytest.raises(ValueError, match=message):
        ENV.check_task(CrafterTask(seed))


def test_good_tasks():
    for dtype in (np.uint32, np.int64, np.uint8):
        ENV.check_task(CrafterTask(np.array([0, 7], dtype)))
    ENV.check_task(CrafterTask(np.array([(1 << 32) - 1])))


def test_a_world_is_a_function_of_its_seed():
    worlds = jax.jit(jax.vmap(rules.new_world))(jnp.array([5, 5, 6], jnp.uint32))
    maps = np.asarray(worlds.map)
    np.testing.assert_array_equal(maps[0], maps[1])
    assert (maps[0] != maps[2]).any()
    assert (maps[:, 32, 32] == GRASS).all()
    assert (worlds.player_direction == ACTIONS.index("down")).all()
    for leaf in jax.tree.leaves(worlds):
        assert not leaf.weak_type


def test_episodes(played):
    _, episodes = played
    trajectory, lengths = episodes.trajectory, episodes.trajectory.length
    assert (episodes.return_ >= -0.91).all()
    assert episodes.return_.max() > 0.9
    for lane in range(NUM_LANES):
        goals = trajectory.achieved_goals[lane, : lengths[lane]]
        # One achievement at a time, each once, and the outcome is what was achieved so far.
        assert (goals.sum(1) == trajectory.goal_reached[lane, : lengths[lane]]).all()
        np.testing.assert_array_equal(
            np.cumsum(goals, 0), trajectory.outcomes[lane, : lengths[lane]]
        )
        obs = np.concatenate([trajectory.obs[lane, : lengths[lane]], episodes.last_obs[lane][None]])
        health = obs[:, NUM_CELLS + 12]
        expected = goals.sum(1) + 0.1 * np.diff(health)
        np.testing.assert_allclose(episodes.rewards[lane, : lengths[lane]], expected, atol=1e-5)


def test_observations(played):
    _, episodes = played
    obs = episodes.trajectory.obs[:, : episodes.trajectory.length.min()].reshape(-1, OBS_SIZE)
    codes, counts = obs[:, :NUM_CELLS], obs[:, NUM_CELLS:][:, :NUM_COUNTS]
    assert (codes == codes.astype(int)).all()
    assert (codes >= 0).all()
    assert (codes < NUM_CODES).all()
    assert np.isin(codes, POSSIBLE).all()
    assert (counts == counts.astype(int)).all()
    assert (counts >= 0).all()
    assert (counts <= 9).all()
    np.testing.assert_array_equal(obs[:, NUM_CELLS + NUM_COUNTS : LIGHT].sum(1), 1)
    assert ((obs[:, LIGHT] >= 0) & (obs[:, LIGHT] <= 1)).all()
    assert np.isin(obs[:, ASLEEP], (0, 1)).all()


def test_the_way_follows_from_what_was_seen_and_done(played):
    _, episodes = played
    for lane in range(NUM_LANES):
        episode = jax.tree.map(lambda leaf, lane=lane: leaf[lane], episodes)
        length = int(episode.trajectory.length)
        way = way_of(episode)
        assert len(way) == length + 1
        if length == ENV.horizon:  # of shorter ones the record of the agent goes on
            np.testing.assert_array_equal(way[:-1], episode.decisions[::-1])
        for goal, step in unlocks_of(episode):
            assert episode.trajectory.achieved_goals[step - 1, goal] == 1


def test_places(played):
    """Goals say where achievements were unlocked, observations where the agent is; the rest is the same."""
    tasks, plain = played
    env = Crafter(name="crafter-map", horizon=40, places=True)
    assert (env.spec.obs.shape, env.spec.goal_dim) == ((OBS_SIZE + 2,), 25)
    np.testing.assert_array_equal(env.task_goal(tasks), [1] * 22 + [0] * 3)
    np.testing.assert_array_equal(env.sample_goal(jax.random.key(0))[22:], 0)
    run = jax.jit(jax.vmap(lambda key, task: run_episode(key, env, WANDERER, task)))
    episodes = jax.tree.map(np.asarray, run(jax.random.split(jax.random.key(2), NUM_LANES), tasks))
    record, expected = episodes.trajectory, plain.trajectory
    np.testing.assert_array_equal(record.obs[..., :OBS_SIZE], expected.obs)
    np.testing.assert_array_equal(record.achieved_goals[..., :22], expected.achieved_goals)
    np.testing.assert_array_equal(record.outcomes[..., :22], expected.outcomes)
    np.testing.assert_array_equal(record.outcomes[..., 22:], 0)
    np.testing.assert_array_equal(record.achieved_goals[..., 22], record.goal_reached)
    num_unlocked = 0
    for lane in range(NUM_LANES):
        episode = jax.tree.map(lambda leaf, lane=lane: leaf[lane], episodes)
        way = (way_of(episode) - 32) / 8
        np.testing.assert_array_equal(record.obs[lane, : len(way) - 1, OBS_SIZE:], way[:-1])
        for goal, step in unlocks_of(episode):
            unlocked = record.achieved_goals[lane, step - 1]
            assert unlocked[goal] == 1
            np.testing.assert_array_equal(unlocked[23:], way[step])
            num_unlocked += 1
    assert num_unlocked > 3


def test_the_possible_codes_follow_from_the_rules():
    """Mobs stay off lava and what is solid; arrows fly over water and lava, and may get a block below."""
    solid = {BLOCKS[index] for index in np.asarray(SOLID_BLOCKS)}
    open_ = set(BLOCKS) - solid - {"invalid", "out_of_bounds", "wood"}  # no map has these
    assert set(WALKED) == open_ - {"lava"}
    assert set(FLOWN_OVER) == open_ | {"water"}
    assert set(PLACED) == {"stone", "crafting_table", "furnace", "plant"} <= solid
    assert len(POSSIBLE) == len(set(POSSIBLE)) == 17 + 3 * 3 + 4 * (9 + 3 * 3)
    np.testing.assert_array_equal(POSSIBLE[PLACE_AMONG_POSSIBLE[POSSIBLE]], POSSIBLE)
    np.testing.assert_array_equal(
        POSSIBLE[PLACE_AMONG_POSSIBLE] % NUM_BLOCKS, np.arange(NUM_CODES) % NUM_BLOCKS
    )


def test_mobs_appear_by_night(key):
    """Zombies on grass when it is dark, hardly any by day; never beside the agent."""
    grass = rules.new_world(jnp.uint32(0))
    grass = grass.replace(map=jnp.full_like(grass.map, GRASS))

    @jax.jit
    def after(key, light):
        world = grass.replace(light_level=light)
        balance = lambda world, key: (rules._balance(key, world), None)  # noqa: E731
        return jax.lax.scan(balance, world, jax.random.split(key, 300))[0]

    night, day = after(key, jnp.float32(0.0)), after(key, jnp.float32(1.0))
    assert int(night.zombies.mask.sum()) == 5
    assert int(day.zombies.mask.sum()) == 0
    assert int(day.cows.mask.sum()) >= 2
    assert int(day.skeletons.mask.sum()) == 0  # there is no tunnel
    for world in (night, day):
        places = [
            getattr(world, kind).position[getattr(world, kind).mask] for kind in ("zombies", "cows")
        ]
        places = np.concatenate(places)
        distance = abs(places - np.array([32, 32])).sum(1)
        assert ((distance >= 5) & (distance < 14)).all()
        # The map of mobs is that of their places.
        marked = np.zeros((64, 64), bool)
        marked[tuple(places.T)] = True
        np.testing.assert_array_equal(np.asarray(world.mob_map), marked)


def obs_of(codes=GRASS, light=1.0, asleep=False):
    obs = np.zeros(OBS_SIZE, np.float32)
    obs[:NUM_CELLS] = codes
    obs[NUM_CELLS + NUM_COUNTS] = 1
    obs[LIGHT], obs[ASLEEP] = light, asleep
    return jnp.asarray(obs)


class TestPictures:
    def test_a_picture_is_its_codes(self):
        """Every cell shows the tile of its code, wherever it is."""
        codes = np.random.default_rng(0).integers(0, NUM_CODES, NUM_CELLS)
        shown = np.asarray(picture(obs_of(codes)))
        day = tiles().day
        for cell, code in enumerate(codes):
            row, column = 7 * (cell // COLUMNS), 7 * (cell % COLUMNS)
            if cell != NUM_CELLS // 2:  # where the agent stands
                tile = shown[row : row + 7, column : column + 7]
                np.testing.assert_array_equal(tile, day[code])
        assert shown.shape == (63, 63, 3)
        assert not shown[7 * ROWS :].any()  # it has nothing

    def test_for_agents_a_row_and_a_column_are_black(self):
        shown = np.asarray(agent_picture(obs_of()))
        assert shown.shape == (64, 64, 3)
        assert shown.dtype == np.uint8
        assert not shown[-1].any()
        assert not shown[:, -1].any()

    def test_it_gets_dark(self):
        means = [np.asarray(picture(obs_of(light=light))).mean() for light in (1.0, 0.5, 0.0)]
        assert means == sorted(means, reverse=True)
        asleep = np.asarray(picture(obs_of(asleep=True)))[:49]
        assert (asleep[..., 0] == asleep[..., 1]).all()  # gray, with a tint of blue

    def test_different_codes_look_different(self):
        day = tiles().day.reshape(NUM_CODES, -1)
        known = np.arange(NUM_CODES) % NUM_BLOCKS
        shown = day[(known > 1) & (np.arange(NUM_CODES) < 2 * NUM_BLOCKS)]
        assert len(np.unique(shown, axis=0)) == len(shown)

    def test_pixels_are_the_picture_of_the_codes(self, key):
        codes, pixels = ENV, Crafter(name="crafter", horizon=40, pixels=True)
        task = CrafterTask(jnp.uint32(3))
        _, one = jax.jit(codes.reset)(key, task)
        _, other = jax.jit(pixels.reset)(key, task)
        np.testing.assert_array_equal(other.obs, agent_picture(one.obs))

    def test_figures(self, played, tmp_path):
        from matplotlib.figure import Figure

        tasks, episodes = played
        drawn = crafter_pictures(ENV)
        figure = Figure(figsize=(4, 3))
        shown = [
            Shown(f"task {lane}", np.ones((1, 22)), jax.tree.map(lambda x, i=lane: x[i], episodes))
            for lane in range(2)
        ]
        some = [CrafterTask(np.asarray(tasks.seed[lane])) for lane in range(2)]
        drawn.episodes(list(figure.subplots(1, 2)), some, shown)
        figure.savefig(tmp_path / "map.png")
        legend = [text.get_text() for text in figure.legends[0].get_texts()]
        assert legend[-4:] == ["collected", "placed", "made", "other achievements"]
        assert not any("prompt" in text for text in legend)
        drawn.video(tmp_path / "a.gif", some[0], shown[:1])
        assert (tmp_path / "map.png").stat().st_size > 10_000
        assert (tmp_path / "a.gif").stat().st_size > 10_000
        assert crafter_pictures(Crafter("crafter", 40, pixels=True)).frame is not None


class TestPlacesOfPrompts:
    def goal(self, name, *place):
        goal = np.zeros(25, np.float32)
        goal[ACHIEVEMENTS.index(name)] = 1
        if place:
            goal[22:] = 1, *((np.array(place) - 32) / 8)
        return goal

    def test_goals_at_one_cell_are_joined(self):
        goals = [
            self.goal("collect_wood", 30, 40), self.goal("place_table", 30, 40), self.goal("wake_up"),
            self.goal("eat_cow", 12, 33), self.goal("collect_iron", 30, 40),
            self.goal("collect_coal", 1e18, -1e18), self.goal("place_stone", np.nan, 5),
        ]  # fmt: skip
        found = places_of(np.stack(goals))
        assert found == {(30, 40): [1, 2, 5], (12, 33): [4], (63, 0): [6], (0, 5): [7]}
        assert places_of(np.ones((2, 22))) == {}
        numbers = [[3], [1, 2, 5], [4, 6, 9], [7, 8, 9]]
        assert [joined(each) for each in numbers] == [
            "3",
            "1\N{EN DASH}2,5",
            "4,..",
            "7\N{EN DASH}9",
        ]

    def test_they_are_boxes_on_the_map_and_numbers_in_the_bar(self, played):
        from matplotlib.figure import Figure
        from matplotlib.patches import FancyBboxPatch

        tasks, episodes = played
        episode = jax.tree.map(lambda leaf: leaf[0], episodes)
        (first, _), *_ = unlocks_of(episode)
        goals = [
            self.goal("eat_plant", 40, 20), self.goal("eat_cow", 40, 20),
            self.goal(ACHIEVEMENTS[first], 40, 20), np.pad(np.ones(22), (0, 3)),
        ]  # fmt: skip
        figure = Figure(figsize=(4, 6), layout="compressed")
        ax = figure.subplots()
        task = CrafterTask(np.asarray(tasks.seed[0]))
        crafter_pictures(ENV).episodes([ax], [task], [Shown("", np.stack(goals), episode)])
        figure.draw_without_rendering()
        boxes = [patch for patch in ax.patches if isinstance(patch, FancyBboxPatch)]
        assert len(boxes) == 2  # the start, and one for the three goals
        wide = boxes[1].get_window_extent().width
        assert wide > 1.3 * boxes[0].get_window_extent().width
        assert ax.get_xlim()[0] < 20 < ax.get_xlim()[1]
        assert ax.get_ylim()[1] < 40 < ax.get_ylim()[0]
        texts = [text.get_text().strip() for text in ax.child_axes[0].texts]
        assert texts[0].endswith("(goal 3)")
        assert not any("goal" in text for text in texts[1:])
        assert "goals of the prompt" in " ".join(
            t.get_text() for t in figure.legends[0].get_texts()
        )

    def test_every_mark_has_a_color_that_the_legend_names(self):
        way = np.full((23, 2), 32)
        marks = marks_of(way, [(goal, 1 + goal) for goal in range(22)], {})
        named = dict((color, kind) for kind, color in kinds())
        assert {mark.color for mark in marks[1:]} == set(named)
        assert named[color_of(ACHIEVEMENTS.index("collect_drink"))] == "collected"


def test_nothing_is_written_beside_the_package():
    """Craftax's own renderer would keep its textures in the folder that it is installed in."""
    code = (
        "import sys; from pathlib import Path; from envs.crafter import extra\n"
        "def listing():\n"
        "    paths = extra.texture_folder().rglob('*')\n"
        "    return sorted((str(path), path.stat().st_mtime) for path in paths if path.is_file())\n"
        "before = listing()\n"
        "from envs.crafter import env, tiles\n"
        "assert tiles.tiles(7).day.shape[0] == 340\n"
        "assert listing() == before\n"
        "assert 'craftax.craftax_classic.renderer' not in sys.modules"
    )
    root = str(Path(__file__).parents[1])
    subprocess.run([sys.executable, "-c", code], check=True, cwd=root, env={**os.environ})


def test_the_expert_goes_for_what_usually_comes_first_of_the_rest():
    nothing = CrafterState(*[None] * len(CrafterState._fields))
    unlocked = np.zeros(len(ACHIEVEMENTS), bool)
    for name in ("collect_wood", "collect_sapling", "place_table"):
        state = nothing._replace(world=SimpleNamespace(achievements=jnp.asarray(unlocked)))
        goal = ENV.expert_goal(state, 10)
        wanted = np.arange(len(ACHIEVEMENTS)) == ACHIEVEMENTS.index(name)
        np.testing.assert_array_equal(goal[: len(wanted)], wanted)
        assert not goal[len(wanted) :].any()
        unlocked |= wanted
