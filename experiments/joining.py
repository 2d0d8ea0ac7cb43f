"""``--distributed``: run one command on several processes, hosts and accelerators.

Every process runs the same command line. After its flags have been checked and before it computes anything,
it joins the others, which it finds by the variables of a scheduler or by ``--coordinator``. This happens
only on request, since ``salloc`` sets SLURM's variables for a single process, too. From then on only
process 0 prints, draws and writes. If one process is asked to stop, fails or dies, the others are told.
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
from experiments import cards, signals
from experiments.runtime import Common, Silent
from mgpo_jax import doors, processes
from mgpo_jax.claims import clean_up
from mgpo_jax.processes import Member
from mgpo_jax.settings import flag

ARRIVING = 300  # seconds in which all processes must have started
AFTER_US = 60  # seconds later, jax would abort the process; we end it first, with a message
HEARTBEATS = 100  # seconds without a sign of life until jax gives up a process; we notice earlier
LEAVING = 20  # seconds that jax waits for the others at shutdown, when all have reached it
SAME = 2.0  # seconds within which an error common to all processes occurs in each of them
PLACE = struct.Struct(">64sQQ16s")  # host, process number, port and password
GO_ON = {"resume": "continue with --resume", "": "run the same command again"}


@dataclass(frozen=True)
class Joined(Common):
    """Flags of the commands that several processes can run together."""

    distributed: bool = False
    """Run on several processes (docs/scale.md), started by SLURM, Open MPI 4 or a TPU slice, or described
    by the next three flags. All need the same command line, except for ``--process``."""
    coordinator: str | None = None
    """Address of process 0 for the others to connect to, as HOST:PORT."""
    processes: Annotated[int, Ge(1), Le(65_536)] | None = None
    """Total number of processes."""
    process: Annotated[int, Ge(0), Le(65_535)] | None = None
    """Index of this process, counted from 0."""


_SHARED = {field.name for field in dataclasses.fields(Common)}
OF_PROCESSES = tuple(
    field.name for field in dataclasses.fields(Joined) if field.name not in _SHARED
)
"""The settings of ``Joined`` alone, which do not affect results."""


def check_flags(config: Joined) -> None:
    """Raise ``UsageError`` for flags of ``--distributed`` that are missing or contradict each other."""
    given = [name for name in OF_PROCESSES[1:] if getattr(config, name) is not None]
    if given and not config.distributed:
        value = shown(getattr(config, given[0]))
        raise UsageError(
            f"{flag(given[0])} {value} only works with --distributed; add --distributed, or leave it out"
        )
    if config.distributed and getattr(config, "dry_run", False):
        raise UsageError(
            "--dry-run computes nothing, so it cannot be distributed; leave out --distributed"
        )
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
            f"--process must be from 0 to {config.processes - 1}, since there are {config.processes} "
            f"processes, found {config.process}"
        )


def join(config: Joined) -> None:
    """Join the other processes if ``--distributed`` is given; must run before anything is computed.

    Raises:
      UsageError: if the flags contradict each other, or nothing says where the other processes are.
      DataError: if the others do not arrive in time, or were started differently.
    """
    check_flags(config)
    if not config.distributed:
        return
    _start(config)
    import jax

    if jax.process_count() > 1:
        team = _connect(config)
        processes.join(team)
        signals.tell_others(
            lambda number: team.tell(processes.SIGNAL, str(number)),
            lambda: None if team.index else team.outlast(SAME),
        )
        if team.index:
            sys.stdout = sys.stderr = Silent(sys.stderr)
        processes.check_agreed(_facts(config))
        print(f"{len(team.members)} processes, {_describe_devices()}", file=sys.stderr)


def _start(config: Joined) -> None:
    """Initialize ``jax.distributed``."""
    import jax

    # The preemption service would catch SIGTERM; we answer requests to stop ourselves (``signals``).
    jax.config.update("jax_enable_preemption_service", False)
    cards.choose_same_programs(os.environ)
    place: dict[str, Any] = {"local_device_ids": cards.own_cards(os.environ)}
    if config.coordinator is not None:
        place = {
            "coordinator_address": config.coordinator,
            "num_processes": config.processes,
            "process_id": config.process,
            "cluster_detection_method": "deactivate",
        }
        if config.coordinator.startswith(("127.", "localhost:")):
            place["coordinator_bind_address"] = config.coordinator
    where = config.coordinator or "the place that the scheduler names"
    mend = "start all of them with the same --coordinator and --processes, and a --process each"
    try:
        with _within(
            ARRIVING, f"not all processes have met at {where} within {ARRIVING} s; {mend}"
        ):
            jax.distributed.initialize(
                initialization_timeout=ARRIVING + AFTER_US,
                heartbeat_timeout_seconds=HEARTBEATS,
                shutdown_timeout_seconds=LEAVING,
                **place,
            )
    except ValueError:
        if config.coordinator is not None:
            raise
        raise UsageError(
            "--distributed found no environment variables of SLURM, Open MPI 4 or a TPU slice that "
            "identify the processes (jax does not know those of Open MPI 5); give --coordinator HOST:PORT "
            "--processes N --process I"
        ) from None
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise DataError(f"the processes cannot meet at {where} ({reason}); {mend}") from None


@contextmanager
def _within(seconds: float, text: str) -> Iterator[None]:
    """End this process with a one-line message if the block takes longer than ``seconds``.

    jax itself would abort the process with a stack trace, which no Python code can catch.
    """
    timer = threading.Timer(seconds, _end, (text,))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _connect(config: Joined) -> processes.Team:
    """Exchange addresses in a first collective over all devices, and connect the processes.

    Every process must reach the first collective within 30 seconds. So it comes now, before anything that
    may take longer in one of them.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from mgpo_jax.sharding import rows_of_processes

    first = jax.process_index() == 0
    only_here = (config.coordinator or "").startswith(("127.", "localhost:"))
    door = doors.Door(only_here) if first else None
    host, pid = processes.own_name()
    password, port = (door.password, door.port) if door else (b"", 0)
    own = np.frombuffer(PLACE.pack(host.encode()[:64], pid, port, password), np.uint8)
    with _discard_output():
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
        places = [*_host_of_first(), members[0].host]
        links = {0: doors.connected(places, port, password, jax.process_index())}
    told_to_resume = GO_ON["resume" if hasattr(config, "resume") else ""]
    return processes.Team(
        members,
        jax.process_index(),
        links,
        lambda event, member, text: _react(event, member, text, told_to_resume),
    )


def _host_of_first() -> list[str]:
    """The address at which jax has reached process 0, which may differ from the name of its host."""
    from jax._src import distributed  # jax has no public function for this

    address = getattr(distributed.global_state, "coordinator_address", None) or ""
    return [host] if (host := address.rpartition(":")[0].strip("[]")) else []


@contextmanager
def _discard_output() -> Iterator[None]:
    """Discard what libraries print to stdout and stderr, such as Gloo whenever it connects."""
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
    """What all processes must agree on before they begin, by what messages call it."""
    import jax

    from experiments.store.provenance import provenance
    from mgpo_jax.files import to_json

    made, devices = provenance(), jax.local_devices()
    settings = to_json(config)
    own = ("process", "debug", "quiet", "config")
    precision = jax.config.jax_default_matmul_precision  # type: ignore[attr-defined]
    facts = {flag(name): value for name, value in settings.items() if name not in own}
    return {
        **facts,
        "the revision": made["revision"],
        **{f"the version of {name}": version for name, version in made["versions"].items()},
        "the number of devices": len(devices),
        "the kind of devices": devices[0].device_kind,
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
        "JAX_DEFAULT_MATMUL_PRECISION": precision,
    }


def _describe_devices() -> str:
    import jax

    devices = jax.devices()
    return f"{len(devices)} devices ({devices[0].device_kind})"


def _react(event: str, member: Member, text: str, go_on: str) -> None:
    """React to an event in another process; called in a thread of its own."""
    if event == processes.SIGNAL:
        signals.receive(int(text), member.number)
    elif event == processes.FAILED:
        _faults[member.number] = text
        _failed.wait(SAME)  # this process may meet the same error, and would report it itself
        if _may_end():
            _end(f"{member} failed: {text}")
    elif not _faults and _may_end():  # processes that end because of a known fault are not news
        _end(f"{member} (pid {member.pid}) has ended unexpectedly; {go_on}")


def _may_end() -> bool:
    """Whether the calling thread is the one that ends this process because of another process."""
    return not (_failed.is_set() or signals.is_leaving()) and _first.acquire(blocking=False)


_first = threading.Lock()  # taken by the first thread that ends this process because of another one
_ending = threading.Event()  # set when this process ends because of another one
_failed = threading.Event()  # set when this process fails because of an error of its own
_faults: dict[int, str] = {}  # error messages of other processes, by their numbers


def leave_failed(team: processes.Team, line: str, message: str, code: int) -> NoReturn:
    """Exit because of an error in this process, and tell the others.

    An error that process 0 meets, too, is only printed there.
    """
    if _ending.is_set():  # another thread has said why, and ends the process
        time.sleep(2 * SAME)
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
    """Exit because of another process, with a one-line message.

    Process 0 waits for the others to end, too, so that they print this line before jax aborts them.
    """
    _ending.set()
    try:
        _print(f"error: {printable(text)}")
        clean_up()
        if (team := processes.team()) is not None and not team.index:
            team.outlast(SAME)
    finally:
        os._exit(1)


def _print(line: str) -> None:
    if sys.__stderr__ is not None:
        with suppress(OSError, ValueError):
            print(line, file=sys.__stderr__, flush=True)
