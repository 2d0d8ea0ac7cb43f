"""Pictures: what is drawn where, on data made by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

import envs
from envs import render
from envs.maze_runner import NORTH, MazeRunner
from experiments import figures, plot
from experiments import results as results_module
from experiments.figures import base, maze
from mgpo_jax.distributions import Categorical
from mgpo_jax.errors import DataError, UsageError
from mgpo_jax.policy import Policy

SIDE = 7
ENV = MazeRunner(name="tiny", side=SIDE, horizon=6)
MAZE = np.array(
    [
        [1, 1, 1, 1, 1, 1, 1],
        [1, 0, 0, 0, 0, 0, 1],
        [1, 0, 1, 0, 1, 0, 1],
        [1, 0, 1, 0, 0, 0, 1],
        [1, 0, 0, 0, 0, 0, 1],
        [1, 0, 1, 0, 1, 0, 1],
        [1, 1, 1, 1, 1, 1, 1],
    ]
)
START, GOAL = (5, 3), (1, 5)


class Plain(envs.Environment):
    """A world without pictures."""

    spec = ENV.spec


@pytest.fixture(autouse=True)
def tiny_world(monkeypatch):
    """The world that the results below name."""
    monkeypatch.setitem(envs.ENVIRONMENTS, "tiny", lambda: ENV)


def north_policy() -> Policy:
    """Always goes north: from the start up four cells, then against the wall."""
    north = Categorical(jnp.where(jnp.arange(5) == NORTH, 50.0, 0.0))
    return Policy(
        prefill=lambda prompt, obs: (north, jnp.zeros(())),
        decode=lambda carry, action, obs: (north, carry),
        grow=lambda carry, num_steps: carry,
        num_slots=3,
    )


NORTHWARD = north_policy()


def fake_results(bandit: str = "ucb", shift: float = 0.0) -> results_module.Results:
    """2 seeds, 2 tasks, 20 episodes, 3 slots; the best prompt gains a waypoint at episode 10."""
    shape = (2, 2, 20, 3)
    masks = np.zeros(shape, bool)
    masks[..., -1] = True
    masks[:, :, 9:, -2] = True
    goals = np.zeros((*shape, 2), np.float32)
    goals[..., -1, :] = np.array(GOAL) / SIDE
    goals[:, :, 9:, -2, :] = np.array([3, 3]) / SIDE
    evals = np.array([[[-3.0, -1.0], [-1.0, 0.0]], [[-2.0, -1.0], [-2.0, 1.0]]]) + shift
    return results_module.Results(
        returns=np.full(shape[:3], -1.0, np.float32),
        greedy=np.ones(shape[:3], bool),
        prompt_goals=goals,
        prompt_masks=masks,
        best_goals=goals,
        best_masks=masks,
        eval_episodes=np.array([1, 20]),
        eval_returns=evals.astype(np.float32),
        optimal_returns=np.array([0.5, 0.7], np.float32),
        tasks={"maze": np.stack([MAZE, MAZE]), "goal": np.array([GOAL, (5, 1)])},
        config={"env": "tiny", "bandit": bandit, "policy": None},
        summary={},
    )


def save_results(folder: Path, results: results_module.Results) -> Path:
    folder.mkdir(parents=True)
    np.savez(
        folder / "results.npz", **{name: getattr(results, name) for name in results_module.AXES}
    )
    np.savez(folder / "tasks.npz", **results.tasks)
    (folder / "config.json").write_text(json.dumps(results.config))
    (folder / "summary.json").write_text("{}")
    return folder


def drawn(**options):
    """The axes of a drawn maze, and its discs as (label, row, column, color) in their order."""
    ax = Figure().add_subplot()
    render.draw_maze(ax, MAZE, START, GOAL, **options)
    return ax, discs_of(ax)


def discs_of(ax):
    patches = list(ax.patches)
    return [
        (letter.get_label(), shape.center[1], shape.center[0], shape.get_facecolor())
        for shape, letter in pairwise(patches)
        if isinstance(shape, Circle)
    ]


def luminance(color) -> float:
    return float(np.dot(np.asarray(color)[:3], (0.299, 0.587, 0.114)))


@pytest.mark.parametrize("side", [15, 31])
def test_every_cell_is_found_again_from_its_goal(side):
    cells = np.argwhere(np.ones((side, side)))
    placed = render.place_goals(cells.astype(np.float32) / np.float32(side), side)
    np.testing.assert_array_equal(placed.cells, cells)
    assert not placed.outside.any()


def test_goals_beyond_any_edge_are_outside():
    goals = [[-0.2, 0.5], [0.5, 1.1], [1.0, 0.5], [0.5, np.nan], [np.inf, 0.5], [1e30, -1e30]]
    assert render.place_goals(np.array(goals), SIDE).outside.all()
    # The nearest cell counts: half a cell beyond the center of an edge cell is still inside.
    assert not render.place_goals(np.array([[-0.4, 6.4]]) / SIDE, SIDE).outside.any()


def test_goals_are_numbered_discs_in_their_cells():
    goals = np.array([[3, 1], [1, 3], GOAL]) / SIDE
    ax, discs = drawn(prompt_goals=goals)
    # The last goal is T itself and not repeated.
    assert [(label, row, column) for label, row, column, _ in discs] == [("1", 3, 1), ("2", 1, 3)]
    letters = {patch.get_label() for patch in ax.patches}
    assert {"S", "T", "1", "2"} <= letters
    assert "3" not in letters
    assert not any(type(patch) is Rectangle for patch in ax.patches)  # no bar without need
    assert len(ax.get_xticks()) == len(ax.get_yticks()) == 0


def test_a_last_goal_away_from_the_task_goal_is_drawn():
    _, discs = drawn(prompt_goals=np.array([[3, 1]]) / SIDE)
    assert [disc[:3] for disc in discs] == [("1", 3, 1)]


def test_goals_outside_the_maze_go_to_the_bar():
    goals = np.array([[3, 1], [9, 2], [1, 3], [2, -4]]) / SIDE
    ax, discs = drawn(prompt_goals=goals)
    (bar,) = [patch for patch in ax.patches if type(patch) is Rectangle]
    left, right = bar.get_x(), bar.get_x() + bar.get_width()
    assert left > SIDE - 0.5
    assert right <= ax.get_xlim()[1] + 1e-9
    in_bar = [label for label, _, column, _ in discs if left < column < right]
    assert in_bar == ["2", "4"]
    rows = [row for label, row, _, _ in discs if label in in_bar]
    assert rows == sorted(rows)
    assert rows[1] - rows[0] > 1.2  # not on top of each other


def test_a_crowded_bar_gets_more_lanes():
    goals = np.full((12, 2), 2.0)
    _, discs = drawn(prompt_goals=goals)
    assert len({(row, column) for _, row, column, _ in discs}) == 12
    assert render.bar_lanes(SIDE, [goals]) == 3
    assert all(-0.5 < row < SIDE - 0.5 for _, row, _, _ in discs)


def test_prompts_keep_their_colors():
    prompts = {"#0072B2": np.array([[3, 1]]) / SIDE, "#D55E00": np.array([[1, 1]]) / SIDE}
    _, discs = drawn(prompt_goals=prompts)
    by_row = {row: color for _, row, _, color in discs}
    assert by_row[3][2] > by_row[3][0]  # blue
    assert by_row[1][0] > by_row[1][2]  # vermilion


def test_markers_in_one_cell_stay_near_it_without_hiding_each_other():
    homes = np.array([[5.0, 5.0]] * 4 + [[12.0, 3.0]])
    heavy = np.array([True, False, False, False, False])
    points = render.spread_apart(homes, heavy, gap=1.0, limits=(0.1, 13.9))
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1) + 9 * np.eye(5)
    assert apart.min() > 0.9
    assert np.linalg.norm(points - homes, axis=1).max() < 1.5
    assert np.linalg.norm(points[0] - homes[0]) < 0.3
    np.testing.assert_array_equal(points[4], homes[4])


def test_more_visits_are_darker_and_walls_stay_walls():
    visits = np.zeros((SIDE, SIDE))
    visits[1, 1:4] = [1, 2, 8]
    visits[0, 0] = 5  # a wall
    ax, _ = drawn(visits=visits)
    colors = ax.images[0].get_array()
    shades = [luminance(colors[1, column]) for column in (4, 1, 2, 3)]  # 0, 1, 2, 8 visits
    assert shades == sorted(shades, reverse=True)
    assert len(set(shades)) == 4
    np.testing.assert_array_equal(colors[0, 0], colors[0, 1])
    np.testing.assert_array_equal(colors[1, 4], colors[3, 1])  # both free and unvisited


def test_paths_are_drawn_along_cells():
    ax, _ = drawn(paths=[np.array([[5, 3], [4, 3], [4, 4]])])
    (line,) = ax.lines
    np.testing.assert_array_equal(line.get_xydata(), [[3, 5], [3, 4], [4, 4]])  # x is the column


def test_gif_shows_every_step(tmp_path):
    walk = np.array([[4, 3], [3, 3], [3, 4], [3, 5]])
    render.maze_gif(tmp_path / "walk.gif", MAZE, START, GOAL, walk, np.array([[3, 3]]) / SIDE)
    frames = iio.imread(tmp_path / "walk.gif")
    assert len(frames) == 5  # the start, too
    assert all((one != other).any() for one, other in pairwise(frames))


def test_learning_curve_is_mean_over_tasks_and_std_over_seeds():
    figure = figures.learning_curve({"ucb": fake_results(), "bbt": fake_results("bbt", shift=-1)})
    (ax,) = figure.axes
    lines = {line.get_label(): line for line in ax.lines}
    assert set(lines) == {"MGPO-UCB", "BBT", "optimum"}
    # Seed means are (-2, -0.5) and (-2, 0).
    np.testing.assert_allclose(lines["MGPO-UCB"].get_xydata(), [[1, -2], [20, -0.25]])
    np.testing.assert_allclose(lines["BBT"].get_ydata(), [-3, -1.25])
    np.testing.assert_allclose(lines["optimum"].get_ydata(), 0.6, rtol=1e-6)
    corners = ax.collections[0].get_paths()[0].vertices
    assert corners[:, 1].max() == pytest.approx(0.0)
    assert corners[corners[:, 0] == 20, 1].min() == pytest.approx(-0.5)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("episodes", "return of the optimized prompt")


def test_training_curve_shows_what_was_logged(tmp_path):
    rows = [
        {"step": 10, "train/loss": 1.5, "val/loss": 1.6, "eval/initial_return": -6.0},
        {"step": 20, "train/loss": 1.0, "val/loss": 1.2, "eval/initial_return": -4.0},
    ]
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    losses, returns = figures.training_curve(path).axes
    curves = [line.get_xydata().tolist() for line in (*losses.lines, *returns.lines)]
    assert curves == [[[10, 1.5], [20, 1.0]], [[10, 1.6], [20, 1.2]], [[10, -6], [20, -4]]]
    path.write_text("{")
    with pytest.raises(DataError, match=r"metrics\.jsonl is missing or not readable"):
        figures.training_curve(path)


def test_repeated_and_unknown_methods_get_colors_of_their_own():
    labels = ["ucb (a)", "ucb (b)", "bpe", "other"]
    styles = figures.method_styles(labels)
    assert styles["ucb (a)"][:2] == ("MGPO-UCB (a)", figures.METHODS["ucb"][1])
    assert len({style[1] for style in styles.values()}) == 4
    assert len({style[1] for style in figures.METHODS.values()}) == len(figures.METHODS)


def test_final_prompts_of_all_methods_share_a_maze():
    results = {"ucb": fake_results(), "bbt": fake_results("bbt")}
    results["bbt"].best_goals[:, :, -1, -2] = [9.0, 9.0]
    figure = maze.prompts_on_mazes(results, results["ucb"].tasks, which=(0, 1))
    assert len(figure.axes) == 2
    discs = discs_of(figure.axes[0])
    assert [disc[:3] for disc in discs[:1]] == [("1", 3, 3)]
    assert discs[1][0] == "1"
    assert discs[1][2] > SIDE - 0.5  # in the bar
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["MGPO-UCB", "BBT"]


def test_visits_are_counted_per_episode(key):
    task = maze.task_at(fake_results().tasks, 0)
    prompt = fake_results().best_prompt(0, 0)
    counts = maze.visit_counts(base.run_policy(key, ENV, NORTHWARD, task, prompt), MAZE)
    expected = np.zeros((SIDE, SIDE))
    expected[5:0:-1, 3] = [1, 1, 1, 1, 3]  # four steps up, the last two against the wall
    np.testing.assert_allclose(counts, expected)


def test_evolution_shows_the_stages_there_are(key):
    figure = maze.evolution(ENV, NORTHWARD, fake_results(), 0, stages=(1, 10, 40), key=key)
    mazes = [ax for ax in figure.axes if ax.images]
    # 6 steps at -0.1; episode 40 lies beyond the 20 of the results.
    assert [ax.get_title() for ax in mazes] == [
        "1 episode  (return \N{MINUS SIGN}0.60)",
        "10 episodes  (return \N{MINUS SIGN}0.60)",
    ]
    assert [[disc[:3] for disc in discs_of(ax)] for ax in mazes] == [[], [("1", 3, 3)]]


def test_short_prompts_stand_above_long_ones(key):
    figure = maze.short_and_long(ENV, NORTHWARD, fake_results().tasks, key)
    mazes = [ax for ax in figure.axes if ax.images]
    assert [ax.get_title().split("  ")[0] for ax in mazes] == ["1 goal"] * 2 + ["3 goals"] * 2
    for above, below in zip(mazes[:2], mazes[2:], strict=True):
        assert discs_of(above) == []
        assert [disc[0] for disc in discs_of(below)] == ["1", "2"]
        # Waypoints come from the trajectory: up the middle column.
        assert all(abs(disc[2] - 3) < 1.5 for disc in discs_of(below))


def test_results_survive_the_disk(tmp_path):
    results = fake_results()
    loaded = results_module.load_results(save_results(tmp_path / "run", results))
    jax.tree.map(
        np.testing.assert_array_equal, loaded._replace(config={}), results._replace(config={})
    )
    assert loaded.config == results.config


def rewrite(name, **changes):
    def damage(folder):
        with np.load(folder / name) as file:
            arrays = dict(file)
        for key, value in changes.items():
            arrays.pop(key, None)
            if value is not None:
                arrays[key] = value
        np.savez(folder / name, **arrays)

    return damage


def overwrite(name, content):
    return lambda folder: (folder / name).write_bytes(content)


def truncate(folder):
    path = folder / "results.npz"
    path.write_bytes(path.read_bytes()[:-200])


DAMAGES = {
    "no arrays": (lambda folder: (folder / "results.npz").unlink(), r"results\.npz is missing"),
    "no tasks": (lambda folder: (folder / "tasks.npz").unlink(), r"tasks\.npz is missing"),
    "no config": (lambda folder: (folder / "config.json").unlink(), r"config\.json is missing"),
    "cut": (truncate, r"results\.npz is not a readable npz"),
    "empty": (overwrite("tasks.npz", b""), r"tasks\.npz is not a readable npz"),
    "no JSON": (overwrite("summary.json", b"{"), r"summary\.json is not readable JSON"),
    "no text": (overwrite("config.json", b"\xff\xfe"), r"config\.json is not readable JSON"),
    "a list": (overwrite("config.json", b"[]"), r"config\.json does not hold a JSON object"),
    "no method": (overwrite("config.json", b'{"env": "tiny"}'), "does not name the bandit"),
    "lacks": (rewrite("results.npz", best_goals=None), "lacks best_goals"),
    "axes": (
        rewrite("results.npz", best_masks=np.ones((2, 2, 20, 4), bool)),
        r"best_masks has shape \[2, 2, 20, 4\], which does not fit the axes SNEP \(.*P 3",
    ),
    "rank": (rewrite("results.npz", optimal_returns=np.float32(1)), "optimal_returns has shape"),
    "NaN": (rewrite("results.npz", eval_returns=np.full((2, 2, 2), np.nan)), "eval_returns holds"),
    "other tasks": (rewrite("tasks.npz", goal=np.zeros((3, 2))), r"goal has shape \[3, 2\].* 2 t"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_broken_results_are_named(tmp_path, name):
    damage, message = DAMAGES[name]
    folder = save_results(tmp_path / "run", fake_results())
    damage(folder)
    with pytest.raises(DataError, match=message):
        results_module.load_results(folder)


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(DataError, match="no result folder"):
        results_module.load_results(tmp_path / "nowhere")


@pytest.fixture
def no_checkpoint(monkeypatch):
    """The command with a policy made by hand."""
    monkeypatch.setattr(plot, "_load", lambda result: NORTHWARD)


def test_command_draws_everything(tmp_path, no_checkpoint):
    runs = tuple(
        save_results(tmp_path / name, fake_results(bandit))
        for name, bandit in (("a", "ucb"), ("b", "bbt"))
    )
    plot.main(plot.PlotConfig(runs=runs, out=tmp_path / "out", tasks=(1,)))
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "tiny_learning_curve.png",
        "tiny_prompts.png",
        "tiny_short_and_long.png",
        *(f"tiny_{bandit}_evolution_task1.png" for bandit in ("ucb", "bbt")),
        *(f"tiny_{bandit}_episode_task1.gif" for bandit in ("ucb", "bbt")),
    }
    picture = iio.imread(tmp_path / "out" / "tiny_prompts.png")
    assert min(picture.shape[:2]) > 100
    assert np.ptp(picture) > 0


def test_an_adaptation_draws_into_its_own_folder(tmp_path):
    folder = save_results(tmp_path / "run", fake_results())
    plot.draw_run(folder)
    assert {path.name for path in folder.glob("*.png")} == {"learning_curve.png", "prompts.png"}


def test_worlds_without_pictures_get_curves_only(tmp_path, monkeypatch):
    monkeypatch.setitem(envs.ENVIRONMENTS, "tiny", Plain)
    results = fake_results()._replace(tasks={"order": np.zeros((2, 4))})
    run = save_results(tmp_path / "run", results)
    plot.main(plot.PlotConfig(runs=(run,), out=tmp_path / "out"))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["tiny_learning_curve.png"]


def test_command_refuses_what_it_cannot_draw(tmp_path, no_checkpoint):
    run = save_results(tmp_path / "run", fake_results())
    other = fake_results()._replace(tasks={"maze": np.stack([MAZE.T] * 2), "goal": np.ones((2, 2))})
    elsewhere = save_results(tmp_path / "other", other)
    for config, message in (
        (plot.PlotConfig(), "no result folder given"),
        (plot.PlotConfig(runs=(run, elsewhere)), "different tasks"),
        (plot.PlotConfig(runs=(run,), seed=2), "--seed 2: .* has 2 seeds"),
        (plot.PlotConfig(runs=(run,), tasks=(7,)), "tasks 0 to 1"),
    ):
        with pytest.raises(UsageError, match=message):
            plot.main(replace(config, out=tmp_path / "out"))
