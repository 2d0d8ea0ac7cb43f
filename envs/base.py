"""The records of an episode, and the interface of a world (environment).

A world consists of a static spec and pure functions of traced tasks and states. Everything is written for
one episode; ``jax.vmap`` adds the axes of batches, tasks and seeds.

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
    """Shape and dtype of an array."""

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
    """The meaning of the numbers in a flat observation, if some of them are categorical codes or counts.

    The codes of ``num_cells`` cells come first, then ``num_counts`` counts, then plain numbers. The code of
    a cell combines several digits d_0, d_1, .., such as the block in the cell and the creature on it. It is
    d_0 + code_sizes[0] * (d_1 + code_sizes[1] * (d_2 + ..)).

    Attributes:
      num_cells: number of cells.
      code_sizes: number of values of each digit of a code; a single size if codes are not divided into
        digits.
      num_counts: number of counts.
      max_count: the largest count; counts are integers from 0.
    """

    num_cells: int
    code_sizes: tuple[int, ...]
    num_counts: int
    max_count: int


@dataclass(frozen=True, kw_only=True)
class EnvSpec:
    """The static specification of a world.

    Attributes:
      name: the name of the world in messages and file names.
      obs: shape and dtype of an observation.
      goal_dim: size G of a goal.
      actions: the action space.
      horizon: number of steps after which an episode is truncated.
      return_range: smallest and largest possible return, by which optimizers scale returns.
      truncate_in_hindsight: whether a trajectory that is cut at any step is a demonstration of another task
        goal (paper, appendix D: true in MazeRunner, where every position is a goal).
      deterministic: whether the task and the actions determine an episode. If not, the return of one greedy
        episode is only a sample from the return distribution of a prompt.
      reward_confirms_goals: whether a reward at a goal means that this goal was the right one at this
        point, as in worlds that reward a sequence part by part.
      goals_are_states: whether the achieved goal determines the state of a task, as far as a policy can
        distinguish states. Then the observations of several episodes can be combined into one map.
      layout: the meaning of an observation's numbers, for encoders that embed codes and counts [all are
        plain numbers].
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
    """Requirements of a world's simulation engine on the compiled programs that step it.

    Attributes:
      worlds_together: smallest efficient batch of worlds in a step, for engines with a high overhead per
        call.
      compiler_options: XLA options for such programs, as pairs of name and value.
    """

    worlds_together: int = 1
    compiler_options: tuple[tuple[str, bool], ...] = ()


class TimeStep(NamedTuple):
    """The output of a world after a reset or a step."""

    obs: Shaped[Array, "..."]
    achieved_goal: Float[Array, "G"]
    """The currently achieved goal, f_G(o_t) in section 2.1 of the paper."""
    goal_reached: Bool[Array, ""]
    """Whether ``achieved_goal`` counts as reached at this step (mazes: always; subtasks: on completion)."""
    outcome: Float[Array, "G"]
    """The task goal that this episode would accomplish in hindsight if it ended now."""
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    failed: Bool[Array, ""] | bool = False
    """Whether the simulation failed (such as by diverging physics), which ends the episode."""


class Goals(NamedTuple):
    """The goals that an episode reached, from which prompts are drawn.

    Steps t < length are real, the others are padding. Entries at ``t`` describe the world after action
    ``t``.
    """

    achieved_goals: Float[Array, "*batch T G"]
    goal_reached: Bool[Array, "*batch T"]
    outcomes: Float[Array, "*batch T G"]
    length: Int[Array, "*batch"]


class Trajectory(NamedTuple):
    """The observations, actions and goals of an episode, padded to T steps.

    Steps t < length are real, the others are padding. ``obs[t]`` is the observation before ``actions[t]``,
    while ``achieved_goals[t]``, ``goal_reached[t]`` and ``outcomes[t]`` describe the world after that
    action.
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
    """The actions that the agent intended when it executed ``actions``, with the same shape and dtype; None
    for agents without ``Agent.intended``."""

    @property
    def steps(self) -> dict[str, Any]:
        """The arrays with a row for every step, by name, without those that are None."""
        rows = {name: rows for name, rows in self._asdict().items() if name != "length"}
        return {name: array for name, array in rows.items() if array is not None}

    @property
    def labels(self) -> Any:
        """The targets of behavior cloning: the intended actions if they are known, otherwise the executed
        ones."""
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
    """The achieved goal at the start, before any action."""
    failed: Bool[Array, "*batch"] | bool = False
    """Whether the episode ended because the simulation failed."""
    decisions: Any = ()
    """The agent's decisions besides its actions (``Agent.decisions``)."""


@dataclass(frozen=True)
class Environment:
    """The base class of worlds; frozen and hashable, so that equal worlds share compiled programs.

    A subclass must define ``spec``, ``sample_task``, ``task_goal``, ``reset`` and ``step``. All other
    methods have defaults that it may override.
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
        """Begin an episode. All randomness of the episode comes from ``key``."""
        raise NotImplementedError

    def step(self, state: State, action: Array) -> tuple[State, TimeStep]:
        """Take one step. Terminal states are absorbing, with reward 0; there is no auto-reset."""
        raise NotImplementedError

    @property
    def engine(self) -> Engine:
        """Requirements on compiled programs that step this world (default: none)."""
        return Engine()

    def optimal_return(self, task: Task) -> Float[Array, ""]:
        """The highest return that any policy can achieve on this task (default: NaN, which means unknown).

        If the optimum is unknown, no regret is computed, printed or stored.
        """
        del task
        return jnp.full((), jnp.nan)

    def solvable(self, task: Task) -> Bool[Array, ""]:
        """Whether a valid task can be solved within the horizon (default: yes).

        An unsolvable task is rejected if a user brings it (``check_solvable``), and never counts as solved.
        """
        del task
        return jnp.ones((), bool)

    @property
    def goal_names(self) -> tuple[str, ...]:
        """Names of the first components of a goal, if each is something to achieve (default: none).

        It was achieved if the component of the outcome is above 1/2. For judging episodes the fraction that
        achieved each of them is reported.
        """
        return ()

    def num_parts(self, task: Task) -> Int[Array, ""]:
        """The number n of parts of this task, if each pays 1/n when they are completed in order.

        The default is 0, for tasks that are not rewarded part by part. Otherwise the return of an episode
        times n is the number of completed parts.
        """
        del task
        return jnp.zeros((), jnp.int32)

    def sample_goal(self, key: PRNGKeyArray) -> Float[Array, "G"]:
        """A random goal for a prompt, drawn without knowledge of the task.

        Raises:
          NotAvailableError: by default. Then methods that insert random goals into prompts cannot be used.
        """
        del key
        raise NotAvailableError(
            f"{self.spec.name} draws no goals at random (its class does not define sample_goal)"
        )

    @property
    def goal_set(self) -> np.ndarray:
        """The N goals that an agent can be commanded to reach one at a time, [N, G].

        Raises:
          NotAvailableError: by default. Then methods that choose among goals cannot be used.
        """
        raise NotAvailableError(
            f"{self.spec.name} has no list of goals to choose from (its class does not define goal_set)"
        )

    def expert_goal(self, state: State, num_steps: int) -> Float[Array, "G"]:
        """The next goal to pursue, chosen by an expert with full knowledge of the task and the state.

        With these goals a hierarchy is evaluated without learning its high level, though other goals may
        suit it better.

        Args:
          state: the state of an episode in progress.
          num_steps: number of steps until the next goal is chosen.

        Raises:
          NotAvailableError: by default.
        """
        del state, num_steps
        raise NotAvailableError(
            f"{self.spec.name} provides no expert goals (its class does not define expert_goal)"
        )

    def fingerprint(self, task: Task) -> Int[Array, "F"]:
        """The part of a task in which training and test tasks must differ (default: all bytes of the
        task)."""
        leaves = [raw(jnp.asarray(leaf)) for leaf in jax.tree.leaves(task)]
        leaves = [leaf.astype(jnp.uint8) if leaf.dtype == bool else leaf for leaf in leaves]
        as_bytes = [jax.lax.bitcast_convert_type(leaf, jnp.uint8).ravel() for leaf in leaves]
        return jnp.concatenate(as_bytes).astype(jnp.int32)

    def check_task(self, tasks: Task) -> None:
        """Raise ``ValueError`` with a sentence about the first fault of N stacked tasks.

        The default compares shapes and kinds of numbers with those of ``sample_task``, and rejects numbers
        that are not finite. A world adds its own rules, such as which values stand for the walls of a maze.
        """
        check_shapes(tasks, jax.eval_shape(self.sample_task, jax.random.key(0)))

    def check_solvable(self, tasks: Task) -> None:
        """Raise ``ValueError`` with a sentence about the first of N stacked tasks that is not ``solvable``.

        The tasks must be valid. A world may override this to say why a task cannot be solved.
        """
        can = np.asarray(jax.jit(jax.vmap(self.solvable))(jax.tree.map(jnp.asarray, tasks)))
        if not can.all():
            raise ValueError(
                f"task {int(np.argmin(can))} cannot be solved within the {self.spec.horizon} steps of an "
                f"episode of {self.spec.name}"
            )


def is_key(leaf: Any) -> bool:
    """Whether an array holds random keys."""
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def raw(leaf: Any) -> Any:
    """The raw data of random keys; anything else unchanged."""
    return jax.random.key_data(leaf) if is_key(leaf) else leaf


def check_shapes(tasks: Task, example: Task) -> None:
    """Raise ``ValueError`` for the first array of N stacked tasks that does not match the task
    ``example``."""
    paths, _ = jax.tree_util.tree_flatten_with_path(example)
    leaves = jax.tree.leaves(tasks)
    if len(leaves) != len(paths):
        raise ValueError(f"a task has {len(paths)} arrays, found {len(leaves)}")
    num: int | None = None  # N, which the first array determines
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
    """The kind of values in arrays of a dtype, as a word for messages."""
    kinds = {"b": "booleans", "i": "integers", "u": "integers", "f": "numbers"}
    return kinds.get(dtype.kind, str(dtype))


def keeps_its_size(memory: Any, num_steps: int) -> Any:
    """The ``grow`` of agents whose memory has a fixed size: returns the memory unchanged."""
    del num_steps
    return memory


class Agent(NamedTuple):
    """An agent that acts in an episode, such as a policy under a prompt, or the demonstrator of a dataset.

    ``begin`` and ``proceed`` return ``(action, quits, memory)``. An agent that quits ends the episode
    before the action is taken.
    """

    begin: Callable
    """``(key, task, state, timestep) -> (action, quits, memory)`` at the start of an episode."""
    proceed: Callable
    """``(key, memory, state, timestep) -> (action, quits, memory)`` after every step."""
    grow: Callable = keeps_its_size
    """``(memory, num_steps) -> memory`` with room for that many more steps."""
    decisions: Callable = lambda memory: ()
    """``(memory) -> decisions``: the decisions of the episode besides its actions, for agents whose
    decisions last several steps. It is called once all episodes of a batch have ended. Until then the agent
    continues to act, so it must store decisions by their step; those of the first ``length`` steps
    count."""
    intended: Callable[[Any], Array] | None = None
    """``(memory) -> action``: the action that the agent intended in its latest ``begin`` or ``proceed``,
    with the shape and dtype of the executed one. It is for demonstrators that sometimes execute other
    actions, such as random ones: policies read the executed actions as history, and imitate the intended
    ones (default: executed actions are the intended ones, and no others are kept)."""


class Demonstrator(NamedTuple):
    """The source of a dataset: tasks to demonstrate, and the agent that demonstrates them."""

    sample_task: Callable
    """``(key, index) -> task``: the task of the index-th demonstration."""
    agent: Callable[[Any], Agent]
    """``(weights) -> agent``."""
    keeps: Callable = lambda episode: episode.trajectory.length > 0
    """``(episode) -> bool``: whether to keep a demonstration; others are discarded and repeated."""
    hindsight_return: Callable | None = None
    """``(trajectory) -> return`` on the task that the trajectory accomplishes in hindsight (default: the
    return of the episode)."""
    weights: Any = ()
    """Arrays that the agent is made from, such as the parameters of a network; they are traced."""
    settings: tuple[tuple[str, float], ...] = ()
    """Names and values of the settings that the data depend on; a dataset made with others is out of
    date."""
    configured: Callable[[Mapping[str, float]], Demonstrator] | None = None
    """``(values) -> demonstrator`` with some of its settings changed; raises ``ValueError`` for a value out
    of range. None if the settings are fixed."""
    env: Environment | None = None
    """The world in which it demonstrates, if that differs from the world that the data are for. Both have
    the same observations, goals and actions, and equal tasks have equal fingerprints."""
    variants: tuple[str, ...] = ()
    """Names of the variants of the world, such as its scenes. Every task belongs to one variant."""
    variant: Callable = lambda task: jnp.zeros((), jnp.int32)
    """``(task) -> index`` into ``variants``, which a dataset stores for every trajectory."""
