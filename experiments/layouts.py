"""Run the bench on this machine divided among processes and devices in different ways."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from envs.errors import DataError, UsageError, shown
from mgpo_jax.claims import cleaned_on_exit

LAYOUT = re.compile(r"([1-9]\d{0,2})x([1-9]\d{0,2})")
FORCED = "--xla_force_host_platform_device_count="


def check_layouts(layouts: Sequence[str], distributed: bool) -> None:
    """Raise ``UsageError`` for words that are not layouts, or if ``--distributed`` is given, too."""
    if distributed:
        raise UsageError("--layouts starts its processes by itself; leave out --distributed")
    for layout in layouts:
        if not LAYOUT.fullmatch(layout):
            raise UsageError(
                f"--layouts needs words such as 2x1 (2 processes with 1 device each), found {shown(layout)}"
            )


def measured(layout: str, words: Sequence[str]) -> list[dict[str, Any]]:
    """The rows that ``experiments.bench`` measures with a layout.

    If this machine has enough cores, each process is pinned to cores of its own.

    Args:
      layout: number of processes and devices per process, such as ``2x1``.
      words: the other flags of the bench.

    Raises:
      DataError: if a process fails; it has printed the reason.
    """
    num, devices = (int(number) for number in layout.split("x"))
    flags = os.environ.get("XLA_FLAGS", "").split()
    flags = [word for word in flags if not word.startswith(FORCED)] + [f"{FORCED}{devices}"]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": " ".join(flags)}
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "rows.json"
        running: list[subprocess.Popen] = []
        command = [
            sys.executable,
            "-m",
            "experiments.bench",
            *words,
            "--quiet",
            "--json",
            str(path),
        ]
        if num > 1:
            with socket.create_server(("127.0.0.1", 0)) as free:
                port = free.getsockname()[1]
            command += [
                "--distributed",
                "--coordinator",
                f"127.0.0.1:{port}",
                "--processes",
                str(num),
            ]
        try:
            with cleaned_on_exit(partial(_end, running, place)):
                for number, cores in enumerate(_cores(num, devices)):
                    own = ["--process", str(number)] if num > 1 else []
                    process = subprocess.Popen(
                        [*command, *own], env=environment, stdout=subprocess.DEVNULL
                    )
                    running.append(process)
                    if cores and hasattr(os, "sched_setaffinity"):
                        os.sched_setaffinity(process.pid, cores)
                codes = [process.wait() for process in running]
        finally:
            _end(running)
        if any(codes):
            raise DataError(f"the bench failed with the layout {layout}; the lines above say why")
        return json.loads(path.read_text())["rows"]


def _end(running: Sequence[subprocess.Popen], place: str | None = None) -> None:
    """Kill processes that still run, and remove the folder that they write to."""
    for process in running:
        process.kill()
    if place is not None:
        shutil.rmtree(place, ignore_errors=True)


def _cores(num: int, devices: int) -> list[set[int]]:
    """The cores to pin each process to; empty sets if there are too few."""
    if not hasattr(os, "sched_getaffinity"):
        return [set()] * num
    cores = sorted(os.sched_getaffinity(0))
    if num * devices > len(cores):
        return [set()] * num
    return [set(cores[i * devices : (i + 1) * devices]) for i in range(num)]
