"""Figures of GridWorld: what is drawn where, on handmade data."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fakes import FakeResults, player
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch

import envs
from envs.drawing.palette import PAPER
from envs.episodes import run_episode
from envs.gridworld import pictures as grid
from envs.gridworld.demonstrators import switcher
from envs.gridworld.env import FLIP, NONE, NUM_OBJECTS, OBJECTS, SOUTH, GridTask
from envs.gridworld.pictures import LETTERS, OBJECT_COLORS, Walk, objects_of
from experiments import figures
from experiments.figures import rollouts
from mgpo_jax.distributions import Categorical
from mgpo_jax.policy import Policy

ENV = envs.make("gridworld")
PICTURES = grid.grid_pictures(ENV)
SLOTS = NUM_OBJECTS + 1
ORDERS = np.array([[2, 0, 5, NONE, NONE, NONE, NONE], [6, 5, 4, 3, 2, 1, 0]], np.int32)
# Found after some episodes, as letters of goals before g^M: on the first task and on the second.
FOUND = {1: ("", ""), 10: ("CF", "GA"), 40: ("CAF", "GFEDCBA")}
EVALUATED = np.array([1, 10, 20, 40])


def objects(letters: str) -> np.ndarray:
    return np.array([LETTERS.index(letter) for letter in letters], int)


def prompt_of(letters: str, order: np.ndarray) -> np.ndarray:
    """Goals by their letters, then g^M."""
    goals = np.eye(NUM_OBJECTS, dtype=np.float32)
    return np.concatenate([goals[objects(letters)], goals[objects_of(order)].sum(axis=0)[None]])


def fake_results(method: str = "ucb") -> FakeResults:
    """1 seed, the 2 tasks of ``ORDERS``, 40 episodes; the best prompts are those of ``FOUND``."""
    found = [
        {since: prompt_of(letters[task], order) for since, letters in FOUND.items()}
        for task, order in enumerate(ORDERS)
    ]
    return FakeResults(
        tasks=[GridTask(order) for order in ORDERS],
        task_goals=np.stack([prompts[1][-1] for prompts in found]),
        found=found,
        eval_episodes=EVALUATED,
        eval_returns=np.array([[[0.0, 0.33, 0.67, 1.0], [0.14, 0.29, 0.14, 1.0]]]),
        optimal_returns=np.ones(2),
        num_episodes=40,
        max_goals=SLOTS,
        method=method,
    )


def flipping_policy() -> Policy:
    """Walks south and flips in turn, whatever it sees."""

    def act(time):
        return Categorical(50.0 * jax.nn.one_hot(jnp.where(time % 2 == 0, SOUTH, FLIP), 6))

    return Policy(
        prefill=lambda prompt, obs: (act(0), jnp.zeros((), int)),
        decode=lambda time, action, obs: (act(time + 1), time + 1),
        grow=lambda time, num_steps: time,
        num_slots=SLOTS,
    )


def start_of(ax) -> np.ndarray:
    """Center (x, y) of the box S."""
    (box,) = [patch for patch in ax.patches if isinstance(patch, FancyBboxPatch)]
    return box.get_path().get_extents().get_points().mean(axis=0)


def labeled(ax):
    """(label, column, row, whether filled) of the discs of some axes, in their order."""
    return [
        (
            letter.get_label(),
            round(mark.center[0], 2),
            round(mark.center[1], 2),
            to_hex(mark.get_facecolor()) != PAPER.lower(),
        )
        for mark, letter in pairwise(ax.patches)
        if isinstance(mark, Circle) and len(letter.get_label()) == 1
    ]


def on_grid(order, **options):
    ax = Figure().add_subplot()
    grid.draw_grid(ax, order, np.ones(NUM_OBJECTS, bool), **options)
    return ax


def texts(ax) -> list[str]:
    return [text.get_text() for text in ax.texts]


@pytest.mark.parametrize(
    ("named", "order", "marks"),
    [
        ("ABC", "ABC", "111"),
        ("AB", "ABC", "11"),
        ("", "ABC", ""),
        ("BAC", "ABC", "010"),  # A is first; B was too early, C still is
        ("ACB", "ABC", "101"),  # without C it reads AB
        ("AAB", "ABC", "101"),  # once only
        ("GAB", "ABC", "011"),  # G is no part of the task
        ("ABCD", "ABC", "1110"),  # nothing is left to name
    ],
)
def test_goals_agree_that_spell_the_beginning_of_the_order(named, order, marks):
    found = grid.in_turn(objects(named), objects(order))
    assert found.dtype == bool
    assert found.tolist() == [mark == "1" for mark in marks]


def test_goals_that_name_no_object_do_not_agree():
    assert grid.in_turn(np.array([NONE, 0]), objects("ABC")).tolist() == [False, True]


def test_the_task_goal_at_the_end_is_not_named():
    order = ORDERS[0]
    np.testing.assert_array_equal(grid.named_objects(prompt_of("CF", order), order), objects("CF"))
    assert len(grid.named_objects(prompt_of("", order), order)) == 0
    # One that names another set is.
    np.testing.assert_array_equal(grid.named_objects(prompt_of("C", ORDERS[1]), order), [2, NONE])


def test_moved_goals_count_as_what_they_are_nearest_to():
    order, goals = ORDERS[0], prompt_of("CF", ORDERS[0])
    moved = goals + 0.3 * np.sign(np.sin(np.arange(goals.size))).reshape(goals.shape)
    np.testing.assert_array_equal(grid.named_objects(moved, order), objects("CF"))
    moved[-2] = 0.1
    np.testing.assert_array_equal(grid.named_objects(moved, order), [2, NONE])


def test_objects_have_colors_of_their_own():
    assert len({*OBJECT_COLORS}) == len(LETTERS) == NUM_OBJECTS
    ax = Figure().add_subplot()
    grid.draw_objects(ax, np.array([0, 6, NONE]), np.array([True, False, False]), 2.0, x=1.0)
    assert labeled(ax) == [("A", 1, 2, True), ("G", 2, 2, False), ("?", 3, 2, False)]


def test_objects_stand_in_their_cells_with_their_places():
    discs = labeled(on_grid(ORDERS[0]))
    cells = {label: (row, column) for label, column, row, _ in discs if label in LETTERS}
    assert cells == dict(zip(LETTERS, OBJECTS, strict=True))
    places = {label: (column, row) for label, column, row, _ in discs if label in "1234567"}
    assert set(places) == {"1", "2", "3"}
    for place, thing in enumerate(objects_of(ORDERS[0]), start=1):
        row, column = OBJECTS[thing]
        assert np.linalg.norm(np.subtract(places[str(place)], (column, row))) < 1


def test_paths_begin_at_their_start():
    positions = np.array([[4, 4], [4, 5], [5, 5]])
    walk = Walk(positions, np.zeros((3, NUM_OBJECTS), bool))
    ax = on_grid(ORDERS[0], walk=walk, lanes=False)
    path = [line.tolist() for line in ax.collections[-1].get_segments()]
    assert path == [[[4, 4], [5, 4]], [[5, 4], [5, 5]]]  # x is the column
    np.testing.assert_allclose(start_of(ax), (4, 4), atol=0.2)


@pytest.mark.parametrize("thing", range(NUM_OBJECTS))
def test_a_start_on_an_object_hides_neither(thing):
    walk = Walk(np.array([OBJECTS[thing]] * 2), np.zeros((2, NUM_OBJECTS), bool))
    ax = on_grid(ORDERS[1], walk=walk)
    centers = np.array([disc[1:3] for disc in labeled(ax)])
    assert np.linalg.norm(centers - start_of(ax), axis=1).min() > 0.8


def test_legs_that_share_cells_run_side_by_side():
    is_on = np.zeros((4, NUM_OBJECTS), bool)
    is_on[2:, 0] = True
    there_and_back = Walk(np.array([[4, 4], [4, 5], [4, 5], [4, 4]]), is_on)
    first, _, last = on_grid(ORDERS[0], walk=there_and_back).collections[-1].get_segments()
    assert np.abs(first[:, 1] - last[:, 1]).min() > 0.1


def test_the_strip_shows_the_prompt():
    below = [disc for disc in labeled(on_grid(ORDERS[0], prompt=objects("CAF"))) if disc[2] > 9.5]
    assert [disc[0] for disc in below] == ["C", "A", "F"]
    assert texts(on_grid(ORDERS[0], prompt=objects(""))) == ["prompt", "task goal only"]
    ax = on_grid(ORDERS[0], prompt=objects("CAFBDEGA"))
    assert max(disc[1] for disc in labeled(ax)) + 0.43 < ax.get_xlim()[1]


def test_walks_include_the_last_step(key):
    task = GridTask(jnp.asarray(ORDERS[0]))
    episode = jax.jit(lambda k: run_episode(k, ENV, switcher(), task))(key)
    walk = grid.walk_of(episode)
    assert len(walk.positions) == len(walk.is_on) == int(episode.trajectory.length) + 1
    assert np.abs(np.diff(walk.positions, axis=0)).sum(axis=1).max() == 1
    assert not walk.is_on[0].any()
    np.testing.assert_array_equal(walk.positions[-1], OBJECTS[5])
    np.testing.assert_array_equal(np.flatnonzero(walk.is_on[-1]), sorted(objects_of(ORDERS[0])))


def test_a_search_shows_each_stage_with_its_return():
    figure = rollouts.search(PICTURES, fake_results(), (1, 0))
    second, first = figure.axes
    rows = {}
    for label, _, row, filled in labeled(first):
        rows.setdefault(row, []).append(label if filled else label.lower())
    assert ["".join(rows[row]) for row in sorted(rows)] == ["CAF", "Cf", "Cf", "CAF"]
    assert texts(first) == ["task goal only", "0.00", "0.33", "0.67", "1.00"]
    assert (first.get_title(loc="left"), second.get_title(loc="left")) == ("task 0", "task 1")
    assert [tick.get_text() for tick in second.get_yticklabels()] == [
        "true order", "1 episode", "10 episodes", "20 episodes", "40 episodes",
    ]  # fmt: skip


def test_a_search_shows_evaluated_stages_and_the_last():
    results = replace(fake_results(), eval_episodes=np.array([1, 1, 15, 30]))
    (ax,) = rollouts.search(PICTURES, results, (0,)).axes
    labels = [tick.get_text() for tick in ax.get_yticklabels()]
    assert labels == ["true order", "1 episode", "30 episodes"]


def test_no_text_hides_another(tmp_path):
    figure = rollouts.search(PICTURES, fake_results(), (0, 1))
    figure.savefig(tmp_path / "search.png")
    for ax in figure.axes:
        boxes = [text.get_window_extent() for text in (*ax.texts, *ax.get_yticklabels())]
        boxes += [patch.get_window_extent() for patch in ax.patches if isinstance(patch, Circle)]
        for index, box in enumerate(boxes):
            assert not any(box.shrunk(0.9, 0.9).overlaps(other) for other in boxes[:index])


def test_gif_shows_every_step(tmp_path):
    is_on = np.zeros((4, NUM_OBJECTS), bool)
    is_on[3, 5] = True
    walk = Walk(np.array([[5, 0], [5, 1], [6, 1], [6, 1]]), is_on)
    shorter = Walk(walk.positions[:2], is_on[:2])
    panels = [grid.Panel("long", walk, objects("CAF")), grid.Panel("short", shorter)]
    grid.grid_gif(tmp_path / "walk.gif", ORDERS[0], panels)
    frames = iio.imread(tmp_path / "walk.gif")
    assert len(frames) == 4
    assert all((one != other).any() for one, other in pairwise(frames))
    right = frames[1:, :, frames.shape[2] // 2 + 10 :]
    assert not np.ptp(right.astype(int), axis=0).any()  # the shorter episode stands still


def test_a_search_is_drawn_right_after_an_adaptation(tmp_path):
    ((name, save),) = figures.figures_of_run(PICTURES, fake_results(), (0, 1))
    save(tmp_path / name)
    assert name == "search.png"


def test_everything_that_gridworld_draws(tmp_path):
    play = player(replace(ENV, horizon=12), flipping_policy())
    results, drawn = {"ucb": fake_results()}, {}
    for name, save in figures.figures_of_results(PICTURES, results, lambda _: play, (1, 0), 0):
        save(tmp_path / name)
        drawn[name] = iio.imread(tmp_path / name)
    assert set(drawn) == {"ucb_search.png", "ucb_episodes.png", "ucb_episode_task1.gif"}
    assert drawn["ucb_episode_task1.gif"].shape[-2] > 900  # three panels: another order, too
    for picture in drawn.values():
        assert min(picture.shape[-3:-1]) > 100
        assert np.ptp(picture) > 0
