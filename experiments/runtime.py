"""What every command line shares: parsing, process settings, errors and exit codes.

A command line is parsed before jax is imported, so that help and usage errors answer at once. Settings of
the process that matter on a CPU, all in one place:

- One XLA device a core. The programs here are small; one on each core wastes less than one on all.
- The C library never gives memory back to the kernel: a gradient step frees and allocates hundreds of
  MB, and every page that comes back from the kernel costs a fault. All threads share one arena, since
  the arenas of threads return their memory however they are set.
- jax's persistent compilation cache (``~/.cache/mgpo_jax``, or ``$MGPO_CACHE``): the second run of a
  command starts in seconds.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import platform
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import tyro

from envs.errors import DataError, UsageError
from mgpo_jax.settings import check_settings

EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED = 1, 2, 130

# mallopt parameters of the GNU C library
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -2, -3, -8


@dataclass(frozen=True)
class Common:
    """Flags of every command."""

    debug: bool = False
    """Show the traceback of an error."""


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

    cache = os.environ.get("MGPO_CACHE", str(Path.home() / ".cache" / "mgpo_jax"))
    # jax reads these when it is imported, which is after a command has found nothing wrong.
    os.environ["JAX_COMPILATION_CACHE_DIR"] = cache
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.5"
    if "jax" in sys.modules:  # a world or method of a user was imported with it
        import jax

        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def run(
    config_class: type,
    main: Callable[[Any], None],
    default: Callable[[Sequence[str]], Any] | None = None,
    argv: Sequence[str] | None = None,
) -> NoReturn:
    """Parse a command line into ``config_class`` and run ``main`` on it; exits.

    Exit codes: 0 done, 1 failed, 2 usage, 130 interrupted.

    Args:
      config_class: a frozen dataclass derived from ``Common``.
      main: the command; it imports what needs jax by itself.
      default: ``argv -> default config``, where defaults depend on other flags.
      argv: the words of the command line (default: those of the process).
    """
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    try:
        values = {} if default is None else {"default": default(words)}
        parsed: Any = tyro.conf.OmitArgPrefixes[config_class]
        config = tyro.cli(
            parsed, prog=program_name(), args=words, description=main.__doc__, **values
        )
        check_settings(config)
        configure()
        main(config)
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)
    except (UsageError, DataError) as error:
        _fail(str(error), EXIT_USAGE if isinstance(error, UsageError) else EXIT_FAILED, debug)
    except Exception as error:
        text = f"{type(error).__name__}: {error}".splitlines()[0]
        _fail(f"{text} (run with --debug for the traceback)", EXIT_FAILED, debug)
    sys.exit(0)


def program_name() -> str:
    """How the process was called, for usage messages."""
    stem = Path(sys.argv[0]).stem
    if stem in ("mgpo", "__main__"):
        return " ".join(["mgpo", *sys.argv[1:2]])
    return f"python -m experiments.{stem}"


def _fail(message: str, code: int, debug: bool) -> NoReturn:
    if debug:
        traceback.print_exc()
    print(f"error: {message}", file=sys.stderr)
    sys.exit(code)


def early_values(argv: Sequence[str], **flags: str) -> dict[str, str]:
    """The values of flags that decide which other flags there are.

    Args:
      argv: the words of the command line.
      **flags: defaults by name; a name like ``method__bandit`` stands for ``--method`` and ``--bandit``.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for names, default in flags.items():
        options = ["--" + name.replace("_", "-") for name in names.split("__")]
        parser.add_argument(*options, dest=names.split("__")[0], default=default, nargs="?")
    found, _ = parser.parse_known_args([word for word in argv if word != "--"])
    return {name: value or flags.get(name, "") for name, value in vars(found).items()}


def refuse_existing(folder: Path, *ways_out: str) -> None:
    """Raise ``UsageError`` with the ways out if an output folder exists."""
    if folder.exists():
        raise UsageError(f"{folder} exists already; {', or '.join(ways_out)}")
