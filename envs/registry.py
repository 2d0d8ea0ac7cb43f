"""The worlds by name, and the record that describes one. Nothing here imports jax.

A world is found under a name that it was registered with, under the name of an entry point in the group
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

    from envs.base import Demonstrator, Environment, ObsLayout
    from envs.drawing import Pictures
    from envs.official import Official
    from envs.page import Page


@dataclass(frozen=True)
class Judgement:
    """How the policies of a world are judged: in episodes outside of the budget of a search.

    Attributes:
      mode: ``greedy`` acts by the likeliest action, ``sample`` by a random one.
      temperature: of the distribution that ``sample`` draws from; 1 leaves it as it is.
      episodes: number of episodes whose returns are averaged.
    """

    mode: Literal["greedy", "sample"] = "greedy"
    temperature: float = 1.0
    episodes: int = 1

    @property
    def tempered(self) -> bool:
        """Whether actions are drawn from another distribution than the policy's own."""
        return self.mode == "sample" and self.temperature != 1

    def __post_init__(self) -> None:
        if not (0 < self.temperature < math.inf and self.episodes >= 1):
            raise UsageError(
                "policies are judged at a temperature above 0 in at least one episode, found temperature "
                f"{self.temperature} and {self.episodes} episodes"
            )


@dataclass(frozen=True, kw_only=True)
class StepCost:
    """How episodes are paid where the task is to arrive somewhere in as few steps as possible.

    The return of a single episode then says whether it arrived, and after how many steps.

    Attributes:
      step: what each step costs.
      arrival: what arriving pays; it ends the episode.
      horizon: the most steps of an episode.
    """

    step: float
    arrival: float
    horizon: int

    def num_steps(self, returns: np.ndarray) -> np.ndarray:
        """Steps of single episodes with these returns until they arrived; infinity where they did not."""
        import numpy as np

        steps = np.rint((self.arrival - np.asarray(returns, np.float64)) / self.step)
        return np.where(steps <= self.horizon, steps, np.inf)


def _no_demonstrators(env: Environment) -> Mapping[str, Demonstrator]:
    return {}


@dataclass(frozen=True, kw_only=True)
class World:
    """Everything that generic code needs to know of a world.

    Attributes:
      name: what ``--env`` calls it.
      make: builds the environment.
      summary: what it is, in one line.
      demonstrators: the agents that can collect a dataset, by name; the first is the default. A world
        without any needs a dataset from elsewhere.
      presets: what the world's training settings change in the general ones, by preset (``fast``,
        ``paper``, ``smoke``): names and values of settings of ``experiments.pretrain``. ``ablation`` has
        the steps and trajectories of the trainings of ``experiments.reproduce``.
      pictures: what the world draws; None draws learning curves only.
      page: what the world brings to HTML pages; None shows what needs nothing of it.
      policy_of: the world whose released policy and test tasks this one uses [its own].
      judged: how policies are judged here; every table follows it.
      method_defaults: what the world changes in the default hyper-parameters of methods, by the name of the
        method, such as the unit of returns in which a bandit counts.
      step_cost: how episodes are paid where the task is to arrive in as few steps as possible; tables then
        have a success rate and SPL [None: it is another task].
      extra: the extra of this package that it needs [none].
      num_test_tasks: how many tasks are kept for test.
      official: the program by others that this world re-implements, to compare it with [none].
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
    """How a network turns an observation into a token.

    Attributes:
      name: what ``--encoder`` calls it.
      make: ``(shape of an observation, width of a token, layout of an observation) -> module``. The module
        (Flax) maps observations ``[*batch, ...]`` to tokens ``[*batch, E]``. The layout is None unless
        ``uses_layout``.
      uses_layout: whether it asks for the layout of observations (``EnvSpec.layout``). What is coded is no
        amount: such observations are not standardized and get no noise.
      fault: ``(layout, shape) -> text``, what is wrong with observations of this layout and shape, as the
        end of a sentence about the layout; None if nothing is.
    """

    name: str
    make: Callable[[tuple[int, ...], int, ObsLayout | None], Any]
    uses_layout: bool = False
    fault: Callable[[ObsLayout, tuple[int, ...]], str | None] = lambda layout, shape: None


Record = TypeVar("Record")


class Registry(Generic[Record]):
    """Records by name: those registered, those of an entry-point group, and ``module:attribute``."""

    def __init__(self, kind: str, type_: type[Record], group: str, built_in: Mapping[str, str]):
        self.kind, self.type, self.group = kind, type_, group
        self._places = dict(built_in)
        self._registered: dict[str, Record] = {}
        self._loaded: dict[str, Record] = {}  # by place

    def register(self, record: Record) -> Record:
        """Make a record known under its name; returns it.

        Raises:
          UsageError: if another record has that name.
        """
        name: str = record.name  # type: ignore[attr-defined]
        if self._registered.get(name, record) != record or name in self._places:
            raise UsageError(f"there is a {self.kind} {name!r} already; choose another name")
        self._registered[name] = record
        return record

    def names(self) -> list[str]:
        """All names, the built-in ones first; nothing is imported for it."""
        found = [point.name for point in entry_points(group=self.group)]
        return list(dict.fromkeys([*self._places, *self._registered, *found]))

    def usable(self) -> list[Record]:
        """All records that can be imported, the built-in ones first."""
        found = []
        for name in self.names():
            with suppress(UsageError):
                found.append(self.find(name))
        return found

    def find(self, name: str) -> Record:
        """The record of that name.

        Raises:
          UsageError: if there is none, with the nearest name, or if it cannot be imported.
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
            self._loaded[place] = self._load(place)
        return self._loaded[place]

    def known(self, name: str, where: object, flag: str = "") -> Record:
        """The record of a name that was read from a file, which is data: no module is imported for it.

        Args:
          name: a registered name, that of an entry point, or that or the place of a record in use already.
          where: the file, for messages.
          flag: the flag with which a user can name the record, for messages (default: there is none).

        Raises:
          DataError: if no such record is known.
        """
        if name in self._loaded:
            return self._loaded[name]
        for record in self._loaded.values():
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
        module, _, attribute = place.partition(":")
        here = os.getcwd()
        if here not in sys.path:
            sys.path.append(here)  # last, so that the current folder never shadows a package
        try:
            record = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError, ValueError) as error:
            raise UsageError(
                f"cannot load the {self.kind} {shown(place)}: {printable(str(error))}; give it as "
                "module:attribute of a module that can be imported"
            ) from None
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
            # Files are kept under names: another record of that name would use what is not its own.
            raise UsageError(
                f"{place} has the name of the {self.kind} {name!r}; give it another one"
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
"""The encoders that worlds bring, by name: the places of their records."""


def register(world: World) -> World:
    """Make a world known under its name; returns it."""
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
      UsageError: if there is no such world, or what it needs is not installed.
    """
    try:
        return find(name).make()
    except ImportError as error:
        raise UsageError(str(error)) from None
