"""``--distributed``: one command on several processes, hosts and accelerators.

Every process runs the same command line. It joins the others after its flags have been checked and before
anything is computed, by the variables of a scheduler or by ``--coordinator``; never by guess, since
``salloc`` sets SLURM's variables for a single process, too. From then on only process 0 prints, draws and
writes. A request to stop reaches all of them, and so does the news that one has failed or is gone.
"""

from __future__ import annotations

import dataclasses
import os
import struct
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Annotated, Any, NoReturn

from annotated_types import Ge, Le

from envs.errors import DataError, UsageError, printable, shown
from experiments import signals
from experiments.runtime import Common, Silent
from mgpo_jax import processes
from mgpo_jax.claims import clean_up
from mgpo_jax.processes import Member
from mgpo_jax.settings import flag

ARRIVING = 300  # seconds in which all processes must have started
HEARTBEATS = 100  # seconds without news after which jax gives a process up; we know of it earlier
LEAVING = 20  # seconds that jax waits for the others at the end, when they have all come to it
SAME = 2.0  # seconds in which an error that all processes meet arrives in each of them
PLACE = struct.Struct(">64sQQ16s")  # host, process number, port and password
GO_ON = {"resume": "go on with --resume", "": "run the same command again"}


@dataclass(frozen=True)
class Joined(Common):
    """Flags of the commands that several processes can run together."""

    distributed: bool = False
    """Run on several processes (docs/scale.md): as SLURM, Open MPI or a TPU slice has started them, or as
    the three flags below say. All of them have the same command line, but for ``--process``."""
    coordinator: str | None = None
    """HOST:PORT of process 0, where the others find it."""
    processes: Annotated[int, Ge(1), Le(65_536)] | None = None
    """How many processes there are."""
    process: Annotated[int, Ge(0), Le(65_535)] | None = None
    """Which of them this one is, counted from 0."""


OF_PROCESSES = tuple(field.name for field in dataclasses.fields(Joined))[-4:]
"""The settings above, which change no result."""


def check_flags(config: Joined) -> None:
    """Raise ``UsageError`` for flags of several processes that do not go together."""
    given = [name for name in OF_PROCESSES[1:] if getattr(config, name) is not None]
    if given and not config.distributed:
        value = shown(getattr(config, given[0]))
        raise UsageError(f"{flag(given[0])} {value} is for several processes; add --distributed")
    if config.distributed and getattr(config, "dry_run", False):
        raise UsageError("--dry-run computes nothing that could be spread; leave out --distributed")
    if given and len(given) < 3:
        missing = next(name for name in OF_PROCESSES[1:] if name not in given)
        raise UsageError(
            f"{flag(given[0])} needs {flag(missing)} beside it; give --coordinator HOST:PORT, --processes "
            "N and --process I, or none of them where a scheduler has started the processes"
        )
    if config.coordinator is None or config.process is None or config.processes is None:
        return
    host, _, port = config.coordinator.rpartition(":")
    if not (host and port.isdecimal() and 0 < int(port) < 65_536):
        raise UsageError(
            f"--coordinator must be HOST:PORT, such as node0:12345, found {shown(config.coordinator)}"
        )
    if config.process >= config.processes:
        raise UsageError(
            f"--process counts from 0: of {config.processes} processes the last is "
            f"{config.processes - 1}, found {config.process}"
        )


def join(config: Joined) -> None:
    """Become one of several processes, if ``--distributed`` is given; before anything is computed.

    Raises:
      UsageError: if the flags do not go together, or nothing says who the processes are.
      DataError: if the others do not arrive in time, or were started differently.
    """
    check_flags(config)
    if not config.distributed:
        return
    _start(config)
    import jax

    if jax.process_count() > 1:
        team = _met(config)
        processes.join(team)
        signals.tell_others(
            lambda number: team.tell(processes.SIGNAL, str(number)),
            lambda: None if team.index else team.outlast(SAME),
        )
        if team.index:
            sys.stdout = sys.stderr = Silent(sys.stderr)
        processes.check_agreed(_facts(config))
        print(f"{len(team.members)} processes, {_devices_told()}", file=sys.stderr)


def _start(config: Joined) -> None:
    """Start jax's own acquaintance of processes."""
    import jax

    # It would catch SIGTERM; requests to stop are ours to answer (``signals``).
    jax.config.update("jax_enable_preemption_service", False)
    place: dict[str, Any] = {}
    if config.coordinator is not None:
        place = {
            "coordinator_address": config.coordinator,
            "num_processes": config.processes,
            "process_id": config.process,
            "cluster_detection_method": "deactivate",
        }
        if config.coordinator.startswith(("127.", "localhost:")):
            place["coordinator_bind_address"] = config.coordinator
    try:
        jax.distributed.initialize(
            initialization_timeout=ARRIVING,
            heartbeat_timeout_seconds=HEARTBEATS,
            shutdown_timeout_seconds=LEAVING,
            **place,
        )
    except ValueError:
        if place:
            raise
        raise UsageError(
            "--distributed finds no variables of SLURM, Open MPI or a TPU slice that say who the processes "
            "are; give --coordinator HOST:PORT --processes N --process I"
        ) from None
    except RuntimeError as error:
        where = config.coordinator or "the place that the scheduler names"
        reason = str(error).splitlines()[0]
        raise DataError(
            f"not all processes have met at {where} within {ARRIVING} s; start all of them with the same "
            f"--coordinator and --processes, and a --process each ({reason})"
        ) from None


def _met(config: Joined) -> processes.Team:
    """The processes, after a first collective over the devices that later ones use.

    The first one has 30 seconds, and every process must have come to it: so it comes now, before anything
    that may take longer in one of them.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from mgpo_jax.sharding import rows_of_processes

    first = jax.process_index() == 0
    only_here = (config.coordinator or "").startswith(("127.", "localhost:"))
    door = processes.Door(only_here) if first else None
    host, pid = processes.own_name()
    password, port = (door.password, door.port) if door else (b"", 0)
    own = np.frombuffer(PLACE.pack(host.encode()[:64], pid, port, password), np.uint8)
    with _unprinted():
        rows = np.asarray(rows_of_processes(jnp.asarray(own)))
    told = [PLACE.unpack(row.tobytes()) for row in rows]
    members = [
        Member(number, name.rstrip(b"\0").decode(errors="replace"), pid)
        for number, (name, pid, _, _) in enumerate(told)
    ]
    if door is not None:
        links = door.let_in(members)
    else:
        _, _, port, password = told[0]
        named = [config.coordinator.rpartition(":")[0].strip("[]")] if config.coordinator else []
        places = [*named, members[0].host]
        links = {0: processes.connected(places, port, password, jax.process_index())}
    told_to_resume = GO_ON["resume" if hasattr(config, "resume") else ""]
    return processes.Team(
        members,
        jax.process_index(),
        links,
        lambda event, member, text: _heard(event, member, text, told_to_resume),
    )


@contextmanager
def _unprinted() -> Iterator[None]:
    """Show nothing of what libraries print, such as Gloo whenever it connects."""
    kept = [(number, os.dup(number)) for number in (1, 2)]
    try:
        with open(os.devnull, "wb") as nothing:
            for number, _ in kept:
                os.dup2(nothing.fileno(), number)
        yield
    finally:
        for number, copy in kept:
            os.dup2(copy, number)
            os.close(copy)


def _facts(config: Joined) -> Mapping[str, Any]:
    """What all processes must have in common before they begin."""
    import jax

    from experiments.store.provenance import provenance
    from mgpo_jax.files import to_json

    made, devices = provenance(), jax.local_devices()
    settings = to_json(config)
    own = ("process", "debug", "quiet", "config")
    facts = {flag(name): value for name, value in settings.items() if name not in own}
    return {
        **facts,
        "the revision": made["revision"],
        **{f"the version of {name}": version for name, version in made["versions"].items()},
        "the number of devices": len(devices),
        "the kind of devices": devices[0].device_kind,
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
    }


def _devices_told() -> str:
    import jax

    devices = jax.devices()
    return f"{len(devices)} devices ({devices[0].device_kind})"


def _heard(event: str, member: Member, text: str, go_on: str) -> None:
    """React to news of another process; called in a thread of its own."""
    if event == processes.SIGNAL:
        signals.receive(int(text), member.number)
    elif event == processes.FAILED:
        _faults[member.number] = text
        _failed.wait(SAME)  # perhaps this process meets the same error, and says it itself
        if not (_failed.is_set() or signals.is_leaving()):
            _end(f"{member} failed: {text}")
    elif not (_failed.is_set() or signals.is_leaving()):
        _end(f"{member} (process number {member.pid} there) is gone; {go_on}")


_failed = threading.Event()  # set when this process fails by itself
_faults: dict[int, str] = {}  # why others have failed, by their numbers


def leave_failed(team: processes.Team, line: str, message: str, code: int) -> NoReturn:
    """End this process because of an error of its own, and tell the others.

    An error that process 0 meets, too, is printed there only.
    """
    _failed.set()
    team.tell(processes.FAILED, message)
    end = time.monotonic() + SAME
    while team.index and 0 not in _faults and time.monotonic() < end:
        time.sleep(0.01)
    if _faults.get(0) != message:
        _print(line)
    if not team.index:
        team.outlast(2 * SAME)
    os._exit(code)  # jax would wait for the others


def _end(text: str) -> NoReturn:
    """End this process because of another one, with one line."""
    try:
        _print(f"error: {printable(text)}")
        clean_up()
    finally:
        os._exit(1)


def _print(line: str) -> None:
    if sys.__stderr__ is not None:
        with suppress(OSError, ValueError):
            print(line, file=sys.__stderr__, flush=True)
