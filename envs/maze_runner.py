"""MazeRunner: find the way to a goal in an unknown maze, seeing only along four rays.

Paper, appendix C.1; the exact rules are those of the authors' environment (AMAGO's MazeRunner with a
step penalty). Rows count downwards, columns to the right; north is row - 1. The observation is
``(row, column, free cells to the west, north, east, south) / side``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import EnvSpec, TimeStep
from envs.bitboard import distances

WEST, NORTH, EAST, SOUTH, STAY = range(5)
MOVES = ((0, -1), (-1, 0), (0, 1), (1, 0), (0, 0))
STEP_PENALTY = 0.1
GOAL_REWARD = 1.0


class MazeTask(NamedTuple):
    """A maze and where to go in it."""

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
class MazeRunner:
    """The maze world for mazes of odd side length ``side``."""

    name: str
    side: int
    horizon: int

    @property
    def spec(self) -> EnvSpec:
        return EnvSpec(
            name=self.name,
            obs_dim=6,
            goal_dim=2,
            action_dim=5,
            discrete=True,
            horizon=self.horizon,
            return_range=(-STEP_PENALTY * self.horizon, GOAL_REWARD - STEP_PENALTY),
            truncate_in_hindsight=True,
            deterministic=True,
            reward_confirms_goals=False,
        )

    @property
    def start(self) -> tuple[int, int]:
        """Row and column where every episode starts: inside the corridor at the bottom."""
        return (self.side - 2, self.side // 2)

    def sample_task(self, key: PRNGKeyArray) -> MazeTask:
        """A random maze with a goal that is uniform over the free cells that can be reached."""
        key_maze, key_goal = jax.random.split(key)
        maze = generate_maze(key_maze, self.side)
        reachable = distances(maze == 0, jnp.asarray(self.start)) >= 0
        weight = reachable.at[self.start].set(False).ravel()
        cell = jax.random.choice(key_goal, self.side**2, p=weight / weight.sum())
        return MazeTask(maze, jnp.stack([cell // self.side, cell % self.side]))

    def sample_goal(self, key: PRNGKeyArray) -> Float[Array, "2"]:
        cell = jax.random.randint(key, (2,), 1, self.side - 1)
        return self.goal_at(cell)

    def goal_at(self, position: Int[Array, "2"]) -> Float[Array, "2"]:
        return position.astype(jnp.float32) / self.side

    def task_goal(self, task: MazeTask) -> Float[Array, "2"]:
        return self.goal_at(task.goal)

    def optimal_return(self, task: MazeTask) -> Float[Array, ""]:
        """1 - 0.1 x shortest path (worst return where the goal is too far or cut off)."""
        length = self._shortest_path(task)
        reachable = (length >= 0) & (length <= self.horizon)
        return jnp.where(
            reachable, GOAL_REWARD - STEP_PENALTY * length, -STEP_PENALTY * self.horizon
        )

    def _shortest_path(self, task: MazeTask) -> Int[Array, ""]:
        """Steps from the start to the goal; -1 where it is cut off."""
        return distances(task.maze == 0, jnp.asarray(self.start))[tuple(task.goal)]

    def fingerprint(self, task: MazeTask) -> Int[Array, "F"]:
        """The walls: a test maze must not occur in training with any goal."""
        return task.maze.ravel()

    def check_task(self, task: MazeTask) -> None:
        maze, goal = np.asarray(task.maze), np.asarray(task.goal)
        side, start = self.side, self.start
        if maze.ndim != 3 or maze.shape[1:] != (side, side):
            raise ValueError(f"maze must have shape [N, {side}, {side}], found {list(maze.shape)}")
        if goal.shape != (len(maze), 2):
            raise ValueError(f"goal must have shape [{len(maze)}, 2], found {list(goal.shape)}")
        if not np.issubdtype(goal.dtype, np.integer):
            raise ValueError(f"goal must hold integers (row, column), found {goal.dtype}")
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
        batch = MazeTask(jnp.asarray(maze), jnp.asarray(goal))
        for index, steps in enumerate(jax.vmap(self._shortest_path)(batch).tolist()):
            if steps < 0:
                raise ValueError(f"task {index}: no free path leads from the start to the goal")

    def reset(self, key: PRNGKeyArray, task: MazeTask) -> tuple[MazeState, TimeStep]:
        del key  # the start is always the same
        position = jnp.asarray(self.start, jnp.int32)
        state = MazeState(task, position, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
        return state, self._observe(state, jnp.zeros(()), jnp.zeros((), bool))

    def step(self, state: MazeState, action: Int[Array, ""]) -> tuple[MazeState, TimeStep]:
        target = state.position + jnp.asarray(MOVES)[action]
        free = state.task.maze[tuple(target)] == 0
        moved = jnp.where(free & ~state.done, target, state.position)
        at_goal = jnp.all(moved == state.task.goal)
        reward = jnp.where(state.done, 0.0, GOAL_REWARD * at_goal - STEP_PENALTY)
        steps = state.steps + ~state.done
        done = state.done | at_goal | (steps >= self.horizon)
        state = MazeState(state.task, moved, steps, done)
        return state, self._observe(state, reward, at_goal)

    def _observe(
        self, state: MazeState, reward: Float[Array, ""], at_goal: Bool[Array, ""]
    ) -> TimeStep:
        goal = self.goal_at(state.position)
        rays = free_cells(state.task.maze, state.position).astype(jnp.float32) / self.side
        return TimeStep(
            obs=jnp.concatenate([goal, rays]),
            goal=goal,
            goal_reached=jnp.ones((), bool),
            outcome=goal,
            reward=reward,
            terminated=at_goal,
            truncated=(state.steps >= self.horizon) & ~at_goal,
        )


def free_cells(maze: Int[Array, "S S"], position: Int[Array, "2"]) -> Int[Array, "4"]:
    """How many free cells lie to the west, north, east and south before the first wall."""
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


def generate_maze(
    key: PRNGKeyArray, side: int, complexity: float = 0.75, density: float = 0.75
) -> Int[Array, "S S"]:
    """A maze of the classic "mazelab" random walk, with MazeRunner's start area; 1 is a wall.

    The classic procedure picks ``density * (side // 2)**2`` times an even cell, makes it a wall and
    grows a wall from it: ``complexity * 10 * side`` times it looks at a random even cell two steps
    away and, if that is free, walls it with the cell between and goes on from there. Most looks find
    a wall and change nothing. Here one loop step is one *change*: the number of looks it took is
    drawn from its geometric distribution, so mazes have the same distribution at a small part of the
    steps.
    """
    num_islands = int(density * (side // 2) * (side // 2))
    num_looks = int(complexity * 5 * (side + side))
    nodes = side // 2 + 1  # even cells along one axis
    offsets = jnp.asarray(MOVES[:4])
    border = jnp.zeros((side, side), jnp.int8)
    border = border.at[jnp.array([0, -1])].set(1).at[:, jnp.array([0, -1])].set(1)

    class Walk(NamedTuple):
        maze: Int[Array, "S S"]
        node: Int[Array, "2"]
        looks_left: Int[Array, ""]
        islands_left: Int[Array, ""]
        key: PRNGKeyArray

    def change(walk: Walk) -> Walk:
        key, key_island, key_looks, key_neighbor = jax.random.split(walk.key, 4)
        neighbors = walk.node + offsets
        inside = jnp.all((neighbors >= 0) & (neighbors < nodes), axis=1)
        clipped = jnp.clip(neighbors, 0, nodes - 1)
        free = inside & (walk.maze[2 * clipped[:, 0], 2 * clipped[:, 1]] == 0)
        # Looks until a free neighbor is found, each a uniform draw among those inside.
        hit = free.sum() / inside.sum()
        miss = jnp.log1p(-jnp.minimum(hit, 1 - 1e-7))
        looks = 1 + jnp.floor(jnp.log(jax.random.uniform(key_looks, minval=1e-12)) / miss)
        grows = jnp.any(free) & (looks <= walk.looks_left)

        target = neighbors[
            jnp.argmax(jnp.where(free, jax.random.uniform(key_neighbor, (4,)), -1.0))
        ]
        island = jax.random.randint(key_island, (2,), 0, nodes)
        between = jnp.where(grows, walk.node + target, 2 * island)
        node = jnp.where(grows, target, island)
        looks_left = jnp.where(grows, walk.looks_left - looks.astype(jnp.int32), num_looks)
        islands_left = walk.islands_left - ~grows
        active = islands_left >= 0  # the last island has grown
        rows = jnp.stack([between[0], 2 * node[0]])
        columns = jnp.stack([between[1], 2 * node[1]])
        walls = jnp.maximum(walk.maze[rows, columns], active.astype(jnp.int8))
        maze = walk.maze.at[rows, columns].set(walls)
        return Walk(maze, node, looks_left, islands_left, key)

    start = Walk(border, jnp.zeros(2, jnp.int32), jnp.int32(0), jnp.int32(num_islands), key)
    maze = jax.lax.while_loop(lambda walk: walk.islands_left >= 0, change, start).maze

    maze = maze.at[side - 5 : side - 1, 1:-1].set(0)
    middle = side // 2
    corridor = jnp.array([middle - 1, middle + 1])
    return maze.at[side - 4 : side - 1, corridor].set(1).astype(jnp.int32)
