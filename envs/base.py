"""The records of an episode, and what a world has to offer.

A world is a static spec and pure functions over traced tasks and states. Everything is written for one
episode; ``jax.vmap`` adds the axes of batches, tasks and seeds.

Axes in shapes: T time steps, D components of an observation, G components of a goal, A components of an
action, N tasks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from envs.errors import NotAvailableError

Task = Any  # a pytree of arrays: a maze and a goal, an order of subtasks, the seed of a map ...
State = Any  # a pytree of arrays


@dataclass(frozen=True)
class ArraySpec:
    """Shape and dtype of an array without its content."""

    shape: tuple[int, ...]
    dtype: str = "float32"

    @property
    def size(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def is_float(self) -> bool:
        return np.issubdtype(np.dtype(self.dtype), np.floating)

    def __str__(self) -> str:
        return f"{self.dtype}{list(self.shape)}"


@dataclass(frozen=True)
class Discrete:
    """Actions are the integers 0 to ``num`` - 1."""

    num: int


@dataclass(frozen=True)
class Box:
    """Actions are ``size`` numbers in [-1, 1]."""

    size: int


@dataclass(frozen=True, kw_only=True)
class ObsLayout:
    """What the numbers of a flat observation are, where they are not all amounts.

    First come the codes of ``num_cells`` cells, then ``num_counts`` counts, then numbers. The code of a
    cell is made of digits d_0, d_1, .. below ``code_sizes``: it is d_0 + code_sizes[0] * (d_1 +
    code_sizes[1] * (d_2 + ..)), as of what lies in the cell and who stands there.

    Attributes:
      num_cells: number of cells.
      code_sizes: how many values each digit of a code has; a single size is for codes without digits.
      num_counts: number of counts.
      max_count: the largest count; counts are integers from 0 on.
    """

    num_cells: int
    code_sizes: tuple[int, ...]
    num_counts: int
    max_count: int


@dataclass(frozen=True, kw_only=True)
class EnvSpec:
    """Static facts of a world.

    Attributes:
      name: what messages and file names call the world.
      obs: shape and dtype of an observation.
      goal_dim: size G of a goal.
      actions: the space of actions.
      horizon: number of steps after which an episode is truncated.
      return_range: smallest and largest possible return; the optimizers scale by it.
      truncate_in_hindsight: whether a trajectory that is cut at any step is a trajectory to another
        task goal (paper, appendix D: true in MazeRunner, where every position is a goal).
      deterministic: whether task and actions determine an episode. If not, the return of one greedy
        episode is only a sample of what a prompt is worth.
      reward_confirms_goals: whether a reward at a goal says that this goal was the right one at this
        point, as in worlds that reward a sequence part by part.
      goals_are_states: whether the goal reached says in which state a task is, as far as a policy can
        tell states apart. What was seen in several episodes then is one map.
      layout: what the numbers of an observation are, for encoders that embed codes and counts [amounts].
    """

    name: str
    obs: ArraySpec
    goal_dim: int
    actions: Discrete | Box
    horizon: int
    return_range: tuple[float, float]
    truncate_in_hindsight: bool = False
    deterministic: bool = True
    reward_confirms_goals: bool = False
    goals_are_states: bool = False
    layout: ObsLayout | None = None

    @property
    def discrete(self) -> bool:
        return isinstance(self.actions, Discrete)

    @property
    def action_dim(self) -> int:
        """The number of discrete actions, or the size A of a continuous one."""
        return self.actions.num if isinstance(self.actions, Discrete) else self.actions.size

    def zero_action(self) -> Array:
        """An action of the right shape and dtype."""
        return jnp.zeros((), jnp.int32) if self.discrete else jnp.zeros(self.action_dim)


@dataclass(frozen=True)
class Engine:
    """How programs that hold steps of a world want to be run.

    Attributes:
      worlds_together: how many worlds a step should advance at least, for engines whose calls are
        expensive however few worlds they step.
      compiler_options: XLA options, pairs of name and value, to compile such programs with.
    """

    worlds_together: int = 1
    compiler_options: tuple[tuple[str, bool], ...] = ()


class TimeStep(NamedTuple):
    """What the agent is told after a reset or a step."""

    obs: Shaped[Array, "..."]
    achieved_goal: Float[Array, "G"]
    """The goal reached now, f_G(o_t) in section 2.1 of the paper."""
    goal_reached: Bool[Array, ""]
    """Whether ``achieved_goal`` counts as reached at this step (mazes: always; subtasks: on completion)."""
    outcome: Float[Array, "G"]
    """The task goal that this episode would have in hindsight if it ended now."""
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    failed: Bool[Array, ""] | bool = False
    """Whether the world broke down (diverged physics) and ended the episode because of that."""


class Goals(NamedTuple):
    """The goals that an episode reached: all that prompts are drawn from.

    Steps t < length are real, the others padding. Entries at ``t`` describe the world after action ``t``.
    """

    achieved_goals: Float[Array, "*batch T G"]
    goal_reached: Bool[Array, "*batch T"]
    outcomes: Float[Array, "*batch T G"]
    length: Int[Array, "*batch"]


class Trajectory(NamedTuple):
    """What an episode leaves behind for hindsight: the steps t < length are real, the others padding.

    ``obs[t]`` is what the agent saw before ``actions[t]``. ``achieved_goals[t]``, ``goal_reached[t]``
    and ``outcomes[t]`` describe the world after it.
    """

    obs: Shaped[Array, "..."]
    """``[*batch, T, ...]``, in the dtype of the world."""
    actions: Array
    """``[*batch, T]`` integers, or ``[*batch, T, A]`` floats."""
    achieved_goals: Float[Array, "*batch T G"]
    goal_reached: Bool[Array, "*batch T"]
    outcomes: Float[Array, "*batch T G"]
    length: Int[Array, "*batch"]
    intended: Array | None = None
    """What the agent intended where it executed ``actions``, in their shape and dtype, for agents that
    tell it (``Agent.intended``)."""

    @property
    def steps(self) -> dict[str, Any]:
        """The arrays that have a row for every step, by name, without those that are None."""
        rows = {name: rows for name, rows in self._asdict().items() if name != "length"}
        return {name: array for name, array in rows.items() if array is not None}

    @property
    def labels(self) -> Any:
        """What behavior cloning imitates: the intended actions, or the executed ones of an agent that
        tells no others."""
        return self.actions if self.intended is None else self.intended

    @property
    def goals(self) -> Goals:
        """The trajectory without its observations and actions."""
        return Goals(self.achieved_goals, self.goal_reached, self.outcomes, self.length)


class Episode(NamedTuple):
    """One finished episode."""

    trajectory: Trajectory
    rewards: Float[Array, "*batch T"]
    return_: Float[Array, "*batch"]
    """Undiscounted sum of the rewards."""
    last_obs: Shaped[Array, "..."]
    """The observation after the last action."""
    first_goal: Float[Array, "*batch G"] | tuple[()] = ()
    """The goal that was reached at the start, before any action."""
    failed: Bool[Array, "*batch"] | bool = False
    """Whether the world broke down and ended the episode."""
    decisions: Any = ()
    """What the agent decided beside its actions (``Agent.decisions``)."""


@dataclass(frozen=True)
class Environment:
    """A world, to derive from. Frozen and hashable, so that equal worlds share one compiled program.

    A world defines ``spec``, ``sample_task``, ``task_goal``, ``reset`` and ``step``. Everything else has
    a default, which may be replaced by something better.
    """

    @property
    def spec(self) -> EnvSpec:
        raise NotImplementedError

    def sample_task(self, key: PRNGKeyArray) -> Task:
        """A random task, as a pytree of arrays."""
        raise NotImplementedError

    def task_goal(self, task: Task) -> Float[Array, "G"]:
        """The goal g^M that a task reveals to the agent."""
        raise NotImplementedError

    def reset(self, key: PRNGKeyArray, task: Task) -> tuple[State, TimeStep]:
        """The start of an episode. All chance in the episode comes from ``key``."""
        raise NotImplementedError

    def step(self, state: State, action: Array) -> tuple[State, TimeStep]:
        """One step. Terminal states absorb with reward 0; there is no auto-reset."""
        raise NotImplementedError

    @property
    def engine(self) -> Engine:
        """How programs that hold steps of this world want to be run (default: in no special way)."""
        return Engine()

    def optimal_return(self, task: Task) -> Float[Array, ""]:
        """The best return that any policy can have on this task (default: NaN, which means unknown).

        Where the optimum is unknown, no regret is computed, printed or stored.
        """
        del task
        return jnp.full((), jnp.nan)

    def solvable(self, task: Task) -> Bool[Array, ""]:
        """Whether anyone could solve a valid task within the horizon (default: yes).

        A task that nobody can solve is refused where a user brings it, and never counts as solved: see
        ``check_solvable``.
        """
        del task
        return jnp.ones((), bool)

    @property
    def goal_names(self) -> tuple[str, ...]:
        """Names of the first components of a goal, where each stands for something that an episode achieves
        or not (default: none).

        A component of an outcome above 1/2 means that this was achieved. Judged episodes are then counted
        by what they achieved.
        """
        return ()

    def num_parts(self, task: Task) -> Int[Array, ""]:
        """The number n of parts of this task that pay 1/n each when they are done in order.

        The default is 0: the task is not rewarded part by part. Elsewhere the return of an episode times n
        is the number of parts that were done.
        """
        del task
        return jnp.zeros((), jnp.int32)

    def sample_goal(self, key: PRNGKeyArray) -> Float[Array, "G"]:
        """A random goal that can stand in a prompt, drawn without knowledge of the task.

        Raises:
          NotAvailableError: by default. Methods that insert random goals into prompts then cannot be used.
        """
        del key
        raise NotAvailableError(
            f"{self.spec.name} draws no goals at random (its class does not define sample_goal)"
        )

    @property
    def goal_set(self) -> np.ndarray:
        """The goals that an agent can be told to reach one at a time, [N, G].

        Raises:
          NotAvailableError: by default. Methods that choose among goals then cannot be used.
        """
        raise NotAvailableError(
            f"{self.spec.name} has no list of goals to choose from (its class does not define goal_set)"
        )

    def expert_goal(self, state: State, num_steps: int) -> Float[Array, "G"]:
        """The goal to go for from a state on, told by somebody who knows the task and everything else.

        It is what tells how good a hierarchy can be whose high level needs to learn nothing.

        Args:
          state: of an episode in progress.
          num_steps: number of steps until the next goal is told.

        Raises:
          NotAvailableError: by default.
        """
        del state, num_steps
        raise NotAvailableError(
            f"{self.spec.name} tells no goals to go for (its class does not define expert_goal)"
        )

    def fingerprint(self, task: Task) -> Int[Array, "F"]:
        """What must differ between the tasks of training and test (default: all bytes of the task)."""
        leaves = [_without_key(jnp.asarray(leaf)) for leaf in jax.tree.leaves(task)]
        leaves = [leaf.astype(jnp.uint8) if leaf.dtype == bool else leaf for leaf in leaves]
        as_bytes = [jax.lax.bitcast_convert_type(leaf, jnp.uint8).ravel() for leaf in leaves]
        return jnp.concatenate(as_bytes).astype(jnp.int32)

    def check_task(self, tasks: Task) -> None:
        """Raise ``ValueError`` with a sentence on what is wrong with N stacked tasks.

        The default compares shapes and kinds of numbers with those of ``sample_task``, and refuses
        numbers that are not finite. A world adds rules of its own, such as what the walls of a maze are.
        """
        check_shapes(tasks, jax.eval_shape(self.sample_task, jax.random.key(0)))

    def check_solvable(self, tasks: Task) -> None:
        """Raise ``ValueError`` with a sentence on the first of N stacked tasks that is not ``solvable``.

        The tasks are valid ones. A world may replace it by one that says why nobody can solve a task.
        """
        can = np.asarray(jax.jit(jax.vmap(self.solvable))(jax.tree.map(jnp.asarray, tasks)))
        if not can.all():
            raise ValueError(
                f"task {int(np.argmin(can))}: nobody can solve it in the {self.spec.horizon} steps of an "
                f"episode of {self.spec.name}"
            )


def _without_key(leaf: Array) -> Array:
    """The raw data of random keys; any other array as it is."""
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.key_data(leaf) if is_key else leaf


def check_shapes(tasks: Task, example: Task) -> None:
    """Raise ``ValueError`` for the first array of N stacked tasks that holds no tasks like ``example``."""
    paths, _ = jax.tree_util.tree_flatten_with_path(example)
    leaves = jax.tree.leaves(tasks)
    if len(leaves) != len(paths):
        raise ValueError(f"a task has {len(paths)} arrays, found {len(leaves)}")
    num: int | None = None  # N, once the first array has told it
    for (path, like), leaf in zip(paths, leaves, strict=True):
        name, array = jax.tree_util.keystr(path, simple=True) or "the task", np.asarray(leaf)
        stacked = array.ndim == like.ndim + 1 and array.shape[1:] == like.shape
        if not stacked or len(array) != (len(array) if num is None else num):
            wanted = ", ".join(map(str, ["N" if num is None else num, *like.shape]))
            raise ValueError(f"{name} must have shape [{wanted}], found {list(array.shape)}")
        num = len(array)
        found, wanted = _kind(array.dtype), _kind(like.dtype)
        if found != wanted and (found, wanted) != ("integers", "numbers"):
            raise ValueError(f"{name} must hold {wanted}, found {array.dtype}")
        if np.issubdtype(array.dtype, np.inexact) and not np.isfinite(array).all():
            raise ValueError(f"{name} holds NaN or infinity")


def _kind(dtype: np.dtype) -> str:
    """What arrays of this dtype hold, in a word for messages."""
    kinds = {"b": "booleans", "i": "integers", "u": "integers", "f": "numbers"}
    return kinds.get(dtype.kind, str(dtype))


def keeps_its_size(memory: Any, num_steps: int) -> Any:
    """The memory of an agent that needs no more room as an episode goes on."""
    del num_steps
    return memory


class Agent(NamedTuple):
    """Whoever acts in an episode: a policy with its prompt, or a demonstrator of a dataset.

    ``begin`` and ``proceed`` return ``(action, quits, memory)``. An agent that quits ends the episode
    before the action.
    """

    begin: Callable
    """``(key, task, state, timestep)`` at the start of an episode."""
    proceed: Callable
    """``(key, memory, state, timestep)`` after every step."""
    grow: Callable = keeps_its_size
    """``(memory, num_steps) -> memory`` with room for that many more steps."""
    decisions: Callable = lambda memory: ()
    """``(memory) -> decisions``: what it decided in the episode beside its actions, for agents whose
    decisions last several steps. It is asked when all episodes of a batch have ended, and until then an
    agent acts on: keep decisions by the step they were made in, of which the first ``length`` count."""
    intended: Callable[[Any], Array] | None = None
    """``(memory) -> action`` that the agent intended in its latest ``begin`` or ``proceed``, in the shape
    and dtype of the action that it executed. A demonstrator that executes other actions now and then,
    such as random ones, defines it: what was executed is the history that a policy reads, and what was
    intended is what it imitates (default: the agent executes what it intends, and nothing is kept)."""


class Demonstrator(NamedTuple):
    """Where a dataset comes from: tasks to demonstrate and the agent that does."""

    sample_task: Callable
    """``(key, index) -> task`` of the index-th demonstration."""
    agent: Callable[[Any], Agent]
    """``(weights) -> agent``."""
    keeps: Callable = lambda episode: episode.trajectory.length > 0
    """``(episode) -> bool``; other demonstrations are dropped and tried again."""
    hindsight_return: Callable | None = None
    """``(trajectory) -> return`` on the task that the trajectory happens to solve (default: the return
    of the episode)."""
    weights: Any = ()
    """Arrays that the agent is made from, such as the weights of a network; they enter programs as data."""
    settings: tuple[tuple[str, float], ...] = ()
    """Names and values of what else its data depends on; a dataset made with others is out of date."""
    configured: Callable[[Mapping[str, float]], Demonstrator] | None = None
    """``(values) -> demonstrator`` with some of its settings changed; raises ``ValueError`` for a value out
    of range. None where they are fixed."""
    env: Environment | None = None
    """The world that it demonstrates in, where that is another one than the world it is asked for. Both
    have the same observations, goals and actions, and equal tasks have equal fingerprints."""
    variants: tuple[str, ...] = ()
    """Names of the variants of that world, such as its scenes, of which each task is of one."""
    variant: Callable = lambda task: jnp.zeros((), jnp.int32)
    """``(task) -> index`` into ``variants``; a dataset keeps it for every trajectory."""
