"""Run real commands in processes that start cheaply, and that can be killed, stopped and starved.

Importing jax and the commands costs seconds of CPU time. A server imports them once, runs no command
itself, and forks: each fork runs one command line as a fresh process would, or one after another.
"""

from __future__ import annotations

import atexit
import errno
import importlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any, NamedTuple, NoReturn

TESTS = Path(__file__).parents[1]
ROOT = TESTS.parent
LIMIT = 120.0  # seconds, after which a command counts as hanging
HEAVY = (
    "experiments.adaptation",
    "experiments.collect",
    "experiments.drawing",
    "experiments.training",
    "own_world",
)
# Two devices, as in all tests. Programs are small and run only a few times, so they are not optimized.
XLA_FLAGS = (
    "--xla_force_host_platform_device_count=2 --xla_backend_optimization_level=0 "
    "--xla_llvm_disable_expensive_passes=true"
    + " --xla_cpu_use_fusion_emitters=false"
    * version("jaxlib").startswith("0.10.")
)
NEED_ROOM = ("open", "os.mkdir", "os.link", "os.symlink")
CHANGES = (*NEED_ROOM, "os.rename", "os.remove", "os.rmdir", "os.truncate")
"""Events of ``sys.audit`` that change files; ``open`` only counts if it is for writing."""


class Ended(NamedTuple):
    """How a command ended, and what it printed."""

    code: int
    """Exit code, or the negative number of the signal that ended it."""
    out: str
    err: str

    @property
    def lines(self) -> list[str]:
        """The lines on stderr."""
        return self.err.strip().splitlines()


@dataclass(frozen=True)
class Trap:
    """A disturbance of a process just before one of its operations that change files below its folder."""

    at: int
    """The number of that operation, counted from 1."""
    number: int = signal.SIGKILL
    """The signal to send; 0 to simulate a full disk from then on instead."""
    delay: float = 0.0
    """Seconds to wait before the signal, while the process goes on."""


class Child:
    """A process that runs a command."""

    def __init__(
        self, pid: int, end: Callable[[float], int], out: IO[bytes], err: IO[bytes]
    ) -> None:
        self.pid = pid
        self._end, self._out, self._err = end, out, err

    def send(self, number: int) -> None:
        """Send a signal to the process."""
        os.kill(self.pid, number)

    def wait(self, limit: float = LIMIT) -> Ended:
        """Wait until the process ends.

        Raises:
          TimeoutError: if that takes longer than ``limit`` seconds; the process is killed.
        """
        try:
            code = self._end(limit)
        except (TimeoutError, subprocess.TimeoutExpired):
            self.send(signal.SIGKILL)
            raise TimeoutError(f"no end after {limit} s; stderr: {self.err}") from None
        return Ended(code, _read(self._out), self.err)

    @property
    def err(self) -> str:
        """What the process has written to stderr so far."""
        return _read(self._err)

    @property
    def is_held(self) -> bool:
        """Whether the process is stopped by SIGSTOP."""
        return self._stat()[0] == "T"

    @property
    def cpu_seconds(self) -> float:
        """CPU time of the process so far."""
        return (int(self._stat()[11]) + int(self._stat()[12])) / os.sysconf("SC_CLK_TCK")

    def _stat(self) -> list[str]:
        """The fields of ``/proc/PID/stat``, from the state on."""
        return Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()

    def wait_for(self, condition: Callable[[], bool], limit: float = LIMIT) -> None:
        """Wait until a condition holds."""
        last = time.monotonic() + limit
        while not condition():
            assert time.monotonic() < last, f"it did not happen; stderr: {self.err}"
            time.sleep(0.005)


def _streams() -> tuple[IO[bytes], IO[bytes]]:
    """Files for stdout and stderr."""
    return tempfile.TemporaryFile(), tempfile.TemporaryFile()


def _read(file: IO[bytes]) -> str:
    return os.pread(file.fileno(), 1 << 20, 0).decode(errors="replace")


class Server:
    """Starts commands in forks of a process that has imported what they need.

    Args:
      cache: folder of compiled programs, which all commands share.
    """

    def __init__(self, cache: Path) -> None:
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.environment = {
            **os.environ,
            "JAX_PLATFORMS": "cpu",
            "MGPO_CACHE": str(cache),
            "PYTHONPATH": f"{ROOT}{os.pathsep}{TESTS}",
            "XLA_FLAGS": XLA_FLAGS,
        }
        self.environment.pop("MGPO_DATA", None)
        with there:
            self._process = subprocess.Popen(
                [sys.executable, "-c", f"import hostile.processes as p; p.serve({there.fileno()})"],
                pass_fds=[there.fileno()],
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )
        self._requests = here
        self._steady: socket.socket | None = None
        self._running: set[int] = set()

    def end_all(self) -> None:
        """Kill all processes that are still running."""
        for pid in self._running:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._running.clear()

    def close(self) -> None:
        self.end_all()
        self._requests.close()
        if self._steady is not None:
            self._steady.close()
        self._process.wait(10)

    def start(self, line: str, folder: Path, trap: Trap | None = None, **options: str) -> Child:
        """Start a command line in its own process.

        Args:
          line: the name of the command and its words.
          folder: its current folder.
          trap: a disturbance of the process.
          **options: ``count`` names a file for the number of its operations that change files; ``stdout``
            is ``closed``, ``broken`` (a pipe without a reader) or an encoding; with ``thread`` the command
            does not run in the main thread.
        """
        out, err = _streams()
        request = {"line": line, "folder": str(folder), **options}
        if trap is not None:
            request["trap"] = asdict(trap)
        reply = self._ask(request, out, err)
        pid = int(reply.recv(100))
        self._running.add(pid)

        def end(limit: float) -> int:
            reply.settimeout(limit)
            with reply:
                code = int(reply.recv(100))
            self._running.discard(pid)
            return code

        return Child(pid, end, out, err)

    def _ask(self, request: dict[str, Any], out: IO[bytes], err: IO[bytes]) -> socket.socket:
        mine, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        files = [theirs.fileno(), out.fileno(), err.fileno()]
        with theirs:
            socket.send_fds(self._requests, [json.dumps(request).encode()], files)
        return mine

    def run(self, line: str, folder: Path, trap: Trap | None = None, **options: str) -> Ended:
        """Run a command line in its own process until it ends."""
        return self.start(line, folder, trap, **options).wait()

    def again(self, line: str, folder: Path) -> Ended:
        """Run a command line in a process that is reused, so that nothing compiles twice."""
        out, err = _streams()
        if self._steady is None:
            self._steady = self._ask({}, out, err)
            self._steady.recv(100)  # wait until it is ready
        request = json.dumps({"line": line, "folder": str(folder)}).encode()
        socket.send_fds(self._steady, [request], [out.fileno(), err.fileno()])
        self._steady.settimeout(LIMIT)
        return Ended(int(self._steady.recv(100)), _read(out), _read(err))

    def from_scratch(self, line: str, folder: Path, *, shell: str = "{}", **options: Any) -> Child:
        """Start a command line as a user does, in a fresh interpreter.

        Args:
          line: the command line.
          folder: its current folder.
          shell: template of the shell command, such as ``{} >&-``.
          **options: options of ``subprocess.Popen``.
        """
        out, err = _streams()
        words = shell.format(f"exec {sys.executable} -m experiments.{line}")
        options = {"env": self.environment, "stdout": out, "stderr": err, **options}
        process = subprocess.Popen(
            ["bash", "-c", words], cwd=folder, stdin=subprocess.DEVNULL, **options
        )
        self._running.add(process.pid)

        def end(limit: float) -> int:
            code = process.wait(limit)
            self._running.discard(process.pid)
            return code

        return Child(process.pid, end, out, err)


# The functions below run in the server and in its forks.


def serve(descriptor: int) -> None:
    """Fork for each request until there are no more; returns in the server only."""
    for name in HEAVY:
        importlib.import_module(name)
    requests = socket.socket(fileno=descriptor)
    children = 0
    while True:
        message, files, *_ = socket.recv_fds(requests, 1 << 16, 3)
        if not message:
            break
        children += 1
        if os.fork() == 0:
            requests.close()
            _attend(json.loads(message), *files)
        for file in files:
            os.close(file)
    for _ in range(children):  # their CPU time then counts as the server's
        os.wait()


def _attend(request: dict[str, Any], reply: int, out: int, err: int) -> None:
    """Fork once more for the command, and report its end."""
    answer = socket.socket(fileno=reply)
    if not request:
        _settle()
        answer.send(b"ready")
        _stay(answer)
    pid = os.fork()
    if pid == 0:
        answer.close()
        _settle()
        _take(request, out, err)
        _spoil(request.get("stdout", ""))
        _watch(request)
        if request.get("thread"):
            _call_in_thread(request["line"])
        _call(request["line"])
    answer.send(str(pid).encode())
    os.close(out)
    os.close(err)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    try:
        answer.send(str(code).encode())
    finally:
        os._exit(0)


def _settle() -> None:
    """Cache all compiled programs, including those that compile quickly."""
    import jax

    from experiments import runtime

    configure = runtime.configure

    def configure_and_keep_all() -> None:
        configure()
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

    runtime.configure = configure_and_keep_all


def _take(request: dict[str, Any], out: int, err: int) -> None:
    """Take over the current folder and the streams of a request."""
    os.chdir(request["folder"])
    for file, number in ((out, 1), (err, 2)):
        os.dup2(file, number)
        os.close(file)
    sys.argv = ["mgpo", *request["line"].split()]


def _call(line: str) -> NoReturn:
    name, *words = line.split()
    importlib.import_module(f"experiments.{name}").command(words)
    raise AssertionError("a command exits")


def _call_in_thread(line: str) -> NoReturn:
    """Run a command in a thread; fails if it changes any signal handler."""
    before = [signal.getsignal(number) for number in signal.valid_signals()]
    codes: list[int] = []

    def call() -> None:
        try:
            _call(line)
        except SystemExit as end:
            codes.append(int(end.code or 0))

    thread = threading.Thread(target=call)
    thread.start()
    while thread.is_alive():
        assert before == [signal.getsignal(number) for number in signal.valid_signals()]
        thread.join(0.02)
    sys.exit(codes[0])


def _spoil(stdout: str) -> None:
    """Make stdout a stream that cannot take everything."""
    if stdout == "closed":
        os.close(1)
        sys.stdout = None  # type: ignore[assignment]
    elif stdout == "broken":
        reading, writing = os.pipe()
        os.dup2(writing, 1)
        os.close(reading)
        os.close(writing)
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    elif stdout:
        sys.stdout.reconfigure(encoding=stdout, errors="strict")  # type: ignore[union-attr]


def _remember(module: Any, name: str) -> None:
    """Cache the objects of a class by their arguments, so that repeated trainings trace nothing twice."""
    kind, made = getattr(module, name), {}

    def make(*args: Any) -> Any:
        # The repr of a dataset does not identify it, but its number of trajectories does here.
        key = tuple(len(arg) if hasattr(arg, "lengths") else repr(arg) for arg in args)
        if key not in made:
            made[key] = kind(*args)
        return made[key]

    setattr(module, name, make)


def _stay(answer: socket.socket) -> NoReturn:
    """Run one command line after another."""
    from experiments import training, watching

    _remember(training, "Trainer")
    _remember(watching, "ReturnsOnTheWay")
    while True:
        message, files, *_ = socket.recv_fds(answer, 1 << 16, 2)
        if not message:
            os._exit(0)
        request = json.loads(message)
        _take(request, *files)
        try:
            _call(request["line"])
        except SystemExit as end:
            code = int(end.code or 0)
        except BaseException:
            traceback.print_exc()
            code = 1
        sys.stdout.flush()
        sys.stderr.flush()
        answer.send(str(code).encode())


def _watch(request: dict[str, Any]) -> None:
    """Count the operations that change files, and arm the trap."""
    trap = Trap(**request["trap"]) if "trap" in request else None
    here, lock = os.getcwd() + os.sep, threading.Lock()
    number = 0

    def hook(event: str, args: tuple[Any, ...]) -> None:
        nonlocal number
        if not _changes(event, args, here):
            return
        with lock:
            number += 1
            now = number
        if trap is None or now < trap.at:
            return
        if trap.number == 0:
            if event in NEED_ROOM:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), args[0])
        elif now == trap.at:
            if trap.delay:
                threading.Timer(trap.delay, os.kill, (os.getpid(), trap.number)).start()
            else:
                os.kill(os.getpid(), trap.number)

    if trap is not None or request.get("count"):
        sys.addaudithook(hook)
    if request.get("count"):
        atexit.register(lambda: Path(request["count"]).write_text(str(number)))


def _changes(event: str, args: tuple[Any, ...], here: str) -> bool:
    """Whether an event of ``sys.audit`` changes a file below a folder."""
    if event not in CHANGES:
        return False
    if event == "open":
        writes = isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        if not writes:
            return False
    path = args[0]
    if not isinstance(path, str | bytes | os.PathLike):
        return False
    return os.path.abspath(os.fsdecode(path)).startswith(here)
