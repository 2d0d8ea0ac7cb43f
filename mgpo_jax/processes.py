"""The processes that run one command together, and host-side communication between them.

Process 0 has a socket connection to each of the others. Messages that are small or have no fixed size go
through it: facts that must agree, finished pieces of work, requests to stop, and failures. The operating
system closes the connections of a process however it ends, so the others notice at once, which a collective
on devices does not guarantee. Gradients and lanes are exchanged by ``mgpo_jax.sharding``.

jax has no way of its own that could replace these connections (measured with jax 0.10.2; docs/scale.md has
the details). ``multihost_utils`` runs collectives over all devices, which may deadlock between CPU devices
of one process. The key-value store of ``jax.distributed`` takes 0.66 ms for a small value but 15 s for 128
MiB, and ends with process 0. When a process is gone, jax aborts the others with a stack
trace and exit code 134, and the callback by which Python could handle that crashes.

A command without ``--distributed`` is a single process, and then all functions here return without any
communication. Nothing here imports jax.
"""

from __future__ import annotations

import io
import json
import os
import queue
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple, TypeVar

import numpy as np

from envs.errors import DataError, shown

Value = TypeVar("Value")

SAME = "start all processes with the same settings, programs and data"

_HEAD = struct.Struct(">cIQ")  # kind of message, index of the sender, number of bytes that follow
_PIECE, _DONE, _SIGNAL, _FAILED, _GONE = b"p", b"d", b"s", b"f", b"g"
SIGNAL, FAILED, GONE = "signal", "failed", "gone"
_EVENTS = {_SIGNAL: SIGNAL, _FAILED: FAILED, _GONE: GONE}


class DisagreementError(DataError):
    """Processes that must do the same were started differently. All of them raise it; process 0 reports
    it."""


class Member(NamedTuple):
    """One of the processes that run a command together."""

    number: int
    host: str
    pid: int

    def __str__(self) -> str:
        return f"process {self.number} on {self.host}"


class Team:
    """The connections of this process to the other processes of a command.

    Args:
      members: all processes, in order.
      index: the index of this process.
      links: connections by the index of the process at the other end: from process 0 to all others, from
        the others to process 0.
      heard: ``(event, member, text)``, a callback that runs in another thread when a process is asked to
        stop by a signal (``SIGNAL``; the text is the signal's number), fails (``FAILED``; the text is the
        reason) or is gone (``GONE``).
    """

    def __init__(
        self,
        members: Sequence[Member],
        index: int,
        links: Mapping[int, socket.socket],
        heard: Callable[[str, Member, str], None],
    ) -> None:
        self.members, self.index = members, index
        self._links, self._heard = dict(links), heard
        self._pieces: dict[int, queue.SimpleQueue[bytes]] = {
            number: queue.SimpleQueue() for number in links
        }
        self._locks = {number: threading.Lock() for number in links}
        self._done: set[int] = set()  # processes that have said goodbye
        self._leaving = False
        self._readers = [
            threading.Thread(target=self._read, args=(number,), daemon=True) for number in links
        ]
        for reader in self._readers:
            reader.start()

    def combine(self, piece: bytes, make: Callable[[list[bytes]], bytes]) -> bytes:
        """Apply ``make`` in process 0 to the pieces of all processes, in order, and broadcast the result.

        Every process must call this.
        """
        if self.index:
            self._send(0, _PIECE, piece)
            return self._pieces[0].get()
        made = make([piece, *(self._pieces[number].get() for number in sorted(self._links))])
        for number in self._links:
            self._send(number, _PIECE, made)
        return made

    def tell(self, event: str, text: str) -> None:
        """Tell all other processes about a signal to this process, or about its failure."""
        kind = next(kind for kind, name in _EVENTS.items() if name == event)
        for number in self._links:
            self._send(number, kind, text.encode())

    def leave(self, wait: bool) -> None:
        """Close all connections; with ``wait``, after all processes have called this."""
        if wait and self.index:
            self._send(0, _DONE, b"")
            self._pieces[0].get()
        elif wait:
            for number in self._links:
                self._pieces[number].get()
            for number in self._links:
                self._send(number, _DONE, b"")
        self._leaving = True
        for link in self._links.values():
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()

    def outlast(self, seconds: float) -> None:
        """Wait for the others to end, for at most ``seconds``.

        If process 0 ends before another process without shutting down properly, jax aborts that process
        with pages of text. A thread that receives from a process may call this, and does not wait for that
        one, whose connection has told it to end.
        """
        end = time.monotonic() + seconds
        for reader in self._readers:
            if reader is not threading.current_thread():
                reader.join(max(end - time.monotonic(), 0))

    def _send(self, number: int, kind: bytes, text: bytes, source: int | None = None) -> None:
        source = self.index if source is None else source
        # The thread that reads from a broken connection notices and handles it.
        with suppress(OSError), self._locks[number]:
            self._links[number].sendall(_HEAD.pack(kind, source, len(text)) + text)

    def _read(self, number: int) -> None:
        """Receive from one process until its connection ends."""
        with suppress(OSError):
            while head := received(self._links[number], _HEAD.size):
                kind, source, size = _HEAD.unpack(head)
                text = received(self._links[number], size)
                if kind == _DONE:
                    self._done.add(number)
                if kind in (_PIECE, _DONE):
                    self._pieces[number].put(text)
                else:
                    self._forward(kind, source, text)
        if not self._leaving and number not in self._done:
            self._forward(_GONE, number, b"")

    def _forward(self, kind: bytes, source: int, text: bytes) -> None:
        if not self.index:
            for number in self._links:
                if number != source:
                    self._send(number, kind, text, source)
        self._heard(_EVENTS[kind], self.members[source], text.decode(errors="replace"))


def received(link: socket.socket, size: int) -> bytes:
    """Receive ``size`` bytes; returns none if the connection ends first."""
    pieces = bytearray()
    while len(pieces) < size:
        piece = link.recv(min(size - len(pieces), 1 << 20))
        if not piece:
            return b""
        pieces += piece
    return bytes(pieces)


def _packed(pieces: Sequence[bytes]) -> bytes:
    return b"".join(struct.pack(">Q", len(piece)) + piece for piece in pieces)


def _unpacked(text: bytes) -> Iterator[bytes]:
    place = 0
    while place < len(text):
        (size,) = struct.unpack_from(">Q", text, place)
        yield text[place + 8 : place + 8 + size]
        place += 8 + size


class _Present:
    """The team of processes at present (global state of this process)."""

    team: Team | None = None
    apart = False


_present = _Present()


def join(team: Team | None) -> None:
    """Work as one of several processes from now on, or (with None) as the only one."""
    _present.team = team


def team() -> Team | None:
    """The processes of this command; None if it is the only one."""
    return _present.team


def _together() -> Team | None:
    return None if _present.apart else _present.team


@contextmanager
def apart() -> Iterator[None]:
    """Within the block, work as if this process were the only one, on its own devices."""
    before, _present.apart = _present.apart, True
    try:
        yield
    finally:
        _present.apart = before


def count() -> int:
    """The number of processes that work together."""
    return len(now.members) if (now := _together()) else 1


def index() -> int:
    """The index of this process, from 0."""
    return now.index if (now := _together()) else 0


def is_first() -> bool:
    """Whether this is process 0, the one that prints, draws and writes files."""
    return index() == 0


def exchange(piece: bytes) -> list[bytes]:
    """All-gather: the pieces of all processes, in order. Every process must call this."""
    return list(_unpacked(combined(piece, _packed)))


def combined(piece: bytes, make: Callable[[list[bytes]], bytes]) -> bytes:
    """Apply ``make`` in process 0 to the pieces of all processes, in order, and broadcast the result.

    Every process must call this. Only process 0 calls ``make``, which may use data that only process 0 has.
    """
    return now.combine(piece, make) if (now := _together()) else make([piece])


def total(number: float) -> float:
    """The sum of a number over the processes."""
    return sum(json.loads(text) for text in exchange(json.dumps(number).encode()))


def from_first(find: Callable[[], Value]) -> Value:
    """Broadcast: the JSON value that ``find`` returns in process 0, in every process."""
    if count() == 1:
        return find()
    return json.loads(exchange(json.dumps(find()).encode() if is_first() else b"")[0])


def arrays_from_first(
    find: Callable[[], Mapping[str, np.ndarray] | None],
) -> dict[str, np.ndarray] | None:
    """Broadcast: the arrays that ``find`` returns in process 0, in every process; None if it returns
    None."""
    if count() == 1:
        found = find()
        return None if found is None else dict(found)
    piece = b""
    if is_first() and (found := find()) is not None:
        piece = to_bytes(found)
    told = exchange(piece)[0]
    return from_bytes(told) if told else None


def to_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Serialize named arrays."""
    file = io.BytesIO()
    named: Any = arrays
    np.savez(file, allow_pickle=False, **named)
    return file.getvalue()


def from_bytes(text: bytes) -> dict[str, np.ndarray]:
    """Deserialize the output of ``to_bytes``."""
    with np.load(io.BytesIO(text), allow_pickle=False) as file:
        return dict(file)


def check_agreed(facts: Mapping[str, Any], mend: str = SAME) -> None:
    """Check that all processes have the same facts.

    Args:
      facts: JSON values by a description of each.
      mend: what to do if they differ, for the message.

    Raises:
      DisagreementError: in all processes, if one differs from process 0; it names both and what differs.
    """
    if (team := _together()) is None:
        return
    found = [json.loads(text) for text in exchange(json.dumps(dict(facts)).encode())]
    for member, own in zip(team.members, found, strict=True):
        if differing := [name for name in found[0] if own.get(name) != found[0][name]]:
            said = "; ".join(
                f"{name} {shown(own.get(name))}, not {shown(found[0][name])}" for name in differing
            )
            raise DisagreementError(f"{member} has {said} as {team.members[0]} has; {mend}")


def own_name() -> tuple[str, int]:
    """The host name and process id of this process, by which the others name it."""
    return socket.gethostname(), os.getpid()
