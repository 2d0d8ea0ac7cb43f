"""A world from any gymnasium environment: its description, and what is derived from the environment itself.

``GymnasiumWorld(name=.., make=.., return_range=..).world()`` is a record that every command accepts. This
module imports neither jax nor gymnasium; one environment is created when the world is first used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from envs.errors import UsageError, shown
from envs.live import Act, Moment, Pool, Reading, Start, num_cores, single_envs
from envs.registry import World

if TYPE_CHECKING:
    from envs.agents import Demonstrator
    from envs.hosted import Hosted
    from envs.specs import ArraySpec, Box, Discrete

Script = Callable[[Any, np.random.Generator], Act]
"""``(env, generator) -> act``: called after the reset of an episode. ``act(moment)`` then returns the next
action, in units of the environment, or None to end the episode."""


class Shapes(NamedTuple):
    """Shapes and spaces, derived from one environment."""

    obs: ArraySpec
    goal: int
    actions: Discrete | Box
    horizon: int
    options: dict[str, np.ndarray]
    """The options of an example task."""
    blank: Reading
    """A reading of zeros with the right shapes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class GymnasiumWorld:
    """The description that turns a gymnasium environment into a world.

    All functions run on the host, with numpy. Functions of a moment have access to the observation, the
    ``info``, the environment itself, and the reward and the flags of the step (``envs.live.Moment``). If
    observations are those of a ``GoalEnv``, dicts with ``observation``, ``achieved_goal`` and
    ``desired_goal``, none of these functions needs to be given.

    Attributes:
      name: the name of the world.
      make: creates an environment, such as ``lambda: gymnasium.make("PointMaze_UMaze-v3")``. It may also
        return a ``gymnasium.vector.SyncVectorEnv``, whose environments are then used one by one.
      return_range: smallest and largest possible return.
      horizon: number of actions after which an episode is truncated [``max_episode_steps`` / ``repeat``].
      repeat: number of environment steps per action; their rewards are summed.
      options: ``(generator) -> dict`` of numbers and arrays that a task passes to ``reset(options=..)``; a
        task then consists of options and a seed [a task is only a seed].
      deterministic: whether an episode is reset with the seed of its task. If not, each episode has its own
        seed, and a task consists of the options alone.
      observe: ``(moment) -> observation`` of the policy [``observation`` of a dict, or the whole
        observation, with Discrete ones as one-hots].
      achieved: ``(moment) -> goal [G]`` that is achieved now [``achieved_goal``].
      desired: ``(moment) -> goal [G]`` of the task, given the moment after its reset [``desired_goal``].
      reached: ``(moment) -> bool``, whether the goal counts as reached now [always].
      outcome: ``(moment) -> goal [G]``, the task goal that an episode would accomplish in hindsight if it
        ended now [``achieved``].
      reward: ``(moment) -> reward`` [the environment's].
      scripts: the demonstrators, by name; the first is the default.
      goals: the goals from which random goals for prompts are drawn [none].
      optimum: the best return on every task [unknown].
      most: number of environments that are kept alive. Collection runs 250 episodes at once; with fewer
        environments, episodes are replayed from their resets, which is slow.
      threads: number of threads that step the environments, or None for one on each core [1, since Python
        code runs on one thread at a time].
      together: smallest number of episodes that a program steps in one call.
      truncate_in_hindsight, reward_confirms_goals, goals_are_states: see ``envs.EnvSpec``.
    """

    name: str
    make: Callable[[], Any]
    return_range: tuple[float, float]
    horizon: int | None = None
    repeat: int = 1
    options: Callable[[np.random.Generator], Mapping[str, Any]] | None = None
    deterministic: bool = True
    observe: Callable[[Moment], Any] | None = None
    achieved: Callable[[Moment], Any] | None = None
    desired: Callable[[Moment], Any] | None = None
    reached: Callable[[Moment], bool] = lambda moment: True
    outcome: Callable[[Moment], Any] | None = None
    reward: Callable[[Moment], float] = lambda moment: moment.reward
    scripts: Mapping[str, Script] = field(default_factory=dict)
    goals: Sequence[Sequence[float]] = ()
    optimum: float | None = None
    most: int = 256
    threads: int | None = 1
    together: int = 8
    truncate_in_hindsight: bool = False
    reward_confirms_goals: bool = False
    goals_are_states: bool = False

    def __post_init__(self) -> None:
        if self.options is None and not self.deterministic:
            raise UsageError(
                f"without options, a task of {self.name} is only a seed, so its episodes must be "
                "deterministic; pass options, or leave out deterministic=False"
            )
        for what, value in (
            ("repeat", self.repeat),
            ("most", self.most),
            ("threads", 1 if self.threads is None else self.threads),
            ("together", self.together),
        ):
            if value < 1:
                raise UsageError(f"{what} of {self.name} must be at least 1, found {value}")

    def world(self, **record: Any) -> World:
        """The record of the world.

        Args:
          record: further fields of ``World``, such as ``presets``, ``judged`` and ``num_test_tasks``.
        """
        return World(
            name=self.name,
            make=self.environment,
            demonstrators=lambda env: self.demonstrators,
            **record,
        )

    def environment(self) -> Hosted:
        """The environment of the world."""
        from envs.hosted import Hosted

        _ = self.shapes  # raises errors early, before the first use
        return Hosted(self)

    @cached_property
    def demonstrators(self) -> dict[str, Demonstrator]:
        from envs.hosted import script

        return {name: script(self, name) for name in self.scripts}

    @cached_property
    def pool(self) -> Pool:
        """The live environments."""
        return Pool(
            make=self.make,
            reset=self.reset,
            step=self.step,
            read=self.read,
            scripts=self.scripts,
            most=self.most,
            num_threads=self.threads or num_cores(),
            spare=single_envs(self._first_made)[1:],
        )

    @cached_property
    def shapes(self) -> Shapes:
        """Shapes and spaces, from one environment that is created and reset.

        Raises:
          UsageError: if they are not supported.
        """
        from envs.specs import ArraySpec

        env, options = self._example, self.drawn_options(0)
        moment = self.reset(env, Start(0, tuple(options[name] for name in sorted(options))))
        obs, goal = self._observed(moment), self._goal(moment, "achieved")
        for what, found in (
            ("desired", self.goal_of(moment)),
            ("outcome", self._outcome(moment, goal)),
        ):
            if found.shape != goal.shape:
                raise UsageError(
                    f"{what} of {self.name} has shape {list(found.shape)}, achieved has "
                    f"{list(goal.shape)}; goals must have one shape"
                )
        nothing = (obs, goal, goal, np.asarray(0, np.float32), np.zeros(4, np.uint8))
        blank = Reading(*map(np.zeros_like, nothing))
        return Shapes(
            obs=ArraySpec(obs.shape, str(obs.dtype)),
            goal=len(goal),
            actions=self._actions(env.action_space),
            horizon=self._horizon(env),
            options=options,
            blank=blank,
        )

    @cached_property
    def action_space(self) -> Any:
        """The action space of the environment."""
        return self._example.action_space

    @cached_property
    def _example(self) -> Any:
        """An environment that is only inspected; no episode runs in it."""
        return single_envs(self._first_made)[0]

    @cached_property
    def _first_made(self) -> Any:
        """The first result of ``make``, which may hold several environments."""
        return self.make()

    def _horizon(self, env: Any) -> int:
        limit = self.horizon
        if limit is None:
            spec = getattr(env, "spec", None)
            steps = getattr(spec, "max_episode_steps", None) or getattr(
                env.unwrapped, "max_steps", None
            )
            if steps is None:
                raise UsageError(
                    f"the environment of {self.name} has no max_episode_steps; say after how many actions "
                    "an episode is truncated with horizon"
                )
            limit = -(-steps // self.repeat)
        return limit

    def _actions(self, space: Any) -> Discrete | Box:
        from envs.specs import Box, Discrete

        kind = type(space).__name__
        if kind == "Discrete":
            return Discrete(int(space.n))
        if kind == "Box" and np.isfinite(space.low).all() and np.isfinite(space.high).all():
            return Box(int(np.prod(space.shape)))
        raise UsageError(
            f"actions of {self.name} are {shown(space)}; a world has Discrete ones, or a Box with finite "
            "bounds; wrap the environment (gymnasium.wrappers.TransformAction)"
        )

    def drawn_options(self, seed: int) -> dict[str, np.ndarray]:
        """The options of the task with this seed, as arrays of 32 bits or booleans."""
        drawn = self.options(np.random.default_rng(seed)) if self.options else {}
        return {name: _to_32_bits(np.asarray(drawn[name])) for name in sorted(drawn)}

    @cached_property
    def _option_names(self) -> list[str]:
        return sorted(self.drawn_options(0))

    def reset(self, env: Any, start: Start) -> Moment:
        """Begin an episode in an environment."""
        options = None
        if self.options is not None:
            arrays = dict(zip(self._option_names, start.options, strict=True))
            options = {k: leaf if leaf.ndim else leaf.item() for k, leaf in arrays.items()}
        obs, info = env.reset(seed=start.seed, options=options)
        return Moment(obs, info, env)

    def step(self, env: Any, action: np.ndarray) -> Moment:
        """Take one action of a program, which lasts ``repeat`` steps of the environment."""
        own, total = self.to_env(action), 0.0
        for _ in range(self.repeat):
            obs, reward, terminated, truncated, info = env.step(own)
            total += float(reward)
            if terminated or truncated:
                break
        return Moment(obs, info, env, total, bool(terminated), bool(truncated))

    def to_env(self, action: np.ndarray) -> Any:
        """Convert an action of a program to units of the environment."""
        space = self.action_space
        if not action.ndim:
            return int(action) + int(space.start)
        low, high = space.low.ravel().astype(float), space.high.ravel().astype(float)
        scaled = low + (np.clip(action, -1, 1).astype(float) + 1) / 2 * (high - low)
        return scaled.astype(space.dtype).reshape(space.shape)

    def to_program(self, action: Any) -> np.ndarray:
        """Convert an action of the environment to the form of programs."""
        space = self.action_space
        if type(space).__name__ == "Discrete":
            return np.asarray(int(action) - int(space.start))
        low, high = space.low.ravel().astype(float), space.high.ravel().astype(float)
        return np.clip(2 * (np.ravel(action).astype(float) - low) / (high - low) - 1, -1, 1)

    def read(self, moment: Moment) -> Reading:
        """A moment as arrays. If a number is not finite, the environment counts as failed."""
        obs, goal = self._observed(moment), self._goal(moment, "achieved")
        outcome, reward = self._outcome(moment, goal), np.asarray(self.reward(moment), np.float32)
        finite = all(np.isfinite(part).all() for part in (obs, goal, outcome, reward))
        flags = (self.reached(moment), moment.terminated, moment.truncated, not finite)
        reading = Reading(obs, goal, outcome, reward, np.asarray(flags, np.uint8))
        # Copies, since an environment may later overwrite the arrays that it returned.
        return Reading(*map(np.array if finite else np.nan_to_num, reading))

    def goal_of(self, moment: Moment) -> np.ndarray:
        """The goal of a task, given the moment after its reset."""
        return self._goal(moment, "desired").copy()  # environments may reuse their arrays

    def _goal(self, moment: Moment, which: str) -> np.ndarray:
        function, key = getattr(self, which), f"{which}_goal"
        if function is not None:
            return np.asarray(function(moment), np.float32).ravel()
        if isinstance(moment.obs, Mapping) and key in moment.obs:
            return np.asarray(moment.obs[key], np.float32).ravel()
        raise UsageError(
            f"observations of {self.name} have no {key}; say how to read it with {which}=lambda moment: .."
        )

    def _outcome(self, moment: Moment, achieved: np.ndarray) -> np.ndarray:
        if self.outcome is None:
            return achieved
        return np.asarray(self.outcome(moment), np.float32).ravel()

    def _observed(self, moment: Moment) -> np.ndarray:
        if self.observe is not None:
            return _to_32_bits(np.asarray(self.observe(moment)))
        obs, space = moment.obs, moment.env.observation_space
        if isinstance(obs, Mapping) and "observation" in obs:
            obs, space = obs["observation"], space["observation"]
        return _to_32_bits(np.asarray(self._flat(obs, space)))

    def _flat(self, obs: Any, space: Any) -> Any:
        """An observation as one array: boxes unchanged, discrete ones as one-hots, dicts concatenated."""
        kind = type(space).__name__
        if kind == "Discrete":
            return np.eye(int(space.n), dtype=np.float32)[int(obs) - int(space.start)]
        if kind == "Dict":
            parts = [np.ravel(self._flat(obs[name], space[name])) for name in space.spaces]
            return np.concatenate(parts).astype(np.float32)
        if kind in ("Box", "MultiBinary"):
            return obs
        raise UsageError(
            f"observations of {self.name} hold a {kind}; say what a policy sees with "
            "observe=lambda moment: .."
        )


def _to_32_bits(array: np.ndarray) -> np.ndarray:
    """Convert an array to a dtype of at most 32 bits."""
    if array.dtype.kind == "f":
        return np.asarray(array, np.float32)
    if array.dtype.kind in "iu" and array.dtype != np.uint8:
        return np.asarray(array, np.int32)
    if array.dtype.kind in "bu":
        return array.astype(np.uint8) if array.dtype == bool else array
    raise UsageError(
        f"arrays of dtype {array.dtype} are not supported; convert the array to numbers"
    )
