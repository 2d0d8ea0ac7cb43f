"""What all commands share: parsing, process settings, errors and exit codes.

A command line is parsed before jax is imported, so that help and usage errors appear at once. This module
also holds the process settings that matter on a CPU:

- One XLA device per core. The programs here are small; one on each core wastes less than one on all cores.
- The C library never returns memory to the kernel: a gradient step frees and allocates hundreds of MB, and
  every page that comes back from the kernel costs a page fault. All threads share one arena, since
  per-thread arenas return their memory whatever the settings.
- jax's persistent compilation cache (``~/.cache/mgpo_jax``, or ``$MGPO_CACHE``) lets the second run of a
  command start in seconds.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import json
import os
import platform
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

from envs.errors import DataError, MissingExtraError, UsageError, printable, shown
from experiments import signals
from mgpo_jax import processes
from mgpo_jax.claims import NO_ROOM, check_place
from mgpo_jax.settings import flag

PRINT_COMPLETION = "--tyro-print-completion"
"""The flag of programs made with tyro; here it is the command ``completion``."""
OF_CALLBACK = "INTERNAL: Error when calling buffer callback"
"""How jax's message begins when a host callback of a compiled program raises an error."""

EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED = 1, 2, 130
NEWS = 3.0
"""Seconds to wait after an error in one of several processes, for news that another one caused it."""

LEAST_COMPILED = 0.01
"""Programs that take this many seconds to compile are cached; a command has dozens of small ones."""

# mallopt parameters of the GNU C library
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -2, -3, -8


@dataclass(frozen=True)
class Common:
    """Flags of every command."""

    debug: bool = False
    """Show the traceback of an error."""
    quiet: bool = False
    """Print nothing but errors on stderr: no progress, no notes."""
    config: Path | None = None
    """The ``config.json`` of a run, whose settings become the defaults of the flags."""


def configure() -> None:
    """Set up the process; must run before jax is imported."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_force_host_platform_device_count" not in flags:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
        os.environ["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count={cores}".strip()
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        libc.mallopt(M_ARENA_MAX, 1)
        libc.mallopt(M_MMAP_THRESHOLD, 1 << 30)
        libc.mallopt(M_TRIM_THRESHOLD, (1 << 31) - 1)
        libc.mallopt(M_TOP_PAD, 1 << 28)

    os.environ["JAX_ENABLE_X64"] = "0"  # everything here is float32
    if "jax" in sys.modules:  # a world or method of a user was imported with it
        sys.modules["jax"].config.update("jax_enable_x64", False)
    # jax reads these on import, which happens after the command line has been checked.
    cache = cache_folder()
    try:
        os.makedirs(cache, mode=0o700, exist_ok=True)  # private: programs are loaded from there
    except OSError as error:
        text = f"cannot cache compiled programs in {cache} ({error.strerror}): every command compiles again"
        print(f"{text}; set MGPO_CACHE to a writable folder", file=sys.stderr)
        return
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = cache
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(LEAST_COMPILED)
    if "jax" in sys.modules:  # as above
        import jax

        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", LEAST_COMPILED)


def cache_folder() -> str:
    """The folder of compiled programs: ``$MGPO_CACHE``, or ``~/.cache/mgpo_jax`` if that is not set."""
    if "MGPO_CACHE" in os.environ:
        return os.environ["MGPO_CACHE"]
    try:
        home = Path.home()
    except RuntimeError:  # a user without a home, as in some containers
        return os.path.join(tempfile.gettempdir(), f"mgpo_jax-{os.getuid()}")
    return str(home / ".cache" / "mgpo_jax")


@dataclass(frozen=True)
class Compiling:
    """Work that begins with compiling, unless its programs are in the compilation cache already.

    jax does not tell whether they are. Work that was done before therefore leaves an empty file in the
    cache, whose name is a hash of what decides its programs.

    Attributes:
      what: the work in a few words, for the message.
      deciding: what the programs depend on, as JSON values: names of world and method, sizes.
    """

    what: str
    deciding: Mapping[str, Any]

    def announce(self) -> None:
        """Say on stderr that the work begins with compiling, if it was not done with this cache before."""
        if not self._marker.exists():
            text = (
                f"{self.what}: compiling first, which can take some minutes; the next time, programs come "
                "from the cache (if XLA warns of a very slow compile, that is harmless)"
            )
            print(text, file=sys.stderr)

    def done(self) -> None:
        """Remember that the programs are in the cache; without a cache there is nothing to remember."""
        with suppress(OSError):
            self._marker.touch()

    @property
    def _marker(self) -> Path:
        facts = {
            **self.deciding,
            "versions": [version("jax"), version("jaxlib")],
            "devices": [os.environ.get(name, "") for name in ("JAX_PLATFORMS", "XLA_FLAGS")],
        }
        text = json.dumps(facts, sort_keys=True)
        return Path(cache_folder(), f"compiled-{hashlib.sha256(text.encode()).hexdigest()[:16]}")


def run(
    config_class: type,
    main: Callable[[Any], None],
    default: Callable[[Any, Sequence[str]], Any] | None = None,
    argv: Sequence[str] | None = None,
    subcommand: str = "",
) -> NoReturn:
    """Parse a command line into ``config_class`` and run ``main`` on it; exits.

    Exit codes: 0 done, 1 failed, 2 usage, 128 plus the number of a signal that ended it (130: Ctrl-C).

    Args:
      config_class: a frozen dataclass derived from ``Common``.
      main: the command; its docstring is the text of ``--help``, and it imports whatever needs jax itself.
      default: chooses the defaults, where they depend on other flags; see ``parsing.parse``.
      argv: the words of the command line (default: those of the process).
      subcommand: the word before them that chose this command, for messages.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] == [PRINT_COMPLETION]:
        from experiments.completion import command

        command(words[1:])
    debug = "--debug" in words
    _make_sturdy(debug)
    config = None
    try:
        with signals.watched():
            from experiments.parsing import parse

            text = main.__doc__ or ""
            prog = f"{program_name()} {subcommand}".rstrip()
            config = parse(config_class, words, default, description=text, prog=prog)
            with _silence() if config.quiet else nullcontext():
                configure()
                main(config)
                _wait_for_others()
    except signals.Stopped as stop:
        _wait_for_others()
        _fail(str(stop), 128 + stop.number, debug, "")
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)
    except (UsageError, DataError, MissingExtraError) as error:
        _fail(str(error), EXIT_FAILED if isinstance(error, DataError) else EXIT_USAGE, debug)
    except Exception as error:
        if processes.team() is not None:
            time.sleep(NEWS)
        too_long = isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG
        _fail(explained(error, config), EXIT_USAGE if too_long else EXIT_FAILED, debug)
    sys.exit(0)


def _make_sturdy(debug: bool) -> None:
    """Keep the command running whatever it prints, and let only the main thread report errors.

    Characters that a stream cannot print are escaped. Errors in other threads or in destructors are not
    printed, since the main thread meets them as well.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    if sys.stderr is None or sys.stderr is sys.__stderr__:
        sys.stderr = _Tolerant(sys.stderr or open(os.devnull, "w"))  # noqa: SIM115 (for good)
    if not debug and threading.excepthook is threading.__excepthook__:
        threading.excepthook = lambda args: None
    if not debug and sys.unraisablehook is sys.__unraisablehook__:
        sys.unraisablehook = lambda args: None


class _Tolerant:
    """A stream for messages that ignores failed writes, for example when its reader is gone."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        with suppress(OSError, ValueError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class Silent(_Tolerant):
    """A stream that discards everything written to it."""

    def write(self, text: str) -> int:
        return len(text)


@contextmanager
def _silence() -> Iterator[None]:
    """Discard what is written to stderr within the block; errors that leave it are reported afterward."""
    stream, sys.stderr = sys.stderr, Silent(sys.stderr)
    try:
        yield
    finally:
        sys.stderr = stream


def say(text: str) -> None:
    """Print a result on stdout. If stdout is closed or full, the command goes on without it."""
    if sys.stdout is None:
        return
    try:
        "±".encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        text = text.replace("±", "+-")
    try:
        print(text, flush=True)
    except OSError as error:
        # What is left in the stream's buffer must not fail again when the interpreter exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            print(f"stdout cannot be written ({error.strerror})", file=sys.stderr)


def explained(error: BaseException, config: Any = None) -> str:
    """An unexpected error as a one-line message that says how to mend it, where that is known."""
    for cause in _causes(error):
        if isinstance(cause, OSError) and cause.errno in NO_ROOM:
            folder = (
                cause.filename or getattr(config, "out", None) or getattr(config, "folder", None)
            )
            where = f" for {folder}" if folder else ""
            again = "--resume" if hasattr(config, "resume") else "the same command"
            return f"no space left on the disk{where}; free some space and continue with {again}"
        if isinstance(cause, OSError) and cause.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
            what = cause.filename or "a file"
            return f"{what} cannot be read or written ({cause.strerror}); change its permissions"
        if isinstance(cause, FileExistsError):  # such as a link to nowhere in place of a folder
            return f"{cause.filename} already exists and is not a folder; remove it or choose another place"
        if isinstance(cause, OSError) and cause.errno == errno.ENAMETOOLONG:
            where = _flag_of(config, cause.filename)
            return f"{where}the name {shown(cause.filename)} is too long; choose a shorter one"
        if isinstance(cause, MemoryError) or "RESOURCE_EXHAUSTED" in str(cause):
            less = "fewer tasks, seeds, episodes or trajectories, or a smaller batch or network"
            return f"out of memory; use {less}"
    text = str(error).splitlines()[0] if str(error) else "no reason was given"
    if text.startswith(OF_CALLBACK):
        # A traceback follows, and its last line is the error on the host.
        return str(error).strip().splitlines()[-1].removeprefix("envs.errors.")
    platforms = os.environ.get("JAX_PLATFORMS")
    if platforms and "nable to initialize backend" in text:
        return (
            f"JAX_PLATFORMS={platforms} names a platform that is not available on this machine; unset it, "
            "or set it to cpu"
        )
    return f"unexpected error: {text}; run with --debug to see the traceback"


def _flag_of(config: Any, path: Any) -> str:
    """The flag whose value a path lies in or is named after, as ``OUT/x`` or ``OUT.partial``; empty if
    there is none."""
    if not isinstance(path, str):
        return ""
    named = [
        (len(value.parts), name)
        for name, value in (vars(config) if config is not None else {}).items()
        if isinstance(value, Path) and _belongs(Path(path), value)
    ]
    return f"{flag(max(named)[-1])}: " if named else ""


def _belongs(path: Path, value: Path) -> bool:
    """Whether a path is a value, lies below it, or is made beside it, as ``OUT.partial`` is."""
    is_beside = path.parent == value.parent and path.name.startswith(f"{value.name}.")
    return is_beside or path.is_relative_to(value)


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error, followed by its causes and contexts."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__ or error.__context__


def program_name() -> str:
    """The command as the user called it, for usage messages."""
    stem = Path(sys.argv[0]).stem
    if stem in ("mgpo", "__main__"):
        return " ".join(["mgpo", *sys.argv[1:2]])
    return f"python -m experiments.{stem}"


def _wait_for_others() -> None:
    """Wait until all processes have reached the end of the command."""
    if (team := processes.team()) is not None:
        team.leave(wait=True)


def _fail(message: str, code: int, debug: bool, prefix: str = "error: ") -> NoReturn:
    if debug:
        traceback.print_exc()
    line = f"{prefix}{printable(message)}"
    if (team := processes.team()) is not None and prefix:
        from experiments.joining import leave_failed

        leave_failed(team, line, message, code)
    if sys.stderr is not None and processes.is_first():
        print(line, file=sys.stderr)
    sys.exit(code)


def require_runs(runs: Sequence[Path], command: str) -> None:
    """Raise ``UsageError`` if a command was given no result folder."""
    if not runs:
        raise UsageError(
            f"no result folder given; usage: python -m experiments.{command} RUN_DIR ..."
        )


def refuse_existing(folder: Path, *ways_out: str) -> None:
    """Raise ``UsageError`` if an output exists, with ways out in the message, or if it cannot be made."""
    if os.path.lexists(folder):
        raise UsageError(f"{folder} already exists; {', or '.join(ways_out)}")
    check_place(folder)


def refuse_existing_file(path: Path, named_by: str) -> None:
    """Raise ``UsageError`` if an output file exists, or if it cannot be made."""
    if os.path.lexists(path):
        raise UsageError(f"{named_by} {path} already exists; remove it or choose another file")
    require_parent(path, named_by)
    check_place(path, named_by)


def require_parent(path: Path, named_by: str) -> None:
    """Raise ``UsageError`` if the parent folder of an output file does not exist."""
    if not path.name or not path.absolute().parent.is_dir():
        raise UsageError(f"{named_by} {path}: there is no folder {path.parent}; make it first")
