"""What a world is: a static spec and pure functions over traced tasks and states.

Everything is written for one episode; batch, task and seed axes come from ``jax.vmap``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

Task = Any  # a pytree of arrays: maze and goal, order of subtasks, world seed ...
State = Any  # a pytree of arrays


@dataclass(frozen=True)
class EnvSpec:
    """Static facts of a world.

    Attributes:
      name: the name ``envs.make`` knows it by.
      obs_dim: size D of an observation.
      goal_dim: size G of a goal.
      action_dim: number of discrete actions, or size A of a continuous action.
      discrete: whether actions are integers in ``[0, action_dim)``.
      horizon: steps after which an episode is truncated.
      return_range: smallest and largest possible return; the optimizers scale by it.
      truncate_in_hindsight: whether a trajectory cut at any step is a trajectory to another
        task goal (paper, appendix D: true in MazeRunner, where every position is a goal).
      deterministic: whether task and actions determine an episode; if not, one greedy episode is
        only a sample of what a prompt is worth.
      reward_confirms_goals: whether a reward at a goal says that this goal was the right one at this
        point, as where a sequence is rewarded part by part.
      num_test_tasks: tasks kept for test.
      worlds_together: how many worlds a step should advance at least, where one alone is as dear as some.
      compiler_options: XLA options, name and value, that programs holding a step should be compiled with.
    """

    name: str
    obs_dim: int
    goal_dim: int
    action_dim: int
    discrete: bool
    horizon: int
    return_range: tuple[float, float]
    truncate_in_hindsight: bool
    deterministic: bool
    reward_confirms_goals: bool
    num_test_tasks: int = 50
    worlds_together: int = 1
    compiler_options: tuple[tuple[str, bool], ...] = ()


class TimeStep(NamedTuple):
    """What the agent is told after a reset or a step."""

    obs: Float[Array, "D"]
    goal: Float[Array, "G"]
    """The goal reached now, f_G(o_t) in section 2.1."""
    goal_reached: Bool[Array, ""]
    """Whether ``goal`` counts as reached at this step (mazes: always; subtasks: on completion)."""
    outcome: Float[Array, "G"]
    """The task goal this episode would have in hindsight if it ended now."""
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    failed: Bool[Array, ""] | bool = False
    """Whether the world broke down (diverged physics) and ended the episode because of that."""


@runtime_checkable
class Environment(Protocol):
    """A world. Frozen and hashable, so that equal worlds share one compiled program."""

    @property
    def spec(self) -> EnvSpec: ...

    def __hash__(self) -> int: ...

    def sample_task(self, key: PRNGKeyArray) -> Task:
        """A random task, as a pytree of arrays."""
        ...

    def sample_goal(self, key: PRNGKeyArray) -> Float[Array, "G"]:
        """A random goal that can stand in a prompt, without knowledge of the task."""
        ...

    def task_goal(self, task: Task) -> Float[Array, "G"]:
        """The goal g^M that a task reveals to the agent."""
        ...

    def optimal_return(self, task: Task) -> Float[Array, ""]:
        """The best return any policy can have on this task."""
        ...

    def fingerprint(self, task: Task) -> Int[Array, "F"]:
        """What must differ between the tasks of training and test."""
        ...

    def check_task(self, task: Task) -> None:
        """Raise ``ValueError`` with a sentence on what is wrong with a batch of tasks [N, ...]."""
        ...

    def reset(self, key: PRNGKeyArray, task: Task) -> tuple[State, TimeStep]: ...

    def step(self, state: State, action: Array) -> tuple[State, TimeStep]:
        """One step; terminal states absorb with reward 0. There is no auto-reset."""
        ...


class Agent(NamedTuple):
    """Whoever acts in an episode: a policy with its prompt, or a demonstrator of a dataset.

    ``begin`` and ``proceed`` return ``(action, quits, memory)``; an agent that quits ends the episode
    before the action.
    """

    begin: Callable
    """``(key, task, state, timestep)`` at the start of an episode."""
    proceed: Callable
    """``(key, memory, state, timestep)`` after every step."""
    grow: Callable = lambda memory, num_steps: memory
    """Makes room in the memory for that many more steps."""


class Demonstrator(NamedTuple):
    """Where a dataset comes from: tasks to demonstrate and the agent that does."""

    sample_task: Callable
    """``(key, index) -> task`` of the index-th demonstration."""
    agent: Agent
    keeps: Callable
    """``episode -> bool``; other demonstrations are dropped and tried again."""
    hindsight_return: Callable
    """``trajectory -> return`` on the task that the trajectory happens to solve."""
    settings: tuple[tuple[str, float], ...] = ()
    """Names and values of what else its data depends on; a dataset made with others is out of date."""
