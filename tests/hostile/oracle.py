"""Run one case in this process, and judge its outcome.

A case runs in its own folder, with its own home folder beside it. Both are compared before and after: a
changed input or an unexpected file is a fault, whatever the command printed. Time is CPU time, so that a
busy machine matters little.
"""

from __future__ import annotations

import importlib
import os
import re
import resource
import shutil
import signal
import stat
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, contextmanager, suppress
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from types import FrameType
from typing import Any, Literal

from . import sound as material
from .cases import Case
from .grammar_json import ESCAPED
from .work import WorkBegan

MAX_SECONDS = 10  # of processor time, for one case
MAX_WAIT = 25  # seconds of the clock, for what waits instead of working
MAX_BYTES = 1 << 30  # that the memory of the process may grow by
HERE = "above/further/case"  # the current folder of a case, below the root of all that is watched
ROOM = 6 << 30  # bytes that it can grow by at all, so that the machine survives

Outcome = Literal[
    "refused clearly", "accepted", "either",
    "unclear", "accepted nonsense", "refused though valid", "traceback", "hang", "memory", "outside",
]  # fmt: skip
BAD = (
    "unclear",
    "accepted nonsense",
    "refused though valid",
    "traceback",
    "hang",
    "memory",
    "outside",
)

CLASS_NAME = re.compile(
    r"\b[A-Z]\w*(Error|Exception|Warning|Interrupt)\b|run with --debug|[Oo]bject has no"
)
WAY_OUT = re.compile(
    r"; \w|\bmust\b|\bneeds?\b|\bknown: |did you mean|python -m|\bmgpo \w|\bexpected\b|takes no value"
    r"|is not a multiple of|\bhas the \w+ \d|\bhas \d+ \w+|No module named|: remove |module \S+ has no"
)
"""What a message says that helps: a fault, a semicolon and what mends it, or what would be right."""


@dataclass(frozen=True)
class Ran:
    """What a command did."""

    code: int | None
    """Its exit code; None if it got to where its work begins."""
    out: str
    err: str
    seconds: float
    grown: int
    """Bytes by which the memory of the process grew at most."""
    new: tuple[str, ...]
    """Files that were not there before."""
    changed: tuple[str, ...]
    """Files that were there before and changed or went."""
    escaped: str = ""
    """The traceback of what left the command and was no exit."""
    imported: tuple[str, ...] = ()
    """Modules that nobody asked for."""
    flaw: str = ""
    """What the check of the case found."""


class TooLong(BaseException):
    """Raised in a command that takes too long."""


@contextmanager
def limited(seconds: float, wait: float) -> Iterator[None]:
    """A limit on processor time and on the clock."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooLong

    before = {number: signal.signal(number, stop) for number in (signal.SIGPROF, signal.SIGALRM)}
    signal.setitimer(signal.ITIMER_PROF, seconds, 1)
    signal.setitimer(signal.ITIMER_REAL, wait, 1)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _status(field: str) -> int:
    """A field of this process in bytes, such as the largest memory so far (VmHWM)."""
    try:
        text = Path("/proc/self/status").read_text()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return int(re.search(rf"{field}:\s+(\d+)", text)[1]) * 1024  # type: ignore[index]


@contextmanager
def bounded_memory() -> Iterator[Callable[[], int]]:
    """Limit the memory of the block; yields a function that returns its peak growth in bytes."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # reset the peak
    before = _status("VmRSS")
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize") + ROOM, hard))
    try:
        yield lambda: max(0, _status("VmHWM") - before)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@contextmanager
def captured(folder: Path) -> Iterator[Callable[[], tuple[str, str]]]:
    """Capture stdout and stderr in files, including output that bypasses Python."""
    paths = [folder / "stdout", folder / "stderr"]
    kept = [os.dup(1), os.dup(2)]
    streams = [sys.stdout, sys.stderr]
    for stream in streams:
        stream.flush()
    files = [open(path, "w", encoding="utf-8", buffering=1) for path in paths]  # noqa: SIM115
    for number, file in enumerate(files, 1):
        os.dup2(file.fileno(), number)
    sys.stdout, sys.stderr = files
    try:
        yield lambda: (_read(files[0], paths[0]), _read(files[1], paths[1]))
    finally:
        sys.stdout, sys.stderr = streams
        for number, descriptor in enumerate(kept, 1):
            os.dup2(descriptor, number)
            os.close(descriptor)
        for file in files:
            file.close()


def _read(file: Any, path: Path) -> str:
    file.flush()
    with open(path, newline="", encoding="utf-8", errors="backslashreplace") as text:
        return text.read()


def snapshot(root: Path) -> dict[str, str]:
    """All files and folders under a root, with a fingerprint of each; pipes are not opened."""
    found = {}
    for folder, folders, files in os.walk(root):
        for name in (*folders, *files):
            path = Path(folder, name)
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                content = f"link to {os.readlink(path)}"
            elif stat.S_ISREG(mode):
                content = blake2b(path.read_bytes(), digest_size=8).hexdigest()
            else:
                content = f"kind {stat.S_IFMT(mode)}"
            found[str(path.relative_to(root))] = content
    return found


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Let warnings reach stderr as they do in a fresh process."""
    with warnings.catch_warnings():
        warnings.resetwarnings()
        for kind in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", kind)
        warnings.simplefilter("always", UserWarning)
        warnings.simplefilter("always", RuntimeWarning)
        warnings.showwarning = _show
        yield


def _show(message: Any, category: Any, filename: str, lineno: int, *_: Any) -> None:
    print(f"{filename}:{lineno}: {category.__name__}: {message}", file=sys.stderr)


def call(command: str, words: Sequence[str]) -> int | None:
    """Run a command in this process; returns its exit code, or None if its work began."""
    try:
        importlib.import_module(f"experiments.{command}").command(list(words))
    except WorkBegan:
        return None
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else (1 if stop.code else 0)
    return 0


def run(
    case: Case, sound: Path, root: Path, command: Callable[[str, Sequence[str]], int | None] = call
) -> Ran:
    """Run a case in a new folder under ``root``, which is removed afterward."""
    shutil.rmtree(root, ignore_errors=True)
    here, home = root / HERE, root / "home"
    material.copy(sound, tuple(case.needs), here)
    home.mkdir()
    if case.prepare is not None:
        case.prepare(here)
    before = snapshot(root)
    environment = {"HOME": str(home), "BROWSER": "true", "COLUMNS": "400"}
    kept = {name: os.environ.get(name) for name in environment}
    os.environ.update(environment)
    os.environ.pop("MGPO_DATA", None)
    modules, handlers = set(sys.modules), _handlers()
    streams = root.with_name(root.name + ".streams")
    streams.mkdir(exist_ok=True)
    sys.path.insert(0, str(here))
    code, escaped, clock = None, "", time.process_time()
    try:
        with chdir(here), captured(streams) as read, bounded_memory() as grown, _plain_warnings():
            try:
                with limited(MAX_SECONDS, MAX_WAIT):
                    code = command(case.command, case.words)
            except TooLong:
                escaped = "TooLong"
            except BaseException:
                escaped = traceback.format_exc()
            seconds, bytes_ = time.process_time() - clock, grown()
            out, err = read()
    finally:
        sys.path.remove(str(here))
        for name, value in kept.items():
            os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)
        for number, handler in handlers.items():
            signal.signal(number, handler)
    imported = tuple({"trap", "antigravity"} & (set(sys.modules) - modules))
    for name in imported:
        del sys.modules[name]
    after = snapshot(root)
    flaw = case.check(here) if case.check and code in (None, 0) and not escaped else ""
    for path in Path(ESCAPED).parent.glob(f"{Path(ESCAPED).name}*"):
        after[str(path)] = "outside"
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    shutil.rmtree(root, ignore_errors=True)
    return Ran(
        code=code,
        out=out,
        err=err,
        seconds=seconds,
        grown=bytes_,
        new=tuple(sorted(after.keys() - before.keys())),
        changed=tuple(sorted(name for name in before if after.get(name) != before[name])),
        escaped=escaped,
        imported=imported,
        flaw=flaw,
    )


def _handlers() -> dict[int, Any]:
    """The signal handlers that commands may replace."""
    return {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)}


def _within(name: str, outputs: Sequence[str]) -> bool:
    return any(
        one in ("", ".") or name == f"{HERE}/{one}" or name.startswith(f"{HERE}/{one}/")
        for one in outputs
    )


def judge(case: Case, ran: Ran) -> tuple[Outcome, str]:
    """The outcome of a case, and the reason in a few words if it is bad."""
    if ran.escaped == "TooLong" or ran.seconds > MAX_SECONDS:
        return "hang", f"stopped after {ran.seconds:.0f} s of processor time"
    if ran.grown > MAX_BYTES:
        return "memory", f"{ran.grown / 1e9:.1f} GB"
    if ran.imported:
        return "outside", f"imported {', '.join(ran.imported)}"
    if ran.escaped:
        return "traceback", ran.escaped.strip().splitlines()[-1]
    if "Traceback (most recent call last)" in ran.err:
        return "traceback", "a traceback on stderr"
    accepted = ran.code in (None, 0)
    allowed = case.outputs if accepted else ()
    if litter := [name for name in ran.new if not _within(name, allowed)]:
        what = "new" if accepted else "new after a refusal"
        return "outside", f"{what}: {', '.join(litter[:3])}"
    if touched := [name for name in ran.changed if not _within(name, allowed)]:
        return "outside", f"changed: {', '.join(touched[:3])}"
    if dirty := _control(ran.out):
        return "unclear", f"stdout holds {dirty!r}"
    if accepted:
        if ran.flaw:
            return "accepted nonsense", ran.flaw
        if case.expected == "refused":
            return "accepted nonsense", "its work began" if ran.code is None else "exit code 0"
        return ("accepted" if case.expected == "accepted" else "either"), ""
    if case.expected == "accepted":
        return "refused though valid", ran.err.strip()[-300:]
    if reason := unclear(case, ran):
        return "unclear", reason
    return ("refused clearly" if case.expected == "refused" else "either"), ""


def _control(text: str) -> str:
    """The first control character; empty if there is none."""
    return next((c for c in text if not c.isprintable() and c not in "\n\t"), "")


def unclear(case: Case, ran: Ran) -> str:
    """What is wrong with a refusal, in words; empty if nothing is."""
    lines = ran.err.splitlines()
    if not lines or lines[-1][:6] != "error:":
        return f"exit code {ran.code} without a line that begins with error:"
    if len(lines) != 1:
        return f"{len(lines)} lines on stderr"
    (line,) = lines
    if dirty := _control(ran.err):
        return f"stderr holds {dirty!r}"
    if found := CLASS_NAME.search(line):
        return f"says {found[0]!r}"
    if ran.code not in case.codes:
        return f"exit code {ran.code} instead of {' or '.join(map(str, case.codes))}"
    if case.names and not any(name and name in line for name in case.names):
        return f"names none of {', '.join(map(repr, case.names))}"
    if case.found and not any(text in line for text in case.found):
        return f"does not show {case.found[0]!r}"
    for name in sorted(case.names, key=len, reverse=True):
        line = line.replace(name, "")  # a flag that is wrong is not a way out
    if not WAY_OUT.search(line):
        return "names no way out"
    return ""
