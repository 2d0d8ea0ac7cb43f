"""A pool of live gymnasium environments on the host, looked up by the history of their episodes.

Nothing here imports jax. A program requests a step of an episode by the episode's *identity*: a hash of how
it began, of the actions since, and of their results. If a live environment is in exactly that place, it is
stepped. If there is none, because the program repeats an episode or takes another branch of it, a fresh
environment is reset in the same way and the actions are replayed. If that leads elsewhere, the environment
is not reproducible, and is rejected.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from envs.errors import DataError, UsageError


class Moment(NamedTuple):
    """The output of a gymnasium environment after a reset or a step, for the functions that read it."""

    obs: Any
    info: Mapping[str, Any]
    env: Any
    """The environment itself, for what its observations leave out."""
    reward: float = 0.0
    """Sum of the rewards of the repeated steps; 0 after a reset."""
    terminated: bool = False
    truncated: bool = False


class Reading(NamedTuple):
    """A moment as arrays, with the order and the dtypes that programs use."""

    obs: np.ndarray
    achieved_goal: np.ndarray
    outcome: np.ndarray
    reward: np.ndarray
    flags: np.ndarray
    """``goal_reached``, ``terminated``, ``truncated`` and ``failed``, uint8 ``[4]``."""

    @property
    def over(self) -> bool:
        return bool(self.flags[1:].any())


class Start(NamedTuple):
    """The start of an episode: everything that its reset depends on."""

    seed: int
    options: tuple[np.ndarray, ...]
    """The leaves of the options, in order."""


Act = Callable[[Moment], Any]
"""The next action of a script in units of the environment, or None to end the episode."""


@dataclass
class Live:
    """One live environment and its place in an episode."""

    env: Any
    identity: bytes = b""
    steps: int = 0
    moment: Any = None
    script: tuple[str, int] | None = None
    """Name and seed of the script that follows this episode."""
    act: Act | None = None
    asked: tuple[bytes, Any] | None = None
    """The identity at which the script was last asked for an action, and that action."""


@dataclass(eq=False)
class Pool:
    """A pool of live environments of one kind. It is thread-safe.

    Attributes:
      make: creates an environment, or several in a ``SyncVectorEnv``.
      reset: ``(env, start) -> moment``.
      step: ``(env, action) -> moment``, with an action in the form of programs.
      read: ``(moment) -> reading``.
      scripts: ``(env, generator) -> act``, by name.
      most: number of environments that are kept alive; the least recently used one is evicted.
      num_threads: number of threads that step them.
      spare: environments that were made before and may be used.
    """

    make: Callable[[], Any]
    reset: Callable[[Any, Start], Moment]
    step: Callable[[Any, np.ndarray], Moment]
    read: Callable[[Moment], Reading]
    scripts: Mapping[str, Callable[[Any, np.random.Generator], Act]] = field(default_factory=dict)
    most: int = 256
    num_threads: int = 1
    spare: Sequence[Any] = ()

    def __post_init__(self) -> None:
        self._lock = Lock()
        self._live: OrderedDict[bytes, Live] = OrderedDict()
        self._idle: list[Any] = [*self.spare]
        # Vector environments close their parts when they are no longer referenced.
        self._made: list[Any] = []
        self._memory: OrderedDict[bytes, tuple[bytes, Reading]] = OrderedDict()
        self._threads = ThreadPoolExecutor(self.num_threads) if self.num_threads > 1 else None
        self.num_made, self.num_replayed = len(self._idle), 0

    def begin(
        self, start: Start, look: Callable[[Moment], Any] = lambda moment: None
    ) -> tuple[bytes, Any, Reading]:
        """Begin an episode.

        Args:
          start: how it begins.
          look: is called with its first moment, while no other thread can use the environment.

        Returns:
          Its identity, what ``look`` returned, and the reading of its first moment.
        """
        live, reading = self._fresh(start)
        try:
            found = live.identity, look(live.moment), reading
        except BaseException:
            self._release(live.env)
            raise
        self._put(live)
        return found

    def advance(
        self, start: Start, identity: bytes, actions: np.ndarray, action: np.ndarray
    ) -> tuple[bytes, Reading]:
        """Take one more action in an episode; returns its new identity and the reading.

        Args:
          start: how the episode began.
          identity: its identity so far.
          actions: the actions taken so far, ``[t, ..]``.
          action: the next action.

        Raises:
          DataError: if the environment is not reproducible.
        """
        wanted = identity + action.tobytes()
        live = self._take(identity)
        if live is None:
            with self._lock:
                known = self._memory.get(wanted)
            if known is not None:
                return known
            live = self._replay(start, identity, actions)
        reading = self._step(live, action)
        found = live.identity, reading
        with self._lock:
            self._memory[wanted] = found
            while len(self._memory) > 2 * self.most:
                self._memory.popitem(last=False)
        if reading.over:
            self._release(live.env)
        else:
            self._put(live)
        return found

    def ask(self, start: Start, identity: bytes, actions: np.ndarray, name: str, seed: int) -> Any:
        """The next action of a script in an episode, in units of the environment; None ends the episode."""
        script = (name, seed)
        live = self._take(identity)
        follows = live is not None and (live.script == script or live.steps == 0)
        if live is None or not follows:
            if live is not None:
                self._put(live)
            live = self._replay(start, identity, actions, script)
        if live.script != script:
            self._attach(live, script)
        if live.asked is None or live.asked[0] != identity:
            assert live.act is not None
            live.asked = (identity, live.act(live.moment))
        action = live.asked[1]
        self._put(live)
        return action

    def map(self, function: Callable[[int], Any], num: int) -> list[Any]:
        """Compute ``function(0)``, .., ``function(num - 1)`` on the threads of the pool."""
        if self._threads is None or num < 2:
            return [function(index) for index in range(num)]
        return list(self._threads.map(function, range(num)))

    def _fresh(self, start: Start) -> tuple[Live, Reading]:
        env = self._free_env()
        try:
            moment = self.reset(env, start)
            reading = self.read(moment)
        except BaseException:
            self._release(env)
            raise
        first = [np.int64(start.seed).tobytes(), *(leaf.tobytes() for leaf in start.options)]
        return Live(env, _hash(b"".join(first), reading), moment=moment), reading

    def _step(self, live: Live, action: np.ndarray) -> Reading:
        live.moment = self.step(live.env, action)
        reading = self.read(live.moment)
        live.identity = _hash(live.identity + action.tobytes(), reading)
        live.steps += 1
        return reading

    def _attach(self, live: Live, script: tuple[str, int]) -> None:
        live.script, live.asked = script, None
        live.act = self.scripts[script[0]](live.env, np.random.default_rng(script[1]))

    def _replay(
        self,
        start: Start,
        identity: bytes,
        actions: np.ndarray,
        script: tuple[str, int] | None = None,
    ) -> Live:
        """A live environment in the place of an episode, reached by replaying the episode's actions."""
        self.num_replayed += 1
        live, _ = self._fresh(start)
        if script is not None:
            self._attach(live, script)
        for action in actions:
            if live.act is not None:
                live.asked = (live.identity, live.act(live.moment))
            self._step(live, np.asarray(action))
        if live.identity != identity:
            self._release(live.env)
            raise DataError(
                "the gymnasium environment is not reproducible: after reset with seed "
                f"{start.seed} and the same {len(actions)} actions, its outputs differ from the first "
                "time; all its randomness must come from the seed given to reset, and reset must clear "
                "everything left from earlier episodes"
            )
        return live

    def _take(self, identity: bytes) -> Live | None:
        with self._lock:
            return self._live.pop(identity, None)

    def _put(self, live: Live) -> None:
        with self._lock:
            other = self._live.pop(live.identity, None)  # one in the same place
            self._live[live.identity] = live
            if other is not None:
                self._idle.append(other.env)

    def _release(self, env: Any) -> None:
        with self._lock:
            self._idle.append(env)

    def _free_env(self) -> Any:
        """An idle environment, a new one, or the least recently used one."""
        with self._lock:
            if self._idle:
                return self._idle.pop()
            if self.num_made >= self.most and self._live:
                return self._live.popitem(last=False)[1].env
            self.num_made += 1
        made = self.make()
        first, *others = single_envs(made)
        with self._lock:
            self._made.append(made)
            self._idle += others
            self.num_made += len(others)
        return first


def single_envs(made: Any) -> list[Any]:
    """The single environments that were made: those of a ``SyncVectorEnv``, or the one that is given.

    Single environments are reset and stepped one by one, each with a seed of its own and never beyond the
    end of an episode, so that the automatic resets of a vector environment do not happen.

    Raises:
      UsageError: if it is another vector environment, whose parts cannot be reset one by one.
    """
    vector = sys.modules.get("gymnasium.vector")  # loaded if there is any vector environment
    if vector is None or not isinstance(made, vector.VectorEnv):
        return [made]
    if isinstance(made, vector.SyncVectorEnv):
        return list(made.envs)
    identity = getattr(getattr(made, "spec", None), "id", "ID")
    made.close()
    raise UsageError(
        f"make returns {type(made).__name__}, a vector environment whose parts cannot be reset one by one; "
        f'return a single environment, such as gymnasium.make("{identity}"), or a '
        "gymnasium.vector.SyncVectorEnv without wrappers around it"
    )


def num_cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _hash(before: bytes, reading: Reading) -> bytes:
    """An 8-byte hash of the history of an episode; two different ones agree with a probability of 2^-64."""
    digest = hashlib.blake2b(before, digest_size=8)
    for part in reading:
        digest.update(part.tobytes())
    return digest.digest()
