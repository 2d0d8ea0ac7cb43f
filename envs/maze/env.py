"""MazeRunner: find the way to a goal in an unknown maze, seeing only along four rays.

Source: paper, appendix C.1; the exact rules are those of the authors' environment (AMAGO's MazeRunner with
a step penalty). Rows are counted downwards, columns to the right; north is row - 1. The observation is
``(row, column, free cells to the west, north, east, south) / side``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import Environment, TimeStep
from envs.maze.bitboard import distances
from envs.specs import ArraySpec, Discrete, EnvSpec

WEST, NORTH, EAST, SOUTH, STAY = range(5)
MOVES = ((0, -1), (-1, 0), (0, 1), (1, 0), (0, 0))
STEP_PENALTY = 0.1
GOAL_REWARD = 1.0


class MazeTask(NamedTuple):
    """A maze and the goal in it."""

    maze: Int[Array, "*batch S S"]
    """1 is a wall, 0 is free."""
    goal: Int[Array, "*batch 2"]
    """Row and column."""


class MazeState(NamedTuple):
    """An episode in progress."""

    task: MazeTask
    position: Int[Array, "2"]
    steps: Int[Array, ""]
    done: Bool[Array, ""]


@dataclass(frozen=True)
class MazeRunner(Environment):
    """The maze world for mazes of odd side length ``side``."""

    name: str
    side: int
    horizon: int

    @property
    def spec(self) -> EnvSpec:
        return EnvSpec(
            name=self.name,
            obs=ArraySpec((6,)),
            goal_dim=2,
            actions=Discrete(len(MOVES)),
            horizon=self.horizon,
            return_range=(-STEP_PENALTY * self.horizon, GOAL_REWARD - STEP_PENALTY),
            truncate_in_hindsight=True,
            goals_are_states=True,
        )

    @property
    def start(self) -> tuple[int, int]:
        """Row and column at which every episode starts, in the corridor at the bottom."""
        return (self.side - 2, self.side // 2)

    def sample_task(self, key: PRNGKeyArray) -> MazeTask:
        """A random maze and a goal drawn uniformly from the reachable free cells."""
        key_maze, key_goal = jax.random.split(key)
        maze = generate_maze(key_maze, self.side)
        reachable = distances(maze == 0, jnp.asarray(self.start)) >= 0
        weight = reachable.at[self.start].set(False).ravel()
        cell = jax.random.choice(key_goal, self.side**2, p=weight / weight.sum())
        return MazeTask(maze=maze, goal=jnp.stack([cell // self.side, cell % self.side]))

    def sample_goal(self, key: PRNGKeyArray) -> Float[Array, "2"]:
        """A random cell within the border, whether it is a wall or not."""
        cell = jax.random.randint(key, (2,), 1, self.side - 1)
        return self.goal_at(cell)

    @property
    def goal_set(self) -> np.ndarray:
        """All cells within the border, including walls, since the maze is not known beforehand."""
        inner = self.side - 2
        cells = 1 + np.stack(np.divmod(np.arange(inner**2), inner), axis=1)
        return (cells / self.side).astype(np.float32)

    def expert_goal(self, state: MazeState, num_steps: int) -> Float[Array, "2"]:
        """The cell ``num_steps`` ahead on a shortest path, or the goal if that is nearer."""
        steps_left = distances(state.task.maze == 0, state.task.goal)

        def walk(index: Array, cell: Array) -> Array:
            del index
            around = cell + jnp.asarray(MOVES)
            left = steps_left[around[:, 0], around[:, 1]]
            return around[jnp.argmin(jnp.where(left >= 0, left, steps_left.size))]

        return self.goal_at(jax.lax.fori_loop(0, num_steps, walk, state.position))

    def goal_at(self, position: Int[Array, "2"]) -> Float[Array, "2"]:
        """A cell as a goal: row and column in units of the side."""
        return position.astype(jnp.float32) / self.side

    def task_goal(self, task: MazeTask) -> Float[Array, "2"]:
        return self.goal_at(task.goal)

    def optimal_return(self, task: MazeTask) -> Float[Array, ""]:
        """1 - 0.1 x steps of the shortest path; the worst return if the goal cannot be reached."""
        length = self._shortest_path(task)
        best = GOAL_REWARD - STEP_PENALTY * length
        return jnp.where(self._in_reach(length), best, -STEP_PENALTY * self.horizon)

    def solvable(self, task: MazeTask) -> Bool[Array, ""]:
        """Whether the goal can be reached within the horizon."""
        return self._in_reach(self._shortest_path(task))

    def _in_reach(self, length: Int[Array, ""]) -> Bool[Array, ""]:
        return (length >= 0) & (length <= self.horizon)

    def _shortest_path(self, task: MazeTask) -> Int[Array, ""]:
        """Steps from the start to the goal; -1 if it cannot be reached."""
        return distances(task.maze == 0, jnp.asarray(self.start))[tuple(task.goal)]

    @partial(jax.jit, static_argnums=0)  # compiled once for both checks of the same tasks
    def _shortest_paths(self, tasks: MazeTask) -> Int[Array, "N"]:
        return jax.vmap(self._shortest_path)(tasks)

    def fingerprint(self, task: MazeTask) -> Int[Array, "F"]:
        """The walls: a test maze must not occur in training with any goal."""
        return task.maze.ravel()

    def check_task(self, tasks: MazeTask) -> None:
        super().check_task(tasks)
        maze, goal = np.asarray(tasks.maze), np.asarray(tasks.goal)
        side, start = self.side, self.start
        if not np.isin(maze, (0, 1)).all():
            raise ValueError("maze must hold 0 (free) and 1 (wall) only")
        border = np.concatenate([maze[:, [0, -1]], maze[:, :, [0, -1]].swapaxes(1, 2)], axis=1)
        if not border.all():
            raise ValueError("the border of every maze must be wall (1)")
        if maze[:, start[0], start[1]].any():
            raise ValueError(f"the start cell (row {start[0]}, column {start[1]}) must be free")
        for index, (row, column) in enumerate(goal):
            if not (0 <= row < side and 0 <= column < side) or maze[index, row, column]:
                raise ValueError(f"task {index}: goal ({row}, {column}) is not a free cell")
            if (row, column) == start:
                raise ValueError(f"task {index}: goal ({row}, {column}) is the start cell")
        for index, steps in enumerate(self._shortest_paths(tasks).tolist()):
            if steps < 0:
                raise ValueError(f"task {index}: no free path leads from the start to the goal")

    def check_solvable(self, tasks: MazeTask) -> None:
        for index, steps in enumerate(self._shortest_paths(tasks).tolist()):
            if steps > self.horizon:
                raise ValueError(
                    f"task {index}: the goal is {steps} steps away, an episode of {self.name} has "
                    f"{self.horizon}"
                )

    def reset(self, key: PRNGKeyArray, task: MazeTask) -> tuple[MazeState, TimeStep]:
        del key  # the start is always the same
        state = MazeState(
            task=task,
            position=jnp.asarray(self.start, jnp.int32),
            steps=jnp.zeros((), jnp.int32),
            done=jnp.zeros((), bool),
        )
        return state, self._observe(state, jnp.zeros(()), jnp.zeros((), bool))

    def step(self, state: MazeState, action: Int[Array, ""]) -> tuple[MazeState, TimeStep]:
        target = state.position + jnp.asarray(MOVES)[action]
        free = state.task.maze[tuple(target)] == 0
        moved = jnp.where(free & ~state.done, target, state.position)
        at_goal = jnp.all(moved == state.task.goal)
        reward = jnp.where(state.done, 0.0, GOAL_REWARD * at_goal - STEP_PENALTY)
        steps = state.steps + ~state.done
        done = state.done | at_goal | (steps >= self.horizon)
        state = MazeState(task=state.task, position=moved, steps=steps, done=done)
        return state, self._observe(state, reward, at_goal)

    def _observe(
        self, state: MazeState, reward: Float[Array, ""], at_goal: Bool[Array, ""]
    ) -> TimeStep:
        goal = self.goal_at(state.position)
        rays = free_cells(state.task.maze, state.position).astype(jnp.float32) / self.side
        return TimeStep(
            obs=jnp.concatenate([goal, rays]),
            achieved_goal=goal,
            goal_reached=jnp.ones((), bool),
            outcome=goal,
            reward=reward,
            terminated=at_goal,
            truncated=(state.steps >= self.horizon) & ~at_goal,
        )


def free_cells(maze: Int[Array, "S S"], position: Int[Array, "2"]) -> Int[Array, "4"]:
    """The number of free cells to the west, north, east and south, up to the first wall."""
    side = maze.shape[0]
    line = jnp.arange(side)

    def both_ways(walls: Bool[Array, "S"], at: Int[Array, ""]) -> tuple[Array, Array]:
        before = jnp.max(jnp.where(walls & (line < at), line, -1))
        after = jnp.min(jnp.where(walls & (line > at), line, side))
        return at - before - 1, after - at - 1

    row, column = position
    west, east = both_ways(maze[row] != 0, column)
    north, south = both_ways(maze[:, column] != 0, row)
    return jnp.stack([west, north, east, south])


def cells_in_sight(maze: Int[Array, "S S"], position: Int[Array, "2"]) -> Bool[Array, "S S"]:
    """The position and the free cells that its four rays cross."""
    west, north, east, south = free_cells(maze, position)
    line = jnp.arange(maze.shape[0])
    row, column = position
    in_row = (line == row)[:, None] & (line >= column - west) & (line <= column + east)
    in_column = (line == column) & ((line >= row - north) & (line <= row + south))[:, None]
    return in_row | in_column


class _Walk(NamedTuple):
    """The state of a maze under construction; nodes are its even cells, with half their coordinates."""

    maze: Int[Array, "S S"]
    node: Int[Array, "2"]
    """The end of the current wall."""
    looks_left: Int[Array, ""]
    """Number of looks that the current wall has left."""
    islands_left: Int[Array, ""]
    """Number of walls that have not begun yet; -1 once the last one is complete."""
    key: PRNGKeyArray


def generate_maze(
    key: PRNGKeyArray, side: int, complexity: float = 0.75, density: float = 0.75
) -> Int[Array, "S S"]:
    """Generate a maze by the classic "mazelab" random walk, with MazeRunner's start area; 1 is a wall.

    The classic procedure repeats the following ``density * (side // 2)**2`` times: it makes a random even
    cell a wall, and grows a wall from it. For this it looks ``complexity * 10 * side`` times at a random
    even cell two steps away. If that cell is free, it becomes a wall together with the cell between, and
    the wall continues from there. Most looks find a wall and change nothing. Here every loop step is one
    *change*: the number of looks until the next change is drawn from its geometric distribution. The mazes
    have the same distribution, but need far fewer loop steps.
    """
    num_islands = int(density * (side // 2) * (side // 2))
    num_looks = int(complexity * 5 * (side + side))
    border = jnp.zeros((side, side), jnp.int8)
    border = border.at[jnp.array([0, -1])].set(1).at[:, jnp.array([0, -1])].set(1)
    start = _Walk(
        maze=border,
        node=jnp.zeros(2, jnp.int32),
        looks_left=jnp.int32(0),  # the first change then begins the first wall
        islands_left=jnp.int32(num_islands),
        key=key,
    )
    end = jax.lax.while_loop(
        lambda walk: walk.islands_left >= 0, partial(_change, num_looks=num_looks), start
    )
    return _clear_start(end.maze).astype(jnp.int32)


def _change(walk: _Walk, num_looks: int) -> _Walk:
    """Grow the current wall by one node or, if it has no looks left, begin another wall."""
    key, key_island, key_looks, key_neighbor = jax.random.split(walk.key, 4)
    nodes = walk.maze.shape[0] // 2 + 1  # along one axis
    neighbors = walk.node + jnp.asarray(MOVES[:4])
    inside = jnp.all((neighbors >= 0) & (neighbors < nodes), axis=1)
    clipped = jnp.clip(neighbors, 0, nodes - 1)
    free = inside & (walk.maze[2 * clipped[:, 0], 2 * clipped[:, 1]] == 0)
    # The number of looks until a free neighbor is found; each look is a uniform draw from the neighbors
    # inside.
    hit = free.sum() / inside.sum()
    miss = jnp.log1p(-jnp.minimum(hit, 1 - 1e-7))
    looks = 1 + jnp.floor(jnp.log(jax.random.uniform(key_looks, minval=1e-12)) / miss)
    grows = jnp.any(free) & (looks <= walk.looks_left)

    scores = jnp.where(free, jax.random.uniform(key_neighbor, (4,)), -1.0)
    target = neighbors[jnp.argmax(scores)]
    island = jax.random.randint(key_island, (2,), 0, nodes)
    between = jnp.where(grows, walk.node + target, 2 * island)
    node = jnp.where(grows, target, island)
    islands_left = walk.islands_left - ~grows
    # Once the last wall is complete, nothing changes any more.
    active = islands_left >= 0
    rows = jnp.stack([between[0], 2 * node[0]])
    columns = jnp.stack([between[1], 2 * node[1]])
    walls = jnp.maximum(walk.maze[rows, columns], active.astype(jnp.int8))
    return _Walk(
        maze=walk.maze.at[rows, columns].set(walls),
        node=node,
        looks_left=jnp.where(grows, walk.looks_left - looks.astype(jnp.int32), num_looks),
        islands_left=islands_left,
        key=key,
    )


def _clear_start(maze: Int[Array, "S S"]) -> Int[Array, "S S"]:
    """Clear the four rows at the bottom, except for the two walls of the corridor in which agents start."""
    side = maze.shape[0]
    corridor = jnp.array([side // 2 - 1, side // 2 + 1])
    maze = maze.at[side - 5 : side - 1, 1:-1].set(0)
    return maze.at[side - 4 : side - 1, corridor].set(1)
