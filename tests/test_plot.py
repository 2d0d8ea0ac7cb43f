"""Figures: what is drawn where, on handmade data."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fakes import FakeResults, player
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from envs.base import Episode, Trajectory
from envs.drawing import Film, Pictures, spread_apart, video, write_films
from envs.maze import pictures as maze
from envs.maze.env import NORTH, MazeRunner, MazeTask
from envs.maze.markers import bar_lanes, place_goals
from experiments import figures
from experiments.figures import offered, rollouts
from mgpo_jax.distributions import Categorical
from mgpo_jax.policy import Policy

SIDE = 7
ENV = MazeRunner(name="tiny", side=SIDE, horizon=6)
PICTURES = maze.maze_pictures(ENV)
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


def north_policy() -> Policy:
    """Always goes north: from the start up four cells, then against the wall."""
    north = Categorical(jnp.where(jnp.arange(5) == NORTH, 50.0, 0.0))
    return Policy(
        prefill=lambda prompt, obs: (north, jnp.zeros(())),
        decode=lambda carry, action, obs: (north, carry),
        grow=lambda carry, num_steps: carry,
        num_slots=3,
    )


PLAY = player(ENV, north_policy())


def fake_results(method: str = "ucb", shift: float = 0.0) -> FakeResults:
    """2 seeds, 2 tasks, 20 episodes, 3 slots; the best prompt gains a waypoint at episode 10."""
    goal = np.array([GOAL], np.float32) / SIDE
    waypoint = np.array([[3, 3]], np.float32) / SIDE
    found = {1: goal, 10: np.concatenate([waypoint, goal])}
    evals = np.array([[[-3.0, -1.0], [-1.0, 0.0]], [[-2.0, -1.0], [-2.0, 1.0]]]) + shift
    return FakeResults(
        tasks=[MazeTask(MAZE, np.array(GOAL)), MazeTask(MAZE, np.array((5, 1)))],
        task_goals=np.array([GOAL, (5, 1)], np.float32) / SIDE,
        found=[found, found],
        eval_episodes=np.array([1, 20]),
        eval_returns=evals,
        optimal_returns=np.array([0.5, 0.7]),
        num_episodes=20,
        max_goals=3,
        method=method,
    )


def drawn(**options):
    """The axes of a drawn maze, and its discs as (label, row, column, color) in their order."""
    ax = Figure().add_subplot()
    maze.draw_maze(ax, MAZE, START, GOAL, **options)
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
    placed = place_goals(cells.astype(np.float32) / np.float32(side), side)
    np.testing.assert_array_equal(placed.cells, cells)
    assert not placed.outside.any()


def test_goals_beyond_any_edge_are_outside():
    goals = [[-0.2, 0.5], [0.5, 1.1], [1.0, 0.5], [0.5, np.nan], [np.inf, 0.5], [1e30, -1e30]]
    assert place_goals(np.array(goals), SIDE).outside.all()
    # The nearest cell counts: half a cell beyond the center of an edge cell is still inside.
    assert not place_goals(np.array([[-0.4, 6.4]]) / SIDE, SIDE).outside.any()


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
    assert bar_lanes(SIDE, [goals]) == 3
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
    points = spread_apart(homes, heavy, gap=1.0, limits=(0.1, 13.9))
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


@pytest.mark.parametrize("paths", [[], [np.array([[29, 15], [27, 15]])]])
def test_goals_in_a_large_maze_are_dots_below_paths(paths):
    side, start, goal = 31, (29, 15), (1, 1)
    goals = np.array([[27, 15], [40, 3], [5, 7], goal]) / side
    ax = Figure().add_subplot()
    maze.draw_maze(ax, np.zeros((side, side)), start, goal, goals, paths=paths)
    dots = [patch for patch in ax.patches if isinstance(patch, Circle) and patch.zorder < 1]
    assert [dot.center for dot in dots] == [(15, 27), (7, 5)]
    assert all(dot.zorder < line.zorder for dot in dots for line in ax.lines if paths)
    (line,) = ax.lines  # without a path, the goals in their order
    if not paths:
        np.testing.assert_array_equal(line.get_ydata(), [29, 27, 5, 1])
    assert {"S", "T", "2"} <= {patch.get_label() for patch in ax.patches}


def test_the_line_of_a_prompt_ends_at_its_last_goal():
    """Which a prompt given by hand need not have at T."""
    side, goals = 31, np.array([[27, 15], [5, 7]])
    ax = Figure().add_subplot()
    maze.draw_maze(ax, np.zeros((side, side)), (29, 15), (1, 1), goals / side)
    (line,) = ax.lines
    np.testing.assert_array_equal(line.get_ydata(), [29, 27, 5])


def test_a_bar_without_goals_is_only_room():
    ax, _ = drawn(prompt_goals=np.array([[3, 1]]) / SIDE, lanes=1)
    assert not any(type(patch) is Rectangle for patch in ax.patches)
    assert ax.get_xlim()[1] > SIDE


def test_a_shortest_path_follows_the_walk_where_it_can():
    walk = np.array([START, (4, 3), (4, 4), (4, 5), (3, 5), (2, 5), GOAL])
    np.testing.assert_array_equal(maze.shortest_path(MAZE, START, GOAL, walk), walk)
    other = maze.shortest_path(MAZE, START, GOAL, walk[:1])
    assert len(other) == len(walk)
    assert (np.abs(np.diff(other, axis=0)).sum(axis=1) == 1).all()
    assert not MAZE[tuple(other.T)].any()
    walled = MAZE.copy()
    walled[3] = 1
    np.testing.assert_array_equal(maze.shortest_path(walled, START, GOAL, walk), [START])


def test_gif_shows_every_step(tmp_path):
    walk = np.array([START, (4, 3), (3, 3), (3, 4), (3, 5)])
    panels = [maze.Panel("", walk[:3]), maze.Panel("a prompt", walk, np.array([[3, 3]]) / SIDE)]
    maze.maze_gif(tmp_path / "walk.gif", MAZE, START, GOAL, panels)
    frames = iio.imread(tmp_path / "walk.gif")
    assert len(frames) == 5  # the start, too
    assert all((one != other).any() for one, other in pairwise(frames))
    left, right = np.split(frames[-3:, 30:, 12:].astype(int), 2, axis=2)
    assert not np.ptp(left[..., :280, :], axis=0).any()  # the shorter episode stands still
    assert np.ptp(right, axis=0).any()


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
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("episodes", "evaluation return")


def test_panels_of_many_worlds_lie_in_rows_of_three():
    worlds = {f"world{index}": {"ucb": fake_results()} for index in range(4)}
    figure = figures.learning_curves(worlds)
    drawn = [ax for ax in figure.axes if ax.axison]
    assert [ax.get_title() for ax in drawn] == list(worlds)
    places = [ax.get_subplotspec() for ax in drawn]
    assert [(at.rowspan.start, at.colspan.start) for at in places] == [
        (0, 0),
        (0, 1),
        (0, 2),
        (1, 0),
    ]
    assert [ax.get_ylabel() != "" for ax in drawn] == [True, False, False, True]
    assert figure.get_figwidth() == pytest.approx(7.5)


def test_what_learns_nothing_is_a_line_over_the_whole_width():
    still = replace(fake_results("gcbc"), eval_episodes=np.array([0, 1]), num_episodes=1)
    (ax,) = figures.learning_curve({"gcbc": still, "plan": fake_results("plan")}).axes
    lines = {line.get_label(): line for line in ax.lines}
    assert lines["GC-BC"].get_xdata() == [0, 1]  # shares of the width
    np.testing.assert_allclose(lines["GC-BC"].get_ydata(), -0.25)
    assert len(lines) == 3  # the optimum, too


def test_a_line_of_one_seed_is_marked_and_none_hides_its_equal():
    one = replace(fake_results("bbt"), eval_returns=fake_results().eval_returns[:1])
    ax = figures.learning_curve({"ucb": fake_results(), "bbt": one}).axes[0]
    ucb, bbt, _ = ax.lines
    assert (ucb.get_label(), bbt.get_label()) == ("MGPO-UCB", "BBT, one seed")
    assert ucb.get_linewidth() > bbt.get_linewidth()
    assert bbt.get_markerfacecolor() == "white"
    alone = figures.learning_curve({"bbt": one}).axes[0]
    assert alone.lines[0].get_label() == "BBT"


def test_no_line_of_an_unknown_optimum():
    unknown = replace(fake_results(), optimal_returns=np.full(2, np.nan))
    (ax,) = figures.learning_curve({"ucb": unknown}).axes
    assert [line.get_label() for line in ax.lines] == ["MGPO-UCB"]


def test_training_curve_shows_what_was_logged():
    rows = [
        {"step": 10, "train/loss": 1.5, "val/loss": 1.6, "eval/initial_return": -6.0},
        {"step": 20, "train/loss": 1.0, "val/loss": 1.2, "eval/initial_return": -4.0},
    ]
    losses, returns = figures.training_curve(rows, "a random skill").axes
    assert [line.get_label() for line in returns.lines] == ["a random skill"]
    curves = [line.get_xydata().tolist() for line in (*losses.lines, *returns.lines)]
    assert curves == [[[10, 1.5], [20, 1.0]], [[10, 1.6], [20, 1.2]], [[10, -6], [20, -4]]]


def test_repeated_and_unknown_methods_get_colors_of_their_own():
    labels = ["ucb (a)", "ucb (b)", "bpe", "other"]
    styles = figures.method_styles(labels)
    assert styles["ucb (a)"][:2] == ("MGPO-UCB (a)", figures.METHODS["ucb"][1])
    assert len({style[1] for style in styles.values()}) == 4
    assert len({style[1] for style in figures.METHODS.values()}) == len(figures.METHODS)


FOREIGN = {
    "a formula": (r"\frac{$ $x_1$", r"\frac{$ $x_1$"),
    "one dollar": ("a$b", "a$b"),
    "a line break": ("a\nb", r"a\nb"),
    "an escape": ("\x1b[31mred", r"\x1b[31mred"),
    "long": ("x" * 300, "x" * 28 + "..." + "x" * 28),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_names_from_files_are_shown_as_they_are(name, tmp_path):
    """In titles and legends, and never as a formula; drawing the figure would fail on a broken one."""
    text, shown = FOREIGN[name]
    result = fake_results(text.replace(" ", ""))
    figure = figures.learning_curve({text: result}, text)
    figure.savefig(tmp_path / "curve.png")
    label = figure.legends[0].get_texts()[0]
    assert label._preprocess_math(label.get_text()) == (shown, False)
    title, is_math = label._preprocess_math(figure.get_suptitle())
    assert not is_math
    lines = title.split("\n")  # a long title has two, each shorter than the figure is wide
    assert title == shown or (name == "long" and len(lines) == 2 and max(map(len, lines)) < 80)
    width, height = iio.imread(tmp_path / "curve.png").shape[:2]
    assert max(width, height) < 2000


def test_a_place_from_a_file_is_not_imported():
    """Importing the module would fail."""
    (look,) = figures.method_styles(["no_such_module:METHOD"]).values()
    assert look.name == "no_such_module:METHOD"


def test_nothing_is_drawn_before_it_is_written(monkeypatch, tmp_path):
    drawn = []
    for name in ("prompts", "evolution", "short_and_long", "episodes", "video"):
        monkeypatch.setattr(offered, name, lambda *args, name=name: drawn.append(name) or Figure())
    results = {"ucb": fake_results()}
    planned = list(figures.figures_of_results(PICTURES, results, lambda result: PLAY, (1,), 0))
    assert len(planned) == 5
    assert drawn == []
    write_all(tmp_path, planned[:1])
    assert drawn == ["prompts"]


def test_final_prompts_of_all_methods_share_a_maze():
    results = {"ucb": fake_results(), "bbt": fake_results("bbt")}
    beyond = np.array([[9.0, 9.0], *results["bbt"].best_goals(0, 0)[1:]])
    results["bbt"].found = [{1: beyond}, {1: beyond}]
    figure = rollouts.prompts(PICTURES, results, which=(0, 1))
    assert len(figure.axes) == 2
    discs = discs_of(figure.axes[0])
    assert [disc[:3] for disc in discs[:1]] == [("1", 3, 3)]
    assert discs[1][0] == "1"
    assert discs[1][2] > SIDE - 0.5  # in the bar
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["MGPO-UCB", "BBT"]


def test_episodes_of_methods_stand_in_rows(key):
    results = {"ucb": fake_results(), "bbt": fake_results("bbt")}
    players = dict.fromkeys(results, PLAY)
    figure = rollouts.methods(PICTURES, results, players, (0, 1), 0, key)
    assert [ax.get_ylabel() for ax in figure.axes] == ["MGPO-UCB", "", "BBT", ""]
    minus = "return \N{MINUS SIGN}0.60"
    assert [ax.get_title() for ax in figure.axes] == [
        f"task 0 (optimum 0.50)\n{minus}",
        f"task 1 (optimum 0.70)\n{minus}",
        minus,
        minus,
    ]
    walked, shortest = figure.axes[0].lines
    assert len(walked.get_xydata()) == 7  # six steps
    assert len(shortest.get_xydata()) == 7


def test_visits_are_counted_per_episode(key):
    task = fake_results().task(0)
    played = PLAY(key, task, fake_results().best_goals(0, 0), 4, False)
    expected = np.zeros((SIDE, SIDE))
    expected[5:0:-1, 3] = [1, 1, 1, 1, 3]  # four steps up, the last two against the wall
    np.testing.assert_allclose(maze.visit_counts(played, MAZE, START), expected)


def test_visits_and_walks_end_with_their_episodes():
    goals = np.array([[[4, 3], [3, 3]], [[4, 3], [0, 0]]]) / SIDE
    trajectory = Trajectory(goals, None, goals, None, goals, np.array([2, 1]))
    played = Episode(trajectory, None, np.zeros(2), None)
    counts = maze.visit_counts(played, MAZE, START)
    assert {tuple(cell): counts[tuple(cell)] for cell in np.argwhere(counts)} == {
        (3, 3): 0.5,
        (4, 3): 1.0,
        START: 1.0,
    }
    short = played._replace(trajectory=jax.tree.map(lambda leaf: leaf[1], trajectory))
    np.testing.assert_array_equal(maze.walk_of(short, SIDE, START), [START, (4, 3)])


def test_evolution_shows_the_stages_there_are(key):
    results = fake_results()
    figure = rollouts.evolution(PICTURES, results, PLAY, 0, 0, key, stages=(1, 10, 40))
    mazes = [ax for ax in figure.axes if ax.images]
    # 6 steps at -0.1; episode 40 lies beyond the 20 of the results.
    assert [ax.get_title() for ax in mazes] == [
        "1 episode  (return \N{MINUS SIGN}0.60)",
        "10 episodes  (return \N{MINUS SIGN}0.60)",
    ]
    assert [[disc[:3] for disc in discs_of(ax)] for ax in mazes] == [[], [("1", 3, 3)]]
    (bar,) = [ax for ax in figure.axes if not ax.images]
    assert bar.get_ylabel() == "visits in an episode"


def test_short_prompts_stand_above_long_ones(key):
    figure = rollouts.short_and_long(PICTURES, fake_results(), PLAY, (0, 1), key)
    mazes = [ax for ax in figure.axes if ax.images]
    assert [ax.get_title().split("  ")[0] for ax in mazes] == ["1 goal"] * 2 + ["3 goals"] * 2
    for above, below in zip(mazes[:2], mazes[2:], strict=True):
        assert discs_of(above) == []
        assert [disc[0] for disc in discs_of(below)] == ["1", "2"]
        # Waypoints come from the trajectory: up the middle column.
        assert all(abs(disc[2] - 3) < 1.5 for disc in discs_of(below))


A, B, C, END = np.eye(4, dtype=np.float32)


@pytest.mark.parametrize(
    ("goals", "other"),
    [
        ((A, B, END), (B, A, END)),
        ((A, B, C, END), (C, B, A, END)),
        ((A, A, B, END), (B, A, A, END)),
        ((A, B, A, END), (B, A, A, END)),  # the reverse is the same
        ((A, B, B, A, END), (B, B, A, A, END)),
        ((A, END, END), (END, A, END)),
        ((A, A, END), None),
        ((A, END), None),
        ((END,), None),
    ],
)
def test_the_same_goals_in_another_order(goals, other):
    found = rollouts.in_another_order(np.stack(goals))
    if other is None:
        assert found is None
    else:
        np.testing.assert_array_equal(found, np.stack(other))


def write_all(folder, drawn):
    """Write figures into a folder; returns their names."""
    names = []
    for name, save in drawn:
        save(folder / name)
        names.append(name)
    return names


def test_everything_that_a_world_draws(tmp_path):
    results = {"ucb": fake_results(), "ucb (again)": fake_results(), "bbt": fake_results("bbt")}
    drawn = figures.figures_of_results(PICTURES, results, lambda result: PLAY, (1,), 0)
    methods = ("ucb", "ucb_1", "bbt")
    assert set(write_all(tmp_path, drawn)) == {
        "prompts.png",
        "methods.png",
        "short_and_long.png",
        *(f"{method}_evolution_task1.png" for method in methods),
        *(f"{method}_episodes.png" for method in methods),
        *(f"{method}_episode_task1.gif" for method in methods),
    }
    picture = iio.imread(tmp_path / "prompts.png")
    assert min(picture.shape[:2]) > 100
    assert np.ptp(picture) > 0


def test_what_is_drawn_right_after_an_adaptation(tmp_path):
    drawn = figures.figures_of_run(PICTURES, fake_results(), (0, 1))
    assert write_all(tmp_path, drawn) == ["prompts.png"]


def refuse(result):
    raise AssertionError("no policy is needed")


@pytest.mark.parametrize("offered", [Pictures(), PICTURES])
def test_nothing_of_worlds_without_pictures_and_methods_without_prompts(offered):
    result = fake_results() if offered == Pictures() else replace(fake_results(), found=None)
    assert not list(figures.figures_of_run(offered, result, (0,)))
    assert not list(figures.figures_of_results(offered, {"a": result}, refuse, (0,), 0))


def test_methods_without_prompts_stand_aside(tmp_path):
    results = {"gcbc": replace(fake_results("gcbc"), found=None), "ucb": fake_results()}
    only_prompts = Pictures(prompts=PICTURES.prompts)
    drawn = figures.figures_of_results(only_prompts, results, refuse, (0,), 0)
    assert write_all(tmp_path, drawn) == ["prompts.png"]


@pytest.mark.parametrize("another_order", [False, True])
def test_a_video_shows_another_order_where_the_world_asks_for_it(another_order, tmp_path):
    goal = np.array([GOAL], np.float32) / SIDE
    goals = np.concatenate([np.array([[3, 3], [1, 1]], np.float32) / SIDE, goal])
    result = replace(fake_results(), found=[{1: goals}] * 2)
    played = []

    def play(key, task, goals, num, judged):
        assert (num, judged) == (1, True)
        played.append(goals)
        return PLAY(key, task, goals, num, judged)

    drawn = []
    offered = Pictures(
        video=lambda path, task, shown: drawn.extend(shown), another_order=another_order
    )
    ((name, save),) = figures.figures_of_results(offered, {"ucb": result}, lambda _: play, (0,), 0)
    save(tmp_path / name)
    titles = ["Initial prompt", "Optimized prompt", "The same goals in another order"]
    prompts = [goal, goals, goals[[1, 0, 2]]]
    num = 2 + another_order
    assert [each.title for each in drawn] == [
        f"{title}, return \N{MINUS SIGN}0.60" for title in titles[:num]
    ]
    for each, asked, wanted in zip(drawn, played, prompts[:num], strict=True):
        np.testing.assert_array_equal(each.goals, wanted)
        np.testing.assert_array_equal(asked, wanted)


def test_titles_of_films_fit_above_them(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(video, "write_gif", lambda path, figure, *more: kept.append(figure))
    title = "The same goals in another order, return \N{MINUS SIGN}23.81"
    for width in (100, 200, 288):
        pixels = np.zeros((1, 200, width, 3), np.uint8)
        film = Film(title, 1, lambda times, pixels=pixels: pixels, lambda time: "step 1")
        write_films(tmp_path / "films.gif", [film] * 3)
        boxes = [ax.title.get_window_extent() for ax in kept[-1].axes]
        assert all(one.x1 < other.x0 for one, other in pairwise(boxes))
        assert all(box.y1 < kept[-1].bbox.y1 for box in boxes)


def test_a_world_that_draws_only_frames_gets_videos(tmp_path):
    def frame(obs):
        """The cell of the agent in white, on gray ground of 2 pixels a cell."""
        picture = np.full((SIDE, SIDE, 3), 100, np.uint8)
        picture[tuple(np.rint(obs[:2] * SIDE).astype(int))] = 255
        return picture.repeat(2, axis=0).repeat(2, axis=1)

    drawn = figures.figures_of_results(
        Pictures(frame=frame), {"ucb": fake_results()}, lambda result: PLAY, (0, 1), 0
    )
    assert write_all(tmp_path, drawn) == ["ucb_episode_task0.gif"]
    video = iio.imread(tmp_path / "ucb_episode_task0.gif").astype(int)
    # The start and four steps to the north; the two steps against the wall show in the caption.
    assert len(video) == ENV.horizon + 1
    height = video.shape[1]
    assert height > 200
    for half in np.split(video, 2, axis=2):
        # Below the title and above the caption.
        rows = [np.argwhere((image[40:-40, 5:-5] > 200).all(axis=-1))[:, 0] for image in half]
        means = [row.mean() for row in rows]
        assert np.all(np.diff(means[:5]) < -10)
        assert np.ptp(means[4:]) < 1
