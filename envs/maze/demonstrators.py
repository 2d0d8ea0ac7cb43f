"""Demonstrators of MazeRunner: "A*-n" and "Random" (paper, appendices B.3 and C.1).

Both know only what their four rays have shown them. A*-n visits n random goals. If the goal is on the known
map, the demonstrator takes the shortest known path to it. Otherwise it walks to the seen but unvisited cell
that minimizes G + H, the length of the known path to the cell plus its Manhattan distance to the goal; ties
are broken in favor of the cell nearest to the goal. It chooses a new cell on arrival, and whenever a goal
is reached. Random walks to one of the five nearest cells that are seen but unvisited.

Known maps are bitboards (``envs.maze.bitboard``). The path to the chosen cell is recomputed from the known
map at every step, so that shortcuts seen along the way are taken.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.agents import Agent, Demonstrator
from envs.base import Episode, TimeStep, Trajectory
from envs.maze.bitboard import distances, toward
from envs.maze.env import (
    GOAL_REWARD,
    MOVES,
    STAY,
    STEP_PENALTY,
    MazeRunner,
    MazeState,
    MazeTask,
    cells_in_sight,
    generate_maze,
)

FAR = 1 << 30
NUM_NEAREST = 5  # Random chooses among this many cells
MIN_LENGTH = 20  # shorter demonstrations are dropped


class Memory(NamedTuple):
    """The memory of a demonstrator within an episode."""

    seen: Bool[Array, "S S"]
    """Free cells seen so far, including visited ones."""
    visited: Bool[Array, "S S"]
    goals: Int[Array, "N 2"]
    num_reached: Int[Array, ""]
    target: Int[Array, "2"]
    """The cell that it is walking to."""


# (key, memory, steps to every known cell) -> (the next cell to walk to, whether there is none)
ChooseTarget = Callable[[PRNGKeyArray, Memory, Array], tuple[Array, Array]]


def astar(env: MazeRunner, num_goals: int) -> Agent:
    """The A*-n demonstrator with n = ``num_goals`` goals; it quits when all are reached."""

    def choose(key: PRNGKeyArray, memory: Memory, steps: Array) -> tuple[Array, Array]:
        del key
        side = env.side
        goal = memory.goals[jnp.minimum(memory.num_reached, num_goals - 1)]
        index = jnp.arange(side)
        manhattan = abs(index - goal[0])[:, None] + abs(index - goal[1])[None, :]
        # Of cells with equal G + H, the one nearest to the goal.
        score = (steps + manhattan) * side**2 + manhattan
        cell = jnp.argmin(jnp.where(_frontier(memory, steps), score, FAR))
        frontier_cell = jnp.stack([cell // side, cell % side])
        target = jnp.where(memory.seen[tuple(goal)], goal, frontier_cell)
        return target, memory.num_reached >= num_goals

    return _explorer(env, num_goals, choose)


def random_walk(env: MazeRunner) -> Agent:
    """The Random demonstrator; it quits when nothing is left to visit."""

    def choose(key: PRNGKeyArray, memory: Memory, steps: Array) -> tuple[Array, Array]:
        frontier = _frontier(memory, steps)
        nearness, cells = jax.lax.top_k(jnp.where(frontier, -steps, -FAR).ravel(), NUM_NEAREST)
        rank = jax.random.randint(key, (), 0, jnp.maximum(jnp.sum(nearness > -FAR), 1))
        return jnp.stack([cells[rank] // env.side, cells[rank] % env.side]), ~jnp.any(frontier)

    return _explorer(env, 0, choose)


def _frontier(memory: Memory, steps: Array) -> Bool[Array, "S S"]:
    return memory.seen & ~memory.visited & (steps >= 0)


def _explorer(env: MazeRunner, num_goals: int, choose: ChooseTarget) -> Agent:
    """An agent that walks from target to target through known cells."""
    side = env.side

    def draw_goals(key: PRNGKeyArray, task: MazeTask) -> Int[Array, "N 2"]:
        weight = (task.maze == 0).at[env.start].set(False).ravel()
        scores = jnp.where(weight, jax.random.uniform(key, (side * side,)), -1.0)
        _, cells = jax.lax.top_k(scores, num_goals)
        return jnp.stack([cells // side, cells % side], axis=1)

    def begin(
        key: PRNGKeyArray, task: MazeTask, state: MazeState, timestep: TimeStep
    ) -> tuple[Array, Array, Memory]:
        key_goals, key_choose = jax.random.split(key)
        nowhere = jnp.zeros((side, side), bool)
        memory = Memory(
            seen=nowhere,
            visited=nowhere,
            goals=draw_goals(key_goals, task),
            num_reached=jnp.zeros((), jnp.int32),
            target=state.position,
        )
        return proceed(key_choose, memory, state, timestep)

    def proceed(
        key: PRNGKeyArray, memory: Memory, state: MazeState, timestep: TimeStep
    ) -> tuple[Array, Array, Memory]:
        del timestep  # it observes the cells on its rays instead, see below
        position = state.position
        visited = memory.visited.at[tuple(position)].set(True)
        seen = memory.seen | cells_in_sight(state.task.maze, position)
        memory = memory._replace(seen=seen, visited=visited)

        arrived = jnp.all(position == memory.target)
        if num_goals:
            goal = memory.goals[jnp.minimum(memory.num_reached, num_goals - 1)]
            reached = jnp.all(position == goal) & (memory.num_reached < num_goals)
            memory = memory._replace(num_reached=memory.num_reached + reached)
            arrived |= reached
        chosen, quits = choose(key, memory, distances(seen, position))
        target = jnp.where(arrived, chosen, memory.target)

        neighbors = position + jnp.asarray(MOVES[:4])
        leads_on = toward(seen, position, target)[neighbors[:, 0], neighbors[:, 1]]
        action = jnp.where(jnp.any(leads_on), jnp.argmax(leads_on), STAY)
        return action, quits, memory._replace(target=target)

    return Agent(begin=begin, proceed=proceed)


def first_hit_return(trajectory: Trajectory) -> Float[Array, ""]:
    """The return in hindsight, on the task whose goal is the cell where the trajectory ends."""
    goals = trajectory.achieved_goals
    arrived = jnp.all(goals == goals[trajectory.length - 1], axis=-1)
    return GOAL_REWARD - STEP_PENALTY * (1 + jnp.argmax(arrived))


def maze_demonstrators(env: MazeRunner) -> dict[str, Demonstrator]:
    """The demonstrators of the datasets in Table 5, by name; that of the paper's main results comes
    first."""

    def endless_task(key: PRNGKeyArray, index: Int[Array, ""]) -> MazeTask:
        """A random maze whose goal is a wall, so that only the demonstrator ends the episode."""
        del index
        return MazeTask(maze=generate_maze(key, env.side), goal=jnp.zeros(2, jnp.int32))

    def long_enough(episode: Episode) -> Bool[Array, "*batch"]:
        return episode.trajectory.length >= MIN_LENGTH

    def demonstrator(make_agent: Callable[[], Agent]) -> Demonstrator:
        return Demonstrator(
            sample_task=endless_task,
            agent=lambda weights: make_agent(),
            keeps=long_enough,
            hindsight_return=first_hit_return,
        )

    return {
        "astar4": demonstrator(partial(astar, env, num_goals=4)),
        "astar1": demonstrator(partial(astar, env, num_goals=1)),
        "astar2": demonstrator(partial(astar, env, num_goals=2)),
        "random": demonstrator(partial(random_walk, env)),
    }
