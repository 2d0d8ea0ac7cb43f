"""The registry of worlds, and the record that describes a world. Nothing here imports jax.

A world is found by the name it was registered under, by the name of an entry point in the group
``mgpo_jax.worlds``, or as ``module:attribute``.
"""

from __future__ import annotations

import importlib
import math
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from envs.errors import DataError, UsageError, nearest, printable, shown

if TYPE_CHECKING:
    import numpy as np

    from envs.agents import Demonstrator
    from envs.base import Environment
    from envs.drawing import Pictures
    from envs.official import Official
    from envs.page import Page
    from envs.specs import ObsLayout


@dataclass(frozen=True)
class Judgement:
    """How the policies of a world are judged, in episodes that do not count against the budget of a search.

    Attributes:
      mode: ``greedy`` takes the most likely action, ``sample`` a random one.
      temperature: temperature of the distribution for ``sample``; 1 is the policy's own.
      episodes: number of episodes whose returns are averaged.
    """

    mode: Literal["greedy", "sample"] = "greedy"
    temperature: float = 1.0
    episodes: int = 1

    @property
    def tempered(self) -> bool:
        """Whether actions are sampled from a tempered distribution instead of the policy's own."""
        return self.mode == "sample" and self.temperature != 1

    def __post_init__(self) -> None:
        if self.mode not in ("greedy", "sample"):
            raise UsageError(
                f"the mode of a Judgement must be greedy or sample, found {shown(self.mode)}"
            )
        if not (0 < self.temperature < math.inf and self.episodes >= 1):
            raise UsageError(
                "a Judgement needs a finite temperature above 0 and at least one episode, found "
                f"temperature {self.temperature} and {self.episodes} episodes"
            )


@dataclass(frozen=True, kw_only=True)
class StepCost:
    """The rewards of a world whose task is to arrive somewhere in as few steps as possible.

    They allow to tell from the return of a single episode whether it arrived, and after how many steps.

    Attributes:
      step: the cost of each step.
      arrival: the reward for arriving, which ends the episode.
      horizon: the largest number of steps of an episode.
    """

    step: float
    arrival: float
    horizon: int

    def num_steps(self, returns: np.ndarray) -> np.ndarray:
        """The number of steps until single episodes with these returns arrived; infinity if they did
        not."""
        import numpy as np

        steps = np.rint((self.arrival - np.asarray(returns, np.float64)) / self.step)
        return np.where(steps <= self.horizon, steps, np.inf)


def _no_demonstrators(env: Environment) -> Mapping[str, Demonstrator]:
    return {}


@dataclass(frozen=True, kw_only=True)
class World:
    """Everything that generic code needs to know about a world.

    Attributes:
      name: its name, as given to ``--env``.
      make: builds the environment.
      summary: a one-line description.
      demonstrators: the demonstrators that can collect a dataset, by name; the first is the default. A
        world without any needs a dataset from elsewhere.
      presets: the training settings of this world that differ from the general ones, by preset (``fast``,
        ``paper``, ``smoke``): names and values of settings of ``experiments.pretrain``. The preset
        ``ablation`` has the numbers of steps and trajectories for ``experiments.reproduce``.
      pictures: the pictures that the world can draw; with None only learning curves are drawn.
      page: the world's part of HTML pages; with None pages have only their generic parts.
      policy_of: the world whose released policy and test tasks this one uses [its own].
      judged: how policies are judged in this world, in all tables.
      method_defaults: default hyper-parameters that differ in this world, by the name of the method, such
        as the unit of returns of a bandit.
      step_cost: the rewards of a world whose task is to arrive in as few steps as possible; its tables then
        have a success rate and SPL [None: another kind of task].
      extra: the extra of this package that it needs [none].
      num_test_tasks: number of test tasks.
      official: the official implementation by others, to compare this world with [none].
    """

    name: str
    make: Callable[[], Environment]
    summary: str = ""
    demonstrators: Callable[[Any], Mapping[str, Demonstrator]] = _no_demonstrators
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    pictures: Callable[[Any], Pictures] | None = None
    page: Callable[[Any], Page] | None = None
    policy_of: str | None = None
    judged: Judgement = field(default_factory=Judgement)
    method_defaults: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    step_cost: StepCost | None = None
    extra: str | None = None
    num_test_tasks: int = 50
    official: Callable[[Any], Official] | None = None

    @property
    def home(self) -> str:
        """The name under which its released policy, test tasks, datasets and paper numbers are kept."""
        return self.policy_of or self.name


@dataclass(frozen=True, kw_only=True)
class Encoder:
    """The record of an encoder, which embeds an observation as a token.

    Attributes:
      name: its name, as given to ``--encoder``.
      make: ``(shape of an observation, width of a token, layout of an observation) -> module``. The Flax
        module maps observations ``[*batch, ...]`` to tokens ``[*batch, E]``. The layout is None unless
        ``uses_layout``.
      uses_layout: whether it needs the layout of observations (``EnvSpec.layout``). Since codes are
        categorical, such observations are not standardized and get no noise.
      fault: ``(layout, shape) -> text``, what is wrong with observations of this layout and shape, as the
        end of a sentence about the layout; None if nothing is.
      prepare: ``(parameters of the module) -> parameters`` with which the module makes the same tokens with
        less work, computed once before an agent acts step by step; None if there is nothing to prepare.
    """

    name: str
    make: Callable[[tuple[int, ...], int, ObsLayout | None], Any]
    uses_layout: bool = False
    fault: Callable[[ObsLayout, tuple[int, ...]], str | None] = lambda layout, shape: None
    prepare: Callable[[Any], Any] | None = None


def imported(place: str) -> Any:
    """The object at ``module:attribute``."""
    module, _, attribute = place.partition(":")
    return getattr(importlib.import_module(module), attribute)


def load(place: str, what: str) -> Any:
    """The object at ``module:attribute``, where a user's own module may be in the current folder.

    Args:
      place: the place.
      what: what should be there, for messages.

    Raises:
      UsageError: if there is no such object, or its module raises an error while it is imported.
    """
    here = os.getcwd()
    if here not in sys.path:
        sys.path.append(here)  # last, so that the current folder never shadows a package
    try:
        return imported(place)
    except Exception as error:  # while it is imported, a user's module may raise anything
        is_clear = isinstance(error, ImportError | AttributeError | UsageError | DataError)
        said = str(error) if is_clear else f"{type(error).__name__}: {error}"
        raise UsageError(
            f"cannot load {what} {shown(place)}: {printable(said)}; give it as module:attribute of a "
            "module that can be imported"
        ) from error


Record = TypeVar("Record")


class Registry(Generic[Record]):
    """Records by name: those registered, those of an entry-point group, and ``module:attribute``."""

    def __init__(self, kind: str, type_: type[Record], group: str, built_in: Mapping[str, str]):
        self.kind, self.type, self.group = kind, type_, group
        self._places = dict(built_in)
        self._registered: dict[str, Record] = {}
        self._loaded: dict[str, Record] = {}  # by place

    def register(self, record: Record) -> Record:
        """Register a record under its name; returns the record.

        Raises:
          UsageError: if another record has that name.
        """
        name: str = record.name  # type: ignore[attr-defined]
        if self._registered.get(name, record) != record or name in self._places:
            raise UsageError(f"there is a {self.kind} {name!r} already; choose another name")
        self._registered[name] = record
        return record

    def names(self) -> list[str]:
        """All names, the built-in ones first, without importing anything."""
        found = [point.name for point in entry_points(group=self.group)]
        return list(dict.fromkeys([*self._places, *self._registered, *found]))

    def usable(self) -> list[Record]:
        """All records that can be imported, the built-in ones first."""
        found = []
        for name in self.names():
            with suppress(UsageError):
                found.append(self.find(name))
        return found

    def loaded(self) -> list[Record]:
        """The records that were found by their places so far."""
        return list(self._loaded.values())

    def find(self, name: str) -> Record:
        """The record of a name, which may also be a place ``module:attribute``.

        Raises:
          UsageError: if there is no such record (suggests the nearest name), or it cannot be imported.
        """
        if name in self._registered:
            return self._registered[name]
        place = self._places.get(name)
        if place is None:
            points = {point.name: point.value for point in entry_points(group=self.group)}
            place = points.get(name) or (name if ":" in name else None)
        if place is None:
            raise nearest(name, self.names(), self.kind)
        if place not in self._loaded:
            record = self._load(place)
            own: str = record.name  # type: ignore[attr-defined]
            if ":" not in name and own != name:
                raise UsageError(
                    f"the entry point {shown(name)} in the group {self.group} gives the {self.kind} "
                    f"{shown(own)}; give both the same name"
                )
            self._loaded[place] = record
        return self._loaded[place]

    def known(self, name: str, where: object, flag: str = "") -> Record:
        """The record of a name that was read from a file.

        Since files are untrusted, no module is imported because of it.

        Args:
          name: a registered name, the name of an entry point, or the name or place of a record that is
            loaded already.
          where: the file, for messages.
          flag: the flag with which the user can name the record, for messages (default: there is none).

        Raises:
          DataError: if no such record is known.
        """
        if name in self._loaded:
            return self._loaded[name]
        for record in self.loaded():
            if record.name == name:  # type: ignore[attr-defined]
                return record
        if ":" in name:
            advice = f"; give it with {flag} {printable(name)}" if flag else ""
            raise DataError(
                f"{where} names the {self.kind} {shown(name)}, which is not loaded{advice}"
            )
        try:
            return self.find(name)
        except UsageError as error:
            advice = f"; give its place with {flag} module:attribute" if flag else ""
            raise DataError(f"{where}: {error}{advice}") from None

    def _load(self, place: str) -> Record:
        record = load(place, f"the {self.kind}")
        if not isinstance(record, self.type):
            raise UsageError(
                f"{place} is a {type(record).__name__}; the place of a {self.kind} must be that of a "
                f"{self.type.__name__} record"
            )
        name: str = record.name  # type: ignore[attr-defined]
        taken = self._registered.get(name)
        if taken is None and self._places.get(name, place) != place:
            taken = self.find(name)
        if taken is not None and taken is not record:
            # Files are stored by name, so two records of the same name would share their files.
            raise UsageError(
                f"{place} has the name {name!r}, which another {self.kind} already has; rename it"
            )
        return record


WORLDS: Registry[World] = Registry(
    "world",
    World,
    "mgpo_jax.worlds",
    {
        "maze15": "envs.maze:MAZE15",
        "maze30": "envs.maze:MAZE30",
        "gridworld": "envs.gridworld:GRIDWORLD",
        "kitchen": "envs.kitchen:KITCHEN",
        "kitchen-mjx": "envs.kitchen:KITCHEN_MJX",
        "kitchen-native": "envs.kitchen:KITCHEN_NATIVE",
        "kitchen-stock": "envs.kitchen:KITCHEN_STOCK",
        "crafter": "envs.crafter:CRAFTER",
        "crafter-map": "envs.crafter:CRAFTER_MAP",
        "crafter-symbolic": "envs.crafter:CRAFTER_SYMBOLIC",
    },
)

ENCODER_PLACES = {"crafter-picture": "envs.crafter:PICTURE"}
"""The places of the encoders that worlds define, by name."""


def register(world: World) -> World:
    """Register a world under its name; returns the world."""
    return WORLDS.register(world)


def names() -> list[str]:
    """The names of all worlds."""
    return WORLDS.names()


def find(name: str) -> World:
    """The record of a world, by its name or as ``module:attribute``."""
    return WORLDS.find(name)


def make(name: str) -> Environment:
    """The environment of a world, by its name or as ``module:attribute``.

    Raises:
      UsageError: if there is no such world, or packages that it needs are not installed.
    """
    try:
        return find(name).make()
    except ImportError as error:
        raise UsageError(str(error)) from None
