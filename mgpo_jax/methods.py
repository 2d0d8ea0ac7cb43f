"""The registry of adaptation methods and their hyper-parameters. Nothing here imports jax.

A method is found by the name it was registered under, by the name of an entry point in the group
``mgpo_jax.methods``, or as ``module:attribute``.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Le

from envs.errors import DataError, UsageError
from envs.registry import Judgement, Registry, World, imported
from mgpo_jax.kinds import MULTI_GOAL, kind_of
from mgpo_jax.settings import (
    NotNegative,
    NumGoals,
    Positive,
    check_settings,
    flag,
    static,
)

if TYPE_CHECKING:
    from envs.base import Environment
    from mgpo_jax.adaptation import Adapter


@dataclass(frozen=True)
class Setting:
    """Everything that a method may know before it sees a task. All of it is static.

    Attributes:
      env: the world.
      network: the config of the network that the method starts from.
      num_episodes: the budget for one task, in episodes.
      judged: how the best choice is judged.
    """

    env: Environment
    network: Any
    num_episodes: int
    judged: Judgement


@dataclass(frozen=True)
class NoHyper:
    """The empty hyper-parameters of methods that have none."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """Everything that generic code needs to know about a method.

    Attributes:
      name: its name, as given to ``--method``.
      make: ``(setting, params, hyper) -> Adapter``, or the place of this function as ``module:attribute``.
        It is called under tracing: the parameters ``params`` and the numbers in ``hyper`` are traced, so
        another policy of the same sizes, or a sweep over a hyper-parameter, needs no recompilation.
      hyper: the frozen dataclass of its hyper-parameters, from which flags, help and checks are made.
      check: ``(setting, hyper) -> None``, or its place; raises ``UsageError`` if the method cannot be used.
      policy: the kind of network that it starts from (``kinds.KINDS``).
      learns: whether its behavior can change from one episode to the next. If not, one episode tells as
        much as a whole budget.
      title: its name in legends [the name].
      summary: a one-line description.
    """

    name: str
    make: str | Callable[[Setting, Any, Any], Adapter]
    hyper: type = NoHyper
    check: str | Callable[[Setting, Any], None] | None = None
    policy: str = MULTI_GOAL
    learns: bool = True
    title: str = ""
    summary: str = ""

    def adapter(self, setting: Setting, params: Any, hyper: Any) -> Adapter:
        """The adapter for one task; see ``make``."""
        return load(self.make)(setting, params, hyper)

    def check_use(self, setting: Setting, hyper: Any) -> None:
        """Raise ``UsageError`` if a hyper-parameter is out of bounds or the method cannot be used here."""
        if not isinstance(hyper, self.hyper):
            raise UsageError(
                f"{self.name} takes hyper-parameters as {self.hyper.__name__}, found "
                f"{type(hyper).__name__}"
            )
        check_settings(hyper)
        check_kind(kind_of(setting.network).name, self)
        if self.check is not None:
            load(self.check)(setting, hyper)

    def hyper_in(self, world: World | None, values: Mapping[str, Any] | None = None) -> Any:
        """The hyper-parameters with the world's own defaults, if it has any, and then ``values`` applied.

        Raises:
          UsageError: if the method has no hyper-parameter of a given name; names the methods that do.
        """
        own = {} if world is None else world.method_defaults.get(self.name, {})
        return self.hyper_from({**own, **(values or {})})

    def hyper_from(self, values: Mapping[str, Any]) -> Any:
        """The default hyper-parameters with ``values`` applied.

        Raises:
          UsageError: if the method has no hyper-parameter of a given name; names the methods that do.
        """
        own = {field.name for field in dataclasses.fields(self.hyper)}
        for name in values:
            if name not in own:
                raise foreign_setting(name, self)
        return self.hyper(**values)


def check_kind(found: str, method: Method) -> None:
    """Raise ``UsageError`` if a method starts from another kind of network than ``found``."""
    if found != method.policy:
        raise UsageError(
            f"{method.name} starts from a network of the kind {method.policy}, this one is of the kind "
            f"{found}; train one with `python -m experiments.pretrain --method {method.policy}`"
        )


def load(place: str | Callable) -> Callable:
    """Import the function at ``module:attribute``; a function is returned unchanged."""
    return imported(place) if isinstance(place, str) else place


def foreign_setting(name: str, method: Method) -> UsageError:
    """The error for a hyper-parameter that the method does not have, with the methods that do."""
    others = [other for other in METHODS.usable() if other.name != method.name]
    having = [
        other.name
        for other in others
        if name in {field.name for field in dataclasses.fields(other.hyper)}
    ]
    hint = f"; it belongs to {', '.join(having)}" if having else ""
    return UsageError(f"{flag(name)} is not a setting of {method.name}{hint}")


def split_hyper(hypers: Sequence[Any]) -> tuple[Any, dict[str, list[int | float]]]:
    """Split the hyper-parameters of several variants into a static record and traced numbers.

    Returns:
      A record with the shared static settings, and the numeric ones by name, a value for each variant.

    Raises:
      UsageError: if the variants differ in a static setting, which determines shapes.
    """
    first = hypers[0]
    numbers: dict[str, list[int | float]] = {}
    for field in dataclasses.fields(first):
        values = [_plain(getattr(hyper, field.name)) for hyper in hypers]
        numeric = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
        if numeric and not field.metadata.get("static"):
            numbers[field.name] = values
        elif any(value != values[0] for value in values):
            raise UsageError(
                f"{field.name} cannot be swept, because it changes the compiled program"
            )
    return with_numbers(first, dict.fromkeys(numbers, 0)), numbers


def _plain(value: Any) -> Any:
    """A numpy scalar as a number of Python; any other value unchanged."""
    return value.item() if isinstance(value, np.generic) else value


def with_numbers(hyper: Any, numbers: Mapping[str, Any]) -> Any:
    """A copy of hyper-parameters with the given numbers, which may be traced arrays."""
    changed = copy.copy(hyper)
    for name, value in numbers.items():
        object.__setattr__(changed, name, value)  # the dataclass is frozen
    return changed


@dataclass(frozen=True)
class PromptHyper:
    """Hyper-parameters of every method that searches prompts. Values in brackets are the paper's."""

    max_goals: NumGoals | None = None
    """K, the number of goals of the longest prompt to try (default: the policy's longest) [5]."""


@dataclass(frozen=True)
class ExploreHyper(PromptHyper):
    """Hyper-parameters of Algorithm 1 without a bandit."""

    keep_rewarded: bool = True
    """Whether new prompts keep the rewarded goals of the best trajectory and shuffle the goals after them,
    in worlds that reward a sequence part by part [False]."""


@dataclass(frozen=True)
class UcbHyper(ExploreHyper):
    """Hyper-parameters of Algorithm 1 with upper confidence bounds (Eq. 3)."""

    c: NotNegative = 1.0
    """Exploration constant [1]."""
    scale: Positive | None = None
    """Unit of returns in which c is measured; 1 is Eq. 3 as printed (default: the span of the world's
    returns)."""


@dataclass(frozen=True)
class BpeHyper(ExploreHyper):
    """Hyper-parameters of Algorithm 1 with Bayesian posterior estimation (Eq. 4)."""

    min_std: Annotated[float, Gt(0), Le(1)] = 0.02
    """Smallest standard deviation of a prompt's returns, as a fraction of the prior's."""


@dataclass(frozen=True)
class GripsHyper(PromptHyper):
    """Hyper-parameters of Algorithm 2."""

    num_edits: Annotated[int, Ge(1), Le(4_096)] = 5
    """Number of edited prompts in an iteration [5]."""


@dataclass(frozen=True)
class BbtHyper(PromptHyper):
    """Hyper-parameters of Algorithm 3."""

    population_size: Annotated[int, Ge(2), Le(4_096)] = static(10)
    """Population size of CMA-ES [10]."""
    latent_dim: Annotated[int, Ge(1), Le(4_096)] = static(5)
    """Dimension of the latent z."""
    std_init: Annotated[float, Gt(0), Le(1_000)] = 0.5
    """Initial step size, in units of goals."""


@dataclass(frozen=True)
class PlanHyper(PromptHyper):
    """Hyper-parameters of planning in a model of the task (not in the paper)."""

    rehearse: Annotated[int, Ge(0), Le(100)] = static(3)
    """Largest number of rounds of mutated prompts that a search rehearses; 0 disables rehearsals."""
    steer: Annotated[int, Ge(0), Le(1_000)] = static(20)
    """Largest number of gradient steps that move a prompt's goals towards the planned path; 0 disables
    them."""
    splice: bool = True
    """Whether to plan on a map of all episodes, rather than of the best one alone."""
    frontier: bool = True
    """Whether to explore also towards frontiers, states from which the task goal may be near."""
    num_states: Annotated[int, Ge(1), Le(100_000)] = static(512)
    """Capacity of the map of the task, in states."""


_HERE = "mgpo_jax.optimizers.methods"
METHODS: Registry[Method] = Registry(
    "method",
    Method,
    "mgpo_jax.methods",
    {
        **{
            name: f"mgpo_jax.methods:{name.upper()}"
            for name in ("ucb", "bpe", "plan", "explore", "grips", "bbt", "gcbc")
        },
        **{
            name: f"mgpo_jax.baselines.methods:{name.upper().replace('-', '_')}"
            for name in (
                "reinforce", "reinforce-careful", "ppo", "ppo-careful",
                "ptgm", "ptgm-goal", "ptgm-ppo", "ptgm-random", "ptgm-prior", "ptgm-oracle",
                "spirl", "spirl-prior",
            )
        },
    },
)  # fmt: skip

UCB = Method(
    name="ucb",
    title="MGPO-UCB",
    summary="Algorithm 1; acts with the prompt of the highest upper confidence bound",
    make=f"{_HERE}:make_ucb",
    check=f"{_HERE}:check_prompts",
    hyper=UcbHyper,
)
BPE = Method(
    name="bpe",
    title="MGPO-BPE",
    summary="Algorithm 1; acts with the prompt most likely to beat the best return",
    make=f"{_HERE}:make_bpe",
    check=f"{_HERE}:check_prompts",
    hyper=BpeHyper,
)
PLAN = Method(
    name="plan",
    title="plan",
    summary="builds a model of the task from all that it has seen, plans in it, and rehearses prompts "
    "there before acting",
    make="mgpo_jax.planning.methods:make_plan",
    check=f"{_HERE}:check_prompts",
    hyper=PlanHyper,
)
EXPLORE = Method(
    name="explore",
    title="MGPO-explore",
    summary="Algorithm 1 without a bandit; acts with the newest prompt",
    make=f"{_HERE}:make_explore",
    check=f"{_HERE}:check_prompts",
    hyper=ExploreHyper,
)
GRIPS = Method(
    name="grips",
    title="GRIPS",
    summary="Algorithm 2; adds, deletes and swaps goals of the prompt",
    make=f"{_HERE}:make_grips",
    check=f"{_HERE}:check_grips",
    hyper=GripsHyper,
)
BBT = Method(
    name="bbt",
    title="BBT",
    summary="Algorithm 3; moves the goals of the prompt by CMA-ES",
    make=f"{_HERE}:make_bbt",
    check=f"{_HERE}:check_prompts",
    hyper=BbtHyper,
)
GCBC = Method(
    name="gcbc",
    title="GC-BC",
    summary="goal-conditioned behavior cloning; the prompt is always the task goal (g^M) alone",
    make=f"{_HERE}:make_gcbc",
    learns=False,
)


def policy_kind(name: str) -> str:
    """The kind of network that a method starts from; for an unknown name, the multi-goal policy."""
    try:
        return METHODS.known(name, "the results").policy
    except DataError:
        return MULTI_GOAL


def register(method: Method) -> Method:
    """Register a method under its name; returns the method."""
    return METHODS.register(method)


def names() -> list[str]:
    """The names of all methods."""
    return METHODS.names()


def find(name: str) -> Method:
    """The record of a method, by its name or as ``module:attribute``.

    Raises:
      UsageError: if there is no such method; suggests the nearest name.
    """
    return METHODS.find(name)
