"""What every command line shares: process settings, parsing, errors and exit codes.

Settings that matter on a CPU, all in one place:

- One XLA device a core. The programs here are small; one on each core wastes less than one on all.
- The C library never gives memory back to the kernel: a gradient step frees and allocates hundreds of
  MB, and every page that comes back from the kernel costs a fault.
  One arena for all threads, as those of threads return their memory however they are set.
- jax's persistent compilation cache (``~/.cache/mgpo_jax``, or ``$MGPO_CACHE``): the second run of a
  command starts in seconds.
"""

from __future__ import annotations

import ctypes
import dataclasses
import json
import os
import platform
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, NoReturn

import tyro

from envs.base import Environment
from mgpo_jax.errors import DataError, UsageError

EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED = 1, 2, 130

# mallopt parameters of the GNU C library
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -2, -3, -8


@dataclass(frozen=True)
class Common:
    """Flags of every command."""

    debug: bool = False
    """Show the traceback of an error."""


def configure() -> None:
    """Set up the process; must run before jax touches a device."""
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

    import jax

    default = Path.home() / ".cache" / "mgpo_jax"
    jax.config.update("jax_compilation_cache_dir", os.environ.get("MGPO_CACHE", str(default)))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def jit_with(env: Environment) -> Callable[[Callable], Any]:
    """``jax.jit`` for programs that hold steps of a world."""
    import jax

    return jax.jit(compiler_options=dict(env.spec.compiler_options))


def run(
    config_class: type,
    main: Callable[[Any], None],
    default: Callable[[Sequence[str]], Any] | None = None,
) -> NoReturn:
    """Parse the command line into ``config_class`` and run ``main`` on it; exits.

    Exit codes: 0 done, 1 failed, 2 usage, 130 interrupted.

    Args:
      config_class: a frozen dataclass derived from ``Common``.
      main: the command.
      default: ``argv -> default config``, where defaults depend on other flags.
    """
    argv = sys.argv[1:]
    debug = "--debug" in argv
    try:
        configure()  # before a default asks jax for its devices
        values = {} if default is None else {"default": default(argv)}
        config = tyro.cli(config_class, args=argv, description=main.__doc__, **values)
        main(config)
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)
    except (UsageError, DataError) as error:
        _fail(str(error), EXIT_USAGE if isinstance(error, UsageError) else EXIT_FAILED, debug)
    except Exception as error:
        text = f"{type(error).__name__}: {error}".splitlines()[0]
        _fail(f"{text} (run with --debug for the traceback)", EXIT_FAILED, debug)
    sys.exit(0)


def _fail(message: str, code: int, debug: bool) -> NoReturn:
    if debug:
        traceback.print_exc()
    print(f"error: {message}", file=sys.stderr)
    sys.exit(code)


def peek(argv: Sequence[str], flag: str, fallback: str) -> str:
    """The value of ``--flag VALUE`` or ``--flag=VALUE``, before the command line is parsed."""
    for index, word in enumerate(argv):
        if word == f"--{flag}" and index + 1 < len(argv):
            return argv[index + 1]
        if word.startswith(f"--{flag}="):
            return word.split("=", 1)[1]
    return fallback


def refuse_existing(folder: Path, *ways_out: str) -> None:
    """Raise ``UsageError`` with the ways out if an output folder exists."""
    if folder.exists():
        raise UsageError(f"{folder} exists already; {', or '.join(ways_out)}")


def to_json(value: Any) -> Any:
    """Dataclasses, paths and numpy scalars as what ``json`` can write."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return value.item() if hasattr(value, "item") else value


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file that is never seen half written."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(to_json(value), indent=2) + "\n")
    partial.rename(path)


def versions() -> dict[str, str]:
    """Versions of what a result depends on, as far as it is installed."""
    required = ("mgpo-jax", "jax", "jaxlib", "flax", "optax", "evosax", "numpy")
    extras = ("mujoco", "mujoco-mjx", "gymnasium-robotics")
    found = {name: metadata.version(name) for name in required}
    for name in extras:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return {"python": platform.python_version(), **found}


def provenance() -> dict[str, Any]:
    """How and with what this process was started, for the run folder."""
    import jax

    try:
        here = Path(__file__).parent
        command = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
        commit = subprocess.run(command, cwd=here, capture_output=True, text=True, check=True)
        revision = commit.stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        revision = "unknown"
    return {
        "command": [Path(sys.executable).name, *sys.orig_argv[1:]],
        "revision": revision,
        "versions": versions(),
        "devices": [str(device) for device in jax.devices()],
        "cpu_count": os.cpu_count(),
    }
