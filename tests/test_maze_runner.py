"""The maze world: hand-drawn golden cases, and generated mazes against the classic procedure."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest

from envs.base import Environment
from envs.maze import MAZE15 as MAZE15_WORLD
from envs.maze import MAZE30 as MAZE30_WORLD
from envs.maze.env import (
    EAST,
    GOAL_REWARD,
    NORTH,
    SOUTH,
    STAY,
    STEP_PENALTY,
    WEST,
    MazeRunner,
    MazeTask,
    cells_in_sight,
    generate_maze,
)
from envs.wrappers import Noisy

TINY = MazeRunner(name="tiny", side=7, horizon=12)
MAZE15 = MazeRunner(name="maze15", side=15, horizon=64)
# The usual mazes are full of walls; few islands and short walks show more of the procedure.
SPARSE = {"complexity": 0.05, "density": 0.3}

# S is the start, G the goal.
TINY_MAP = """
#######
#....G#
#.###.#
#...#.#
#.#.#.#
#.#S#.#
#######
"""
# The only way: 2 north, 2 west, 2 north, 4 east.
TINY_WAY = [NORTH] * 2 + [WEST] * 2 + [NORTH] * 2 + [EAST] * 4

MAP15 = """
###############
#.....#G......#
#.###.#.#####.#
#...#.#.....#.#
###.#.#####.#.#
#...#.....#.#.#
#.#######.#.#.#
#.....#...#...#
#####.#.#####.#
#.............#
#.............#
#.....#.#.....#
#.....#.#.....#
#.....#S#.....#
###############
"""


def parse(drawing: str) -> MazeTask:
    cells = np.array([list(line) for line in drawing.split()])
    goal = np.argwhere(cells == "G")[0]
    return MazeTask(jnp.asarray(cells == "#", jnp.int32), jnp.asarray(goal, jnp.int32))


def free_graph(maze: np.ndarray) -> nx.Graph:
    """The free cells of a maze and the steps between them."""
    graph = nx.grid_2d_graph(*maze.shape)
    graph.remove_nodes_from(map(tuple, np.argwhere(maze)))
    return graph


@partial(jax.jit, static_argnums=0)
def walk(env, task, actions):
    """The time step of the reset, then states and time steps after each action."""
    state, first = env.reset(jax.random.key(0), task)

    def step(state, action):
        state, timestep = env.step(state, action)
        return state, (state.position, timestep)

    return first, *jax.lax.scan(step, state, actions)[1]


def walk_tiny(task, actions):
    """A walk on the tiny maze; padded to one length so that it compiles once."""
    padded = jnp.asarray(actions + [STAY] * (16 - len(actions)))
    first, positions, steps = walk(TINY, task, padded)
    return first, np.asarray(positions), jax.tree.map(np.asarray, steps)


@partial(jax.jit, static_argnums=(0, 1))
def sample_tasks(env, num):
    return jax.vmap(env.sample_task)(jax.random.split(jax.random.key(7), num))


@pytest.fixture(scope="module")
def tiny_tasks():
    return jax.tree.map(np.asarray, sample_tasks(TINY, 2000))


@pytest.fixture(scope="module")
def tasks15():
    return jax.tree.map(np.asarray, sample_tasks(MAZE15, 500))


@pytest.fixture(scope="module")
def mazes(tiny_tasks, tasks15):
    """Generated mazes: the usual ones of two sizes, and sparse ones."""
    generate = partial(generate_maze, side=11, **SPARSE)
    keys = jax.random.split(jax.random.key(3), 3000)
    return {
        "tiny": tiny_tasks.maze,
        "maze15": tasks15.maze,
        "sparse": np.asarray(jax.jit(jax.vmap(generate))(keys)),
    }


optimal_return = jax.jit(lambda env, task: env.optimal_return(task), static_argnums=0)


class TestObservation:
    def test_rays_of_the_tiny_maze(self):
        """Row, column, then free cells to the west, north, east, south; counted by eye."""
        first, _, steps = walk_tiny(parse(TINY_MAP), TINY_WAY)
        np.testing.assert_allclose(first.obs * 7, [5, 3, 0, 2, 0, 0], atol=1e-5)
        by_eye = {
            0: [4, 3, 0, 1, 0, 1],
            1: [3, 3, 2, 0, 0, 2],
            2: [3, 2, 1, 0, 1, 0],
            3: [3, 1, 0, 2, 2, 2],
            4: [2, 1, 0, 1, 0, 3],
            5: [1, 1, 0, 0, 4, 4],
            6: [1, 2, 1, 0, 3, 0],
            9: [1, 5, 4, 0, 0, 4],
        }
        for time, seen in by_eye.items():
            np.testing.assert_allclose(steps.obs[time] * 7, seen, atol=1e-5, err_msg=f"{time=}")

    def test_rays_of_a_15_maze(self):
        actions = jnp.asarray([NORTH] * 6 + [EAST] * 2)
        first, _, steps = walk(MAZE15, parse(MAP15), actions)
        np.testing.assert_allclose(first.obs * 15, [13, 7, 0, 6, 0, 0], atol=1e-5)
        np.testing.assert_allclose(steps.obs[3] * 15, [9, 7, 6, 2, 6, 4], atol=1e-5)
        np.testing.assert_allclose(steps.obs[7] * 15, [7, 9, 2, 2, 0, 0], atol=1e-5)

    def test_goal_and_outcome_are_the_position(self):
        first, positions, steps = walk_tiny(parse(TINY_MAP), TINY_WAY)
        np.testing.assert_allclose(first.achieved_goal * 7, [5, 3], atol=1e-5)
        np.testing.assert_allclose(steps.achieved_goal * 7, positions, atol=1e-5)
        np.testing.assert_array_equal(steps.achieved_goal, steps.outcome)
        assert first.goal_reached
        assert steps.goal_reached.all()

    def test_cells_in_sight_are_the_cross_of_the_rays(self):
        seen = """
        .......
        .x.....
        .x.....
        .xxx...
        .x.....
        .x.....
        .......
        """
        expected = np.array([list(line) for line in seen.split()]) == "x"
        sight = jax.jit(cells_in_sight)(parse(TINY_MAP).maze, jnp.array([3, 1]))
        np.testing.assert_array_equal(sight, expected)


class TestStep:
    def test_moves(self):
        """The numbers of the actions are part of every dataset."""
        assert (WEST, NORTH, EAST, SOUTH, STAY) == (0, 1, 2, 3, 4)
        actions = [1, 1, 0, 2, 3, 4, 1, 0, 0, 1]
        _, positions, _ = walk_tiny(parse(TINY_MAP), actions)
        expected = [[4, 3], [3, 3], [3, 2], [3, 3], [4, 3], [4, 3], [3, 3], [3, 2], [3, 1], [2, 1]]
        assert positions[:10].tolist() == expected

    @pytest.mark.parametrize("action", [WEST, EAST, SOUTH, STAY])
    def test_walls_stop(self, action):
        _, positions, steps = walk_tiny(parse(TINY_MAP), [action] * 5)
        assert (positions[:5] == [5, 3]).all()
        np.testing.assert_allclose(steps.reward[:5], -0.1)

    def test_reaching_the_goal_terminates_and_absorbs(self):
        _, positions, steps = walk_tiny(parse(TINY_MAP), TINY_WAY + [WEST] * 6)
        np.testing.assert_allclose(steps.reward, [-0.1] * 9 + [0.9] + [0] * 6, atol=1e-6)
        assert steps.terminated.tolist() == [False] * 9 + [True] * 7
        assert not steps.truncated.any()
        assert (positions[9:] == [1, 5]).all()

    def test_the_horizon_truncates_and_absorbs(self):
        """Two detours: after 12 steps it stands next to the goal and gets no further."""
        actions = [WEST, EAST, STAY] + TINY_WAY + [EAST] * 3
        _, positions, steps = walk_tiny(parse(TINY_MAP), actions)
        np.testing.assert_allclose(steps.reward, [-0.1] * 12 + [0] * 4, atol=1e-6)
        assert steps.truncated.tolist() == [False] * 11 + [True] * 5
        assert not steps.terminated.any()
        assert (positions[11:] == [1, 4]).all()

    def test_the_goal_at_the_last_step_terminates(self):
        _, _, steps = walk_tiny(parse(TINY_MAP), [WEST, EAST, *TINY_WAY])
        np.testing.assert_allclose(steps.reward[11], 0.9, atol=1e-6)
        assert steps.terminated[11:].all()
        assert not steps.truncated.any()

    def test_walking_over_other_cells_is_no_goal(self):
        """Standing in the row or the column of the goal is not enough."""
        _, _, steps = walk_tiny(parse(TINY_MAP), TINY_WAY[:9])
        assert steps.achieved_goal[5][0] == parse(TINY_MAP).goal[0] / jnp.float32(7)
        assert not steps.terminated.any()


class TestOptimalReturn:
    def test_golden(self):
        task = parse(TINY_MAP)
        for goal, best in {
            (1, 5): 0.0,  # 10 steps
            (4, 3): 0.9,
            (3, 5): -0.2,  # 12 steps, just in time
            (4, 5): -1.2,  # one step too far
            (2, 3): -1.2,  # a wall
        }.items():
            found = optimal_return(TINY, task._replace(goal=jnp.array(goal)))
            assert found == pytest.approx(best, abs=1e-5), goal
        cut_off = task._replace(maze=task.maze.at[1, 4].set(1))
        assert optimal_return(TINY, cut_off) == pytest.approx(-1.2)

    @pytest.mark.parametrize("world", [MAZE15_WORLD, MAZE30_WORLD], ids=lambda world: world.name)
    def test_its_steps_can_be_told_from_a_return(self, world):
        env = world.make()
        longest = jnp.full(env.horizon, STAY)
        task = jax.tree.map(lambda leaf: leaf[0], sample_tasks(env, 1))
        _, _, steps = walk(env, task, longest)
        assert world.step_cost.num_steps(float(steps.reward.sum())) == np.inf
        shortest = int(env._shortest_path(task))
        assert world.step_cost.num_steps(float(optimal_return(env, task))) == shortest
        at_last = float(GOAL_REWARD - STEP_PENALTY * env.horizon)
        assert world.step_cost.num_steps(at_last) == env.horizon

    def test_matches_networkx_and_the_known_mean(self, tasks15):
        returns = np.asarray(jax.jit(jax.vmap(MAZE15.optimal_return))(tasks15))
        for maze, goal, return_ in zip(*tasks15, returns, strict=True):
            length = nx.shortest_path_length(free_graph(maze), MAZE15.start, tuple(goal))
            assert return_ == pytest.approx(1 - 0.1 * length, abs=1e-5)
        # The mean over 1,000 tasks of the authors' environment.
        assert returns.mean() == pytest.approx(-0.167, abs=0.08)


class TestSampling:
    def test_goals_are_free_reachable_and_not_the_start(self, tiny_tasks):
        for maze, goal in zip(tiny_tasks.maze[:200], tiny_tasks.goal[:200], strict=True):
            assert tuple(goal) != TINY.start
            assert nx.has_path(free_graph(maze), TINY.start, tuple(goal))

    def test_goals_are_uniform_over_the_free_cells(self, tiny_tasks):
        """Every cell is the goal as often as the mazes in which it is free make likely."""
        maze, goal = tiny_tasks
        free = maze == 0
        free[:, *TINY.start] = False
        chance = free / free.sum((1, 2), keepdims=True)
        found = np.zeros((7, 7))
        np.add.at(found, tuple(goal.T), 1)
        deviation = np.sqrt((chance * (1 - chance)).sum(0))
        inner = deviation > 0
        assert (found[~inner] == 0).all()
        assert (abs(found - chance.sum(0))[inner] < 4 * deviation[inner]).all()

    def test_prompt_goals_are_all_inner_cells(self):
        draw = jax.jit(jax.vmap(TINY.sample_goal))
        cells = np.asarray(draw(jax.random.split(jax.random.key(0), 500))) * 7
        np.testing.assert_allclose(cells, cells.round(), atol=1e-5)
        assert {tuple(cell) for cell in cells.round().astype(int)} == {
            (row, column) for row in range(1, 6) for column in range(1, 6)
        }


class TestCheckTask:
    def good(self) -> MazeTask:
        return MazeTask(*(np.stack([np.asarray(field)] * 2) for field in parse(TINY_MAP)))

    def test_accepts_good_tasks(self, tiny_tasks, tasks15):
        TINY.check_task(self.good())
        TINY.check_task(tiny_tasks)
        MAZE15.check_task(tasks15)

    @pytest.mark.parametrize(
        ("cell", "value", "message"),
        [
            ((1, 1, 1), 2, r"0 \(free\) and 1 \(wall\)"),
            ((1, 1, 1), -1, r"0 \(free\) and 1 \(wall\)"),
            ((1, 0, 3), 0, "border"),
            ((1, 6, 3), 0, "border"),
            ((1, 3, 0), 0, "border"),
            ((1, 3, 6), 0, "border"),
            ((1, 5, 3), 1, r"start cell \(row 5, column 3\) must be free"),
        ],
    )
    def test_bad_cells(self, cell, value, message):
        task = self.good()
        task.maze[cell] = value
        with pytest.raises(ValueError, match=message):
            TINY.check_task(task)

    @pytest.mark.parametrize(
        ("goal", "message"),
        [
            ((2, 2), r"task 1: goal \(2, 2\) is not a free cell"),
            ((-1, 1), r"task 1: goal \(-1, 1\) is not a free cell"),
            ((1, 7), r"task 1: goal \(1, 7\) is not a free cell"),
            ((5, 3), r"task 1: goal \(5, 3\) is the start cell"),
        ],
    )
    def test_bad_goals(self, goal, message):
        task = self.good()
        task.goal[1] = goal
        with pytest.raises(ValueError, match=message):
            TINY.check_task(task)

    def test_the_last_step_may_reach_the_goal_and_no_later_one(self):
        """The only way to the goal of the map has 10 steps."""
        task = parse(TINY_MAP)
        exact = MazeRunner(name="exact", side=7, horizon=len(TINY_WAY))
        short = MazeRunner(name="short", side=7, horizon=len(TINY_WAY) - 1)
        exact.check_solvable(self.good())
        assert exact.solvable(task)
        assert optimal_return(exact, task) == pytest.approx(0.0, abs=1e-6)
        message = "task 0: the goal is 10 steps away, an episode of short has 9"
        with pytest.raises(ValueError, match=message):
            short.check_solvable(self.good())
        short.check_task(self.good())  # a maze all the same
        assert not short.solvable(task)
        assert optimal_return(short, task) == pytest.approx(-0.9)
        for env, arrives in ((exact, True), (short, False)):
            _, positions, steps = walk(env, task, np.array(TINY_WAY))
            assert (positions[-1] == task.goal).all() == arrives
            assert bool(steps.terminated[-1]) == arrives
            assert float(steps.reward.sum()) == pytest.approx(0.0 if arrives else -0.9, abs=1e-6)

    def test_shortest_paths_are_compiled_once_for_both_checks(self, monkeypatch):
        traced = []
        path = MazeRunner._shortest_path
        monkeypatch.setattr(
            MazeRunner, "_shortest_path", lambda *args: (traced.append(None), path(*args))[1]
        )
        env = MazeRunner(name="checked twice", side=7, horizon=10)
        for _ in range(2):
            env.check_task(self.good())
            env.check_solvable(self.good())
        assert len(traced) == 1

    def test_worlds_around_it_and_worlds_without_words_refuse_it_too(self):
        class Silent(MazeRunner):
            check_solvable = Environment.check_solvable

        short = {"name": "short", "side": 7, "horizon": 9}
        noisy = Noisy(MazeRunner(**short), obs_noise=0.1)
        assert not noisy.solvable(parse(TINY_MAP))
        with pytest.raises(ValueError, match="task 0: the goal is 10 steps away"):
            noisy.check_solvable(self.good())
        far_and_near = MazeTask(
            *(np.stack(pair) for pair in zip(parse(TINY_MAP), parse(TINY_MAP), strict=True))
        )
        far_and_near.goal[0] = (3, 3)
        message = "task 1 cannot be solved within the 9 steps of an episode of short"
        with pytest.raises(ValueError, match=message):
            Silent(**short).check_solvable(far_and_near)

    def test_a_goal_that_is_cut_off_cannot_be_reached(self):
        task = parse(TINY_MAP)
        cut_off = task._replace(maze=task.maze.at[1, 4].set(1))
        assert TINY.solvable(task)
        assert not TINY.solvable(cut_off)

    def test_a_maze_whose_way_is_longer_than_an_episode(self):
        """A snake of corridors through all of maze15: every second row is wall but for one end."""
        maze = np.ones((1, 15, 15), np.int32)
        maze[:, 1:14:2, 1:14] = 0
        maze[:, 2:14:4, 13] = maze[:, 4:14:4, 1] = 0
        task = MazeTask(maze, np.array([[1, 1]]))
        length = int(nx.shortest_path_length(free_graph(maze[0]), MAZE15.start, (1, 1)))
        assert length > 64
        with pytest.raises(
            ValueError, match=f"the goal is {length} steps away, an episode of maze"
        ):
            MAZE15.check_solvable(task)

    def test_generated_tasks_fit_into_the_horizon(self, tasks15):
        """Of 100,000 tasks of maze15 none was further than 52 steps, of 20,000 of maze30 none than 112."""
        assert np.asarray(jax.jit(jax.vmap(MAZE15.solvable))(tasks15)).all()

    def test_bad_shapes_and_types(self):
        maze, goal = self.good()
        for bad, message in {
            "one task": (MazeTask(maze[0], goal[0]), r"maze must have shape \[N, 7, 7\]"),
            "other side": (MazeTask(maze[:, :5, :5], goal), r"found \[2, 5, 5\]"),
            "too few goals": (MazeTask(maze, goal[:1]), r"goal must have shape \[2, 2\]"),
            "flat goals": (MazeTask(maze, goal[:, 0]), r"goal must have shape \[2, 2\]"),
            "scaled goals": (MazeTask(maze, goal / 7), "goal must hold integers"),
        }.values():
            with pytest.raises(ValueError, match=message):
                TINY.check_task(bad)


def classic_maze(
    rng: np.random.Generator, side: int, complexity: float = 0.75, density: float = 0.75
) -> np.ndarray:
    """The classic procedure look by look, then MazeRunner's start area."""
    maze = np.ones((side, side), int)
    maze[1:-1, 1:-1] = 0
    maze = maze.tolist()
    nodes = [(row, column) for row in range(0, side, 2) for column in range(0, side, 2)]
    neighbors = {
        node: [other for other in nodes if abs(node[0] - other[0]) + abs(node[1] - other[1]) == 2]
        for node in nodes
    }
    for _ in range(int(density * (side // 2) * (side // 2))):
        row, column = nodes[rng.integers(len(nodes))]
        maze[row][column] = 1
        for draw in rng.random(int(complexity * 5 * (side + side))):
            choices = neighbors[row, column]
            new_row, new_column = choices[int(draw * len(choices))]
            if maze[new_row][new_column] == 0:
                maze[new_row][new_column] = 1
                maze[(row + new_row) // 2][(column + new_column) // 2] = 1
                row, column = new_row, new_column
    cells = np.array(maze)
    cells[side - 5 : side - 1, 1:-1] = 0
    for beside in (side // 2 - 1, side // 2 + 1):
        cells[side - 4 : side - 1, beside] = 1
    return cells


def mean_path(maze: np.ndarray) -> float:
    """Mean steps from the start to the other free cells."""
    start = (len(maze) - 2, len(maze) // 2)
    return np.mean(list(nx.single_source_shortest_path_length(free_graph(maze), start).values()))


class TestGenerateMaze:
    @pytest.mark.parametrize("kind", ["tiny", "sparse", "maze15"])
    def test_structure(self, mazes, kind):
        batch = mazes[kind][:200]
        side = batch.shape[1]
        assert np.isin(batch, (0, 1)).all()
        for edge in (batch[:, 0], batch[:, -1], batch[:, :, 0], batch[:, :, -1]):
            assert edge.all()

        # The start area: four rows without walls but for the two of the corridor.
        area = np.zeros((4, side), int)
        area[:, [0, -1]] = 1
        area[1:, [side // 2 - 1, side // 2 + 1]] = 1
        assert (batch[:, side - 5 : side - 1] == area).all()
        assert (batch[:, side - 2, side // 2] == 0).all()

        # Above it walls stand on even cells, or join two of them.
        above = batch[:, : side - 5]
        assert (above[:, 1::2, 1::2] == 0).all()
        for joint in np.argwhere(above[:, 0::2, 1::2]) * [1, 2, 2] + [0, 0, 1]:
            index, row, column = joint
            assert batch[index, row, column - 1] == batch[index, row, column + 1] == 1
        for joint in np.argwhere(above[:, 1 : side - 6 : 2, 0::2]) * [1, 2, 2] + [0, 1, 0]:
            index, row, column = joint
            # Its lower end may have been cleared with the start area.
            assert batch[index, row - 1, column] == 1
            assert batch[index, row + 1, column] == 1 or row + 1 >= side - 5

    @pytest.mark.parametrize("kind", ["tiny", "sparse", "maze15"])
    def test_every_free_cell_can_be_reached(self, mazes, kind):
        for maze in mazes[kind][:100]:
            assert nx.is_connected(free_graph(maze))

    def test_mazes_differ(self, mazes):
        assert len(np.unique(mazes["maze15"].reshape(500, -1), axis=0)) == 500

    @pytest.mark.parametrize(
        ("kind", "side", "parameters", "num"),
        [("sparse", 11, SPARSE, 2000), ("maze15", 15, {}, 400)],
    )
    def test_statistics_are_those_of_the_classic_procedure(
        self, mazes, kind, side, parameters, num
    ):
        rng = np.random.default_rng(5)
        ours = mazes[kind]
        classic = np.stack([classic_maze(rng, side, **parameters) for _ in range(num)])

        # Cell by cell, the difference of two frequencies in standard deviations.
        pooled = (ours.mean(0) + classic.mean(0)) / 2
        deviation = np.sqrt(pooled * (1 - pooled) * (1 / len(ours) + 1 / len(classic)))
        difference = abs(ours.mean(0) - classic.mean(0))
        random_cells = deviation > 0
        assert (difference[~random_cells] == 0).all()
        assert random_cells.sum() > 20
        assert (difference[random_cells] < 4.5 * deviation[random_cells]).all()

        def agree(a: np.ndarray, b: np.ndarray) -> bool:
            return abs(a.mean() - b.mean()) < 4 * np.sqrt(a.var() / len(a) + b.var() / len(b))

        walls, classic_walls = ours.sum((1, 2)), classic.sum((1, 2))
        assert agree(walls, classic_walls)
        center = classic_walls.mean()
        assert agree((walls - center) ** 2, (classic_walls - center) ** 2)
        paths, classic_paths = (
            [mean_path(maze) for maze in batch[:400]] for batch in (ours, classic)
        )
        assert agree(np.array(paths), np.array(classic_paths))


def test_goals_to_choose_from_are_all_cells_within_the_border():
    inner = [(row, column) for row in range(1, 6) for column in range(1, 6)]
    wanted = [TINY.goal_at(jnp.array(cell)) for cell in inner]
    np.testing.assert_allclose(TINY.goal_set, wanted, rtol=1e-6)
