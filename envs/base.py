"""The records of an episode, and the interface of a world (environment).

A world consists of a static spec (``envs.specs``) and pure functions of traced tasks and states. Everything
is written for one episode; ``jax.vmap`` adds the axes of batches, tasks and seeds.

Axes in shapes: T time steps, D components of an observation, G components of a goal, A components of an
action, N tasks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from envs.errors import NotAvailableError
from envs.specs import Engine, EnvSpec

Task = Any  # a pytree of arrays: a maze and a goal, an order of subtasks, the seed of a map ...
State = Any  # a pytree of arrays


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
