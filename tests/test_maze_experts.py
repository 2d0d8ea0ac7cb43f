"""The demonstrators of MazeRunner against their rules in numpy and networkx."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest

import envs
from envs.agents import Agent
from envs.base import Episode, Trajectory
from envs.episodes import run_episode
from envs.maze.demonstrators import first_hit_return, maze_demonstrators
from envs.maze.env import NORTH, STAY, WEST, MazeRunner, MazeTask

MAZE9 = MazeRunner(name="maze9", side=9, horizon=120)
MAZE15 = MazeRunner(name="maze15", side=15, horizon=64)
NUM_LANES = 1536
NUM_REPLAYED = 24  # episodes that are checked step by step
MOVES = np.array([(0, -1), (-1, 0), (0, 1), (1, 0), (0, 0)])
OWN_GOALS = np.full((NUM_LANES, 4, 2), -1, np.int32)


def heading_for(agent: Agent, goals) -> Agent:
    """The A*-n agent with these goals; with its own random ones where they are negative."""

    def begin(key, task, state, timestep):
        _, _, memory = agent.begin(key, task, state, timestep)
        memory = memory._replace(
            goals=jnp.where(goals < 0, memory.goals, goals),
            target=state.position,
            num_reached=jnp.zeros((), jnp.int32),
        )
        return agent.proceed(key, memory, state, timestep)

    return Agent(begin=begin, proceed=agent.proceed)


def drawn(env, agent, key, task):
    """What the agent remembers after its first look in the episode of this key."""
    _, key_begin, _ = jax.random.split(key, 3)
    state, timestep = env.reset(key, task)
    return agent.begin(key_begin, task, state, timestep)[2]


@jax.jit
def astar_episodes(keys, tasks, goals):
    """Episodes of A*-4 on maze15, the goals that it drew, and its returns in hindsight."""
    demonstrator = maze_demonstrators(MAZE15)["astar4"]
    own_agent = demonstrator.agent(demonstrator.weights)

    def episode(key, task, goals):
        agent = heading_for(own_agent, goals)
        trajectory = run_episode(key, MAZE15, agent, task).trajectory
        own = drawn(MAZE15, own_agent, key, task).goals
        return trajectory, own, demonstrator.hindsight_return(trajectory)

    return jax.vmap(episode)(keys, tasks, goals)


@jax.jit
def random_episodes(keys, mazes):
    """Episodes of Random on mazes of side 9, and the first cells it chose."""
    demonstrator = maze_demonstrators(MAZE9)["random"]
    agent = demonstrator.agent(demonstrator.weights)

    def episode(key, maze):
        task = MazeTask(maze, jnp.zeros(2, jnp.int32))
        trajectory = run_episode(key, MAZE9, agent, task).trajectory
        return trajectory, drawn(MAZE9, agent, key, task).target

    return jax.vmap(episode)(keys, mazes)


def unbatched(batch, index):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], batch)


def known_graph(seen: np.ndarray) -> nx.Graph:
    cells = set(map(tuple, np.argwhere(seen)))
    graph = nx.Graph()
    graph.add_nodes_from(cells)
    for row, column in cells:
        graph.add_edges_from(
            ((row, column), cell)
            for cell in ((row + 1, column), (row, column + 1))
            if cell in cells
        )
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
    cells = np.rint(trajectory.achieved_goals[: trajectory.length] * env.side).astype(int)
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

        graph = known_graph(seen)
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
def astar15():
    """Mazes, goals, trajectories and hindsight returns of A*-4, as a dataset has them."""
    sample_task = maze_demonstrators(MAZE15)["astar4"].sample_task
    keys = jax.random.split(jax.random.key(10), NUM_LANES)
    tasks = jax.jit(jax.vmap(sample_task))(keys, np.arange(NUM_LANES))
    keys = jax.random.split(jax.random.key(11), NUM_LANES)
    episodes = astar_episodes(keys, tasks, OWN_GOALS)
    trajectory, goals, return_ = jax.tree.map(np.asarray, episodes)
    return np.asarray(tasks.maze), goals, trajectory, return_


@pytest.fixture(scope="module")
def random9():
    """Maps with walls anywhere, what Random does in them and where it goes first."""
    num = 400
    maze = (np.random.default_rng(0).random((num, 9, 9)) < 0.3).astype(np.int32)
    maze[:, [0, -1]] = maze[:, :, [0, -1]] = 1
    maze[:, MAZE9.start[0], 2:7] = 0
    episodes = random_episodes(jax.random.split(jax.random.key(0), num), maze)
    return maze, *jax.tree.map(np.asarray, episodes)


GOLDEN = """
###############
#.............#
#.###########.#
#.#.........#.#
#.#.........#.#
#.#.........#.#
#.#.........#.#
#.#.........#.#
#.#####.#####.#
#.............#
#.............#
#.....#.#.....#
#.....#.#.....#
#.....#S#.....#
###############
"""


class TestAStar:
    def test_golden(self):
        """Counted by hand.

        From the start it sees up to (3, 7). On this way (12, 7), (11, 7) and (10, 7) have the least
        G + H towards (10, 2), 8, and (10, 7) is the nearest to it: 3 steps. There the goal is in
        sight: 5 more. (5, 7) is known since the start: 10 more. Row 9 was seen on the way, so that
        (9, 13) is known: 10 more. (1, 9) is behind walls. In column 13, now in sight, (1, 13) is the
        nearest to it of all with the least G + H, 12: 8 more, and 4 from there.
        """
        maze = np.array([[cell == "#" for cell in line] for line in GOLDEN.split()], np.int32)
        goals = np.array([(10, 2), (5, 7), (9, 13), (1, 9)], np.int32)
        task = MazeTask(maze, np.zeros(2, np.int32))
        tasks, goals = jax.tree.map(
            lambda leaf: np.broadcast_to(leaf, (NUM_LANES, *leaf.shape)), (task, goals)
        )
        keys = jax.random.split(jax.random.key(0), NUM_LANES)
        trajectory = unbatched(astar_episodes(keys, tasks, goals)[0], 0)
        path = path_of(MAZE15, trajectory)
        at = {3: (10, 7), 8: (10, 2), 18: (5, 7), 28: (9, 13), 36: (1, 13), 40: (1, 9)}
        assert {time: path[time] for time in at} == at
        assert trajectory.length == 40
        assert trajectory.actions[:8].tolist() == [NORTH] * 3 + [WEST] * 5
        assert follow(MAZE15, maze, trajectory, list(map(tuple, goals[0])), astar_targets) == 4

    def test_follows_the_rule(self, astar15):
        reached = []
        for index in range(NUM_REPLAYED):
            maze, goals, trajectory = (unbatched(batch, index) for batch in astar15[:3])
            goals = list(map(tuple, goals))
            reached.append(follow(MAZE15, maze, trajectory, goals, astar_targets))
        assert {0, 4} < set(reached)  # some of everything

    def test_the_check_notices_others(self, astar15, random9):
        """The replay above refuses another order of the goals and another demonstrator."""
        for index in range(6):
            maze, goals, trajectory = (unbatched(batch, index) for batch in astar15[:3])
            with pytest.raises(AssertionError):
                follow(MAZE15, maze, trajectory, list(map(tuple, goals[::-1])), astar_targets)
            maze, trajectory = (unbatched(batch, index) for batch in random9[:2])
            goal = path_of(MAZE9, trajectory)[-1]
            with pytest.raises(AssertionError):
                follow(MAZE9, maze, trajectory, [goal], astar_targets)

    def test_goals_are_free_and_distinct(self, astar15):
        mazes, goals, _, _ = astar15
        for maze, four in zip(mazes, goals, strict=True):
            assert len({tuple(goal) for goal in four} | {MAZE15.start}) == 5
            assert (maze[tuple(four.T)] == 0).all()

    def test_walks_only_where_it_has_seen(self, astar15):
        for index in range(NUM_REPLAYED):
            check_never_blind(MAZE15, astar15[0][index], unbatched(astar15[2], index))

    def test_observations_and_actions_fit(self, astar15):
        """The record: where it stood, what it did, where that led, and zeros after the end."""
        trajectory = astar15[2]
        real = np.arange(64) < trajectory.length[:, None]
        moved = np.rint((trajectory.achieved_goals - trajectory.obs[..., :2]) * 15).astype(int)
        assert (moved == MOVES[trajectory.actions])[real].all()
        later = real[:, 1:]
        assert (trajectory.obs[:, 1:, :2][later] == trajectory.achieved_goals[:, :-1][later]).all()
        assert trajectory.goal_reached[real].all()
        for rows in trajectory.steps.values():
            assert (rows[~real] == 0).all()

    def test_length_statistics(self, astar15):
        """The authors' 10,000 episodes: mean length 55.2, 53.8 % cut at the horizon."""
        _, _, trajectory, return_ = astar15
        episodes = Episode(
            trajectory=trajectory._replace(length=jnp.asarray(trajectory.length)),
            rewards=None, return_=None, last_obs=None,
        )  # fmt: skip
        kept = np.asarray(maze_demonstrators(MAZE15)["astar4"].keeps(episodes))
        np.testing.assert_array_equal(kept, trajectory.length >= 20)
        lengths = trajectory.length[kept]
        assert kept.mean() > 0.9
        assert lengths.mean() == pytest.approx(55.2, abs=1.5)
        assert (lengths == 64).mean() == pytest.approx(0.538, abs=0.04)
        np.testing.assert_allclose(np.percentile(lengths, [25, 50, 75]), [47, 64, 64], atol=2)
        # And their mean return on the tasks solved in hindsight.
        assert return_[kept].mean() == pytest.approx(-3.50, abs=0.2)


class TestRandom:
    def test_follows_the_rule(self, random9):
        for index in range(NUM_REPLAYED):
            maze, trajectory = (unbatched(batch, index) for batch in random9[:2])
            follow(MAZE9, maze, trajectory, [], random_targets)

    def test_walks_only_where_it_has_seen(self, random9):
        for index in range(NUM_REPLAYED):
            check_never_blind(MAZE9, *(unbatched(batch, index) for batch in random9[:2]))

    def test_quits_when_nothing_is_left_to_visit(self, random9):
        mazes, trajectories, _ = random9
        quits = np.flatnonzero(trajectories.length < MAZE9.horizon)
        assert len(quits) > 20
        for index in quits[:40]:
            path = path_of(MAZE9, unbatched(trajectories, index))
            reachable = nx.node_connected_component(known_graph(mazes[index] == 0), MAZE9.start)
            assert set(path) == reachable
            assert path[-1] not in path[:-1]  # it left with its last visit

    def test_chooses_evenly_among_the_five_nearest(self, random9):
        """The first choice: all it sees lies on straight ways, the row of the start among them."""
        mazes, _, targets = random9
        expected, variance, found = 0.0, 0.0, 0
        for maze, target in zip(mazes, targets, strict=True):
            seen = np.zeros((9, 9), bool)
            look(maze, seen, MAZE9.start)
            steps = np.sort(abs(np.argwhere(seen) - MAZE9.start).sum(1))[1:]
            distance = abs(target - MAZE9.start).sum()
            assert distance <= steps[:5][-1]
            nearest = (steps[:5] == 1).mean()
            expected += nearest
            variance += nearest * (1 - nearest)
            found += distance == 1
        assert abs(found - expected) < 4 * np.sqrt(variance)


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
        trajectory = Trajectory(
            obs=rows, actions=rows, achieved_goals=jnp.asarray(goals), goal_reached=rows,
            outcomes=goals, length=len(visits),
        )  # fmt: skip
        assert first_hit_return(trajectory) == pytest.approx(return_)

    def test_is_the_return_on_the_task_solved_in_hindsight(self, astar15):
        """Replaying the actions on the task whose goal is the final position earns it."""
        mazes, _, trajectories, hindsight = astar15

        @jax.jit
        @jax.vmap
        def replayed(maze, trajectory):
            goal = jnp.rint(trajectory.achieved_goals[trajectory.length - 1] * 15).astype(jnp.int32)
            state, _ = MAZE15.reset(jax.random.key(0), MazeTask(maze, goal))
            actions = jnp.where(jnp.arange(64) < trajectory.length, trajectory.actions, STAY)
            return jax.lax.scan(MAZE15.step, state, actions)[1].reward.sum()

        np.testing.assert_allclose(replayed(mazes, trajectories), hindsight, atol=1e-4)


def test_demonstrators_by_name():
    known = envs.find("maze15").demonstrators(MAZE15)
    assert next(iter(known)) == "astar4"
    assert set(known) == {"astar1", "astar2", "astar4", "random"}
