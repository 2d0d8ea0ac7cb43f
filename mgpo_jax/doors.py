"""How the processes of a command connect to process 0, before they become a ``processes.Team``.

Process 0 opens a port, which the others learn with the first collective, together with a password. The port
closes when all of them have connected.
"""

from __future__ import annotations

import secrets
import socket
import struct
import time
from collections.abc import Sequence
from contextlib import suppress

from envs.errors import DataError
from mgpo_jax.processes import Member, received

MEETING = 60.0  # seconds in which all processes must have connected
GREETING = 5.0  # seconds in which a process that has connected must say the password
# TCP keepalive: after ``SILENT`` seconds without traffic, ``PROBES`` probes are sent, ``BETWEEN`` seconds
# apart; a host that answers none of them counts as gone.
SILENT, PROBES, BETWEEN = 10, 3, 5
NETWORK = "check that the network and firewalls allow the connection"


class Door:
    """The listening socket on which process 0 waits for the others, who must know the password.

    Args:
      only_here: whether all processes run on this host, so that no other host may connect.
    """

    def __init__(self, only_here: bool) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0)) if only_here else _open_to_all()
        self.password = secrets.token_bytes(16)
        self.port = self._listening.getsockname()[1]

    def let_in(self, members: Sequence[Member]) -> dict[int, socket.socket]:
        """Accept the connections of all other processes, and then close the socket.

        Returns:
          The connections by the index of the process.

        Raises:
          DataError: if a process does not connect in time.
        """
        links: dict[int, socket.socket] = {}
        end = time.monotonic() + MEETING
        with self._listening:
            while len(links) < len(members) - 1:
                self._listening.settimeout(max(end - time.monotonic(), 0.01))
                try:
                    link, _ = self._listening.accept()
                except OSError:
                    missing = next(one for one in members[1:] if one.number not in links)
                    raise DataError(
                        f"{missing} has not connected to process 0 on {members[0].host} within "
                        f"{MEETING:.0f} s; {NETWORK}"
                    ) from None
                if (number := self._greeted(link)) is None:
                    link.close()
                else:
                    links[number] = _with_keepalive(link)
        return links

    def _greeted(self, link: socket.socket) -> int | None:
        """The index of the process at the other end; None for a stranger, who may say nothing at all."""
        said = b""
        with suppress(OSError):
            link.settimeout(GREETING)
            said = received(link, len(self.password) + 4)
        known = secrets.compare_digest(said[:-4], self.password)
        return struct.unpack(">I", said[-4:])[0] if known else None


def _open_to_all() -> socket.socket:
    """A listening socket on all addresses of this host, those of IPv6 too where the system has them."""
    if socket.has_dualstack_ipv6():
        with suppress(OSError):
            return socket.create_server(("", 0), family=socket.AF_INET6, dualstack_ipv6=True)
    return socket.create_server(("", 0))


def connected(places: Sequence[str], port: int, password: bytes, index: int) -> socket.socket:
    """Connect to process 0 at the first of several host names that answers.

    Raises:
      DataError: if none answers.
    """
    fault = ""
    share = MEETING / (len(places) + 1)  # so that the last place is tried while the door is open
    for place in places:
        try:
            link = socket.create_connection((place, port), timeout=share)
        except OSError as error:
            fault = f"{place}:{port}: {error}"
            continue
        try:
            link.sendall(password + struct.pack(">I", index))
            return _with_keepalive(link)
        except OSError as error:
            link.close()
            fault = f"{place}:{port}: {error}"
    raise DataError(f"process 0 cannot be reached at {fault}; {NETWORK}")


def _with_keepalive(link: socket.socket) -> socket.socket:
    """Enable keepalive on a connection, so that it ends soon after the host at its other end is gone."""
    link.settimeout(None)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    milliseconds = 1000 * (SILENT + PROBES * BETWEEN)
    for name, value in (
        ("TCP_KEEPIDLE", SILENT),
        ("TCP_KEEPINTVL", BETWEEN),
        ("TCP_KEEPCNT", PROBES),
        ("TCP_USER_TIMEOUT", milliseconds),
    ):
        if hasattr(socket, name):  # otherwise the system's default applies
            link.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
    return link
