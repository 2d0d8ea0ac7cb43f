"""The demonstrators of MazeRunner, replayed against their rules in numpy and networkx."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest

from envs.base import Agent
from envs.experts import demonstrators
from envs.experts.maze import astar, first_hit_return, maze_demonstrators, random_walk
from envs.maze_runner import EAST, NORTH, SOUTH, STAY, WEST, MazeRunner, MazeTask
from mgpo_jax.rollout import run_episode
from mgpo_jax.types import Trajectory

MAZE9 = MazeRunner(name="maze9", side=9, horizon=120)
MAZE15 = MazeRunner(name="maze15", side=15, horizon=64)
NUM_GOALS = 3
MOVES = np.array([(0, -1), (-1, 0), (0, 1), (1, 0), (0, 0)])


def heading_for(agent: Agent, goals) -> Agent:
    """The A*-n agent with these goals instead of random ones."""

    def begin(key, task, state, timestep):
        _, _, memory = agent.begin(key, task, state, timestep)
        memory = memory._replace(
            goals=goals, target=state.position, num_reached=jnp.zeros((), jnp.int32)
        )
        return agent.proceed(key, memory, state, timestep)

    return Agent(begin, agent.proceed)


@partial(jax.jit, static_argnums=0)
def astar_episodes(env, keys, mazes, goals):
    """Episodes of A*-n towards given goals; nothing but the agent ends them early."""

    def episode(key, maze, goals):
        agent = heading_for(astar(env, len(goals)), goals)
        task = MazeTask(maze, jnp.zeros(2, jnp.int32))
        return run_episode(key, env, agent, task, "lanes").trajectory

    return jax.vmap(episode, axis_name="lanes")(keys, mazes, goals)


@partial(jax.jit, static_argnums=(0, 1, 2))
def dataset_episodes(env, name, num):
    """Episodes as a dataset holds them, with their mazes and their returns in hindsight."""
    demonstrator = maze_demonstrators(env)[name]

    def episode(key):
        key_task, key_episode = jax.random.split(key)
        task = demonstrator.sample_task(key_task)
        trajectory = run_episode(key_episode, env, demonstrator.agent, task, "lanes").trajectory
        return task, trajectory, demonstrator.hindsight_return(trajectory)

    return jax.vmap(episode, axis_name="lanes")(jax.random.split(jax.random.key(11), num))


def unbatched(batch, index):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], batch)


def free_graph(free: np.ndarray) -> nx.Graph:
    graph = nx.grid_2d_graph(*free.shape)
    graph.remove_nodes_from(map(tuple, np.argwhere(~free)))
    return graph


def look(maze: np.ndarray, seen: np.ndarray, position: tuple[int, int]) -> None:
    """Add to ``seen`` what the four rays show."""
    seen[position] = True
    for move in MOVES[:4]:
        cell = tuple(position + move)
        while maze[cell] == 0:
            seen[cell] = True
            cell = tuple(cell + move)


def path_of(env: MazeRunner, trajectory: Trajectory) -> list[tuple[int, int]]:
    """Positions, the start first."""
    cells = np.rint(trajectory.goals[: trajectory.length] * env.side).astype(int)
    return [env.start, *map(tuple, cells)]


def astar_targets(seen, visited, steps, goal):
    """Where A*-n may go: the goal if known, or the best frontier cells, nearest to the goal first."""
    if seen[goal]:
        return {goal}
    scores = {
        cell: (steps[cell] + distance, distance)
        for cell in map(tuple, np.argwhere(seen & ~visited))
        for distance in [abs(cell[0] - goal[0]) + abs(cell[1] - goal[1])]
    }
    best = min(scores.values())
    return {cell for cell, score in scores.items() if score == best}


def random_targets(seen, visited, steps, goal):
    """Where Random may go: the five nearest frontier cells, more if several tie for fifth."""
    frontier = list(map(tuple, np.argwhere(seen & ~visited)))
    fifth = sorted(steps[cell] for cell in frontier)[:5][-1]
    return {cell for cell in frontier if steps[cell] <= fifth}


def follow(env, maze, trajectory, goals, targets_of) -> int:
    """Check every step of an episode against the rule; returns the number of goals reached.

    Ties leave the demonstrator a choice, which cannot be seen from outside. So this keeps the set of
    all targets that explain the steps so far: each step must bring it nearer to one of them on the
    map as known then, and whoever has arrived chooses anew.
    """
    path = path_of(env, trajectory)
    seen, visited = np.zeros(maze.shape, bool), np.zeros(maze.shape, bool)
    targets, num_reached = {path[0]}, 0
    for time, position in enumerate(path):
        look(maze, seen, position)
        visited[position] = True
        reached = num_reached < len(goals) and position == goals[num_reached]
        num_reached += reached
        done = num_reached == len(goals) if goals else not (seen & ~visited).any()
        if time == trajectory.length:
            assert done or time == env.horizon, "it quit too early"
            return num_reached
        assert not done, "it did not quit"

        graph = free_graph(seen)
        steps = nx.single_source_shortest_path_length(graph, position)
        if reached or position in targets:
            chosen = targets_of(seen, visited, steps, goals[num_reached] if goals else None)
            targets = chosen if reached else (targets - {position}) | chosen
        after = nx.single_source_shortest_path_length(graph, path[time + 1])
        targets = {cell for cell in targets if after[cell] == steps[cell] - 1}
        assert targets, f"step {time} from {position} to {path[time + 1]} breaks the rule"
    raise AssertionError("unreachable")


def check_never_blind(env, maze, trajectory):
    """No step into a wall or into the unknown, and none of them idle."""
    path = path_of(env, trajectory)
    seen = np.zeros(maze.shape, bool)
    for position, move, arrived in zip(path, MOVES[trajectory.actions], path[1:], strict=False):
        look(maze, seen, position)
        target = tuple(position + move)
        assert target == arrived != position
        assert maze[target] == 0
        assert seen[target]


@pytest.fixture(scope="module")
def astar9():
    """Mazes with goals drawn in numpy, and what A*-3 does in them."""
    num = 24
    keys = jax.random.split(jax.random.key(2), num)
    mazes = np.asarray(jax.jit(jax.vmap(MAZE9.sample_task))(keys).maze)
    rng = np.random.default_rng(0)
    goals = []
    for maze in mazes:
        cells = [cell for cell in np.argwhere(maze == 0) if tuple(cell) != MAZE9.start]
        goals.append(rng.permutation(cells)[:NUM_GOALS])
    goals = np.array(goals, np.int32)
    return mazes, goals, astar_episodes(MAZE9, keys, mazes, goals)


@pytest.fixture(scope="module")
def random9():
    task, trajectory, _ = dataset_episodes(MAZE9, "random", 24)
    return np.asarray(task.maze), trajectory


@pytest.fixture(scope="module")
def astar15():
    task, trajectory, return_ = dataset_episodes(MAZE15, "astar4", 1536)
    return np.asarray(task.maze), jax.tree.map(np.asarray, trajectory), np.asarray(return_)


GOLDEN = """
#########
#...#...#
#.#.#.#.#
#.#...#.#
#.......#
#.......#
#..#.#..#
#..#S#..#
#########
"""


class TestAStar:
    def test_golden(self):
        """By hand: into the open, then to each goal as it comes into sight.

        The start sees the corridor up to (3, 4). The first goal (5, 1) lies three rows higher and
        three columns to the left; from (5, 4), the cell nearest to it, it is in sight.
        The second, (3, 4), was seen from the start. The third, (7, 7), is 8 steps away and hidden
        until (7, 7)'s column or row is entered: it goes down again, since (4, 4) and what it saw in
        rows 4 and 5 are the only ways, and the cell of row 5 above the goal has the least G + H.
        """
        maze = np.array([[cell == "#" for cell in line] for line in GOLDEN.split()], np.int32)
        goals = np.array([(5, 1), (3, 4), (7, 7)], np.int32)
        batched = (np.broadcast_to(array, (24, *array.shape)) for array in (maze, goals))
        keys = jax.random.split(jax.random.key(0), 24)
        trajectory = unbatched(astar_episodes(MAZE9, keys, *batched), 0)
        path = path_of(MAZE9, trajectory)
        first = [(7, 4), (6, 4), (5, 4), (5, 3), (5, 2), (5, 1)]
        assert path[:6] == first
        assert path.index((3, 4)) == 5 + 5
        assert path[-1] == (7, 7)
        assert trajectory.length == 5 + 5 + 7
        assert (trajectory.actions[:5] == [NORTH, NORTH, WEST, WEST, WEST]).all()
        assert set(trajectory.actions[10:17]) == {EAST, SOUTH}
        assert follow(MAZE9, maze, trajectory, list(map(tuple, goals)), astar_targets) == 3

    def test_follows_the_rule(self, astar9):
        mazes, goals, trajectories = astar9
        reached = []
        for index, (maze, three) in enumerate(zip(mazes, goals, strict=True)):
            trajectory = unbatched(trajectories, index)
            reached.append(follow(MAZE9, maze, trajectory, list(map(tuple, three)), astar_targets))
        # Nothing keeps it from all its goals on so small a maze.
        assert reached == [NUM_GOALS] * len(mazes)

    def test_follows_the_rule_in_the_dataset(self, astar15):
        """Goals drawn by the demonstrator itself, read from what it remembers at the start."""
        mazes, trajectories, _ = astar15

        @jax.jit
        @jax.vmap
        def goals_of(key):
            demonstrator = maze_demonstrators(MAZE15)["astar4"]
            key_task, key_episode = jax.random.split(key)
            _, key_begin, _ = jax.random.split(key_episode, 3)
            task = demonstrator.sample_task(key_task)
            state, timestep = MAZE15.reset(key_task, task)
            return demonstrator.agent.begin(key_begin, task, state, timestep)[2].goals

        keys = jax.random.split(jax.random.key(11), len(mazes))
        goals = np.asarray(goals_of(keys))
        for maze, four in zip(mazes, goals, strict=True):
            assert len({tuple(goal) for goal in four} | {MAZE15.start}) == 5
            assert (maze[tuple(four.T)] == 0).all()
        for index in range(8):
            four = list(map(tuple, goals[index]))
            trajectory = unbatched(trajectories, index)
            reached = follow(MAZE15, mazes[index], trajectory, four, astar_targets)
            assert (reached == 4) == (path_of(MAZE15, trajectory)[-1] == four[-1])

    def test_the_check_notices_others(self, astar9, random9):
        """The replay above refuses another demonstrator and other goals."""
        mazes, goals, trajectories = astar9
        refused = 0
        for index in range(6):
            others = list(map(tuple, goals[index, ::-1]))
            with pytest.raises(AssertionError):
                follow(MAZE9, mazes[index], unbatched(trajectories, index), others, astar_targets)
            try:
                goal = path_of(MAZE9, unbatched(random9[1], index))[-1]
                follow(
                    MAZE9, random9[0][index], unbatched(random9[1], index), [goal], astar_targets
                )
            except AssertionError:
                refused += 1
        assert refused == 6

    def test_walks_only_where_it_has_seen(self, astar9, astar15):
        for env, mazes, trajectories in ((MAZE9, *astar9[::2]), (MAZE15, *astar15[:2])):
            for index in range(24):
                check_never_blind(env, mazes[index], unbatched(trajectories, index))

    def test_observations_and_actions_fit(self, astar15):
        """The record: where it stood, what it did, where that led, and zeros after the end."""
        _, trajectory, _ = astar15
        real = np.arange(64) < trajectory.length[:, None]
        moved = np.rint((trajectory.goals - trajectory.obs[..., :2]) * 15).astype(int)
        assert (moved == MOVES[trajectory.actions])[real].all()
        assert np.array_equal(
            trajectory.obs[:, 1:, :2][real[:, 1:]], trajectory.goals[:, :-1][real[:, 1:]]
        )
        assert trajectory.goal_reached[real].all()
        for rows in trajectory[:-1]:
            assert (rows[~real] == 0).all()

    def test_length_statistics(self, astar15):
        """The authors' 10,000 episodes: mean length 55.2, 53.8 % cut at the horizon."""
        _, trajectory, return_ = astar15
        kept = trajectory.length >= demonstrators(MAZE15)["astar4"].min_length
        lengths = trajectory.length[kept]
        assert kept.mean() > 0.9
        assert lengths.mean() == pytest.approx(55.2, abs=1.5)
        assert (lengths == 64).mean() == pytest.approx(0.538, abs=0.04)
        np.testing.assert_allclose(np.percentile(lengths, [25, 50, 75]), [47, 64, 64], atol=2)
        assert return_[kept].mean() == pytest.approx(-3.50, abs=0.2)


class TestRandom:
    def test_follows_the_rule(self, random9):
        mazes, trajectories = random9
        for index, maze in enumerate(mazes):
            follow(MAZE9, maze, unbatched(trajectories, index), [], random_targets)

    def test_walks_only_where_it_has_seen(self, random9):
        mazes, trajectories = random9
        for index, maze in enumerate(mazes):
            check_never_blind(MAZE9, maze, unbatched(trajectories, index))

    def test_quits_when_nothing_is_left_to_visit(self, random9):
        mazes, trajectories = random9
        quits = np.flatnonzero(np.asarray(trajectories.length) < MAZE9.horizon)
        assert len(quits) > 0
        for index in quits:
            path = path_of(MAZE9, unbatched(trajectories, index))
            assert set(path) == {tuple(cell) for cell in np.argwhere(mazes[index] == 0)}
            assert path[-1] not in path[:-1]  # it left with its last visit

    def test_chooses_at_random(self):
        """In one maze, different keys lead to many different episodes."""
        task = MazeTask(
            jnp.array([[cell == "#" for cell in line] for line in GOLDEN.split()], jnp.int32),
            jnp.zeros(2, jnp.int32),
        )
        agent = random_walk(MAZE9)

        @partial(jax.vmap, axis_name="lanes")
        def first_targets(key):
            state, timestep = MAZE9.reset(key, task)
            return agent.begin(key, task, state, timestep)[2].target

        targets = np.asarray(jax.jit(first_targets)(jax.random.split(jax.random.key(0), 400)))
        # Only the four cells ahead are in sight; each is as likely.
        cells, counts = np.unique(targets, axis=0, return_counts=True)
        assert cells.tolist() == [[3, 4], [4, 4], [5, 4], [6, 4]]
        assert (abs(counts - 100) < 4 * np.sqrt(400 * 0.25 * 0.75)).all()


class TestFirstHitReturn:
    @pytest.mark.parametrize(
        ("visits", "return_"),
        [
            ([(5, 3)], 0.9),
            ([(4, 3), (3, 3), (2, 3)], 0.7),
            ([(4, 3), (3, 3), (4, 3), (3, 3)], 0.8),  # it was there before
            ([(4, 3), (4, 2), (3, 3), (4, 3), (4, 3)], 0.9),
            ([(4, 2), (2, 4), (4, 4), (2, 2), (2, 4)], 0.8),  # row or column alone do not count
        ],
    )
    def test_golden(self, visits, return_):
        goals = np.zeros((8, 2), np.float32)
        goals[: len(visits)] = np.array(visits) / np.float32(7)
        rows = jnp.zeros(8)
        trajectory = Trajectory(rows, rows, jnp.asarray(goals), rows, goals, len(visits))
        assert first_hit_return(trajectory) == pytest.approx(return_)

    def test_is_the_return_on_the_task_solved_in_hindsight(self, astar9):
        """Replaying the actions on the task whose goal is the final position earns it."""
        mazes, _, trajectories = astar9

        @jax.jit
        @jax.vmap
        def replayed(maze, trajectory):
            goal = jnp.rint(trajectory.goals[trajectory.length - 1] * 9).astype(jnp.int32)
            state, _ = MAZE9.reset(jax.random.key(0), MazeTask(maze, goal))
            actions = jnp.where(jnp.arange(120) < trajectory.length, trajectory.actions, STAY)
            _, steps = jax.lax.scan(MAZE9.step, state, actions)
            return steps.reward.sum(), first_hit_return(trajectory)

        earned, hindsight = replayed(mazes, trajectories)
        np.testing.assert_allclose(earned, hindsight, atol=1e-4)


def test_demonstrators_by_name():
    known = demonstrators(MAZE15)
    assert next(iter(known)) == "astar4"
    assert set(known) == {"astar1", "astar2", "astar4", "random"}
    assert {demonstrator.min_length for demonstrator in known.values()} == {20}
    with pytest.raises(TypeError, match="no demonstrators for str"):
        demonstrators("maze15")
