"""Ways to divide this machine among processes and devices, measured by starting the bench in each."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from envs.errors import DataError, UsageError, shown

LAYOUT = re.compile(r"([1-9]\d{0,2})x([1-9]\d{0,2})")
FORCED = "--xla_force_host_platform_device_count="


def check_layouts(layouts: Sequence[str], distributed: bool) -> None:
    """Raise ``UsageError`` for what is no layout, or where the processes are started by others."""
    if distributed:
        raise UsageError("--layouts starts its processes by itself; leave out --distributed")
    for layout in layouts:
        if not LAYOUT.fullmatch(layout):
            raise UsageError(
                f"--layouts needs words such as 2x1 (2 processes with 1 device each), found {shown(layout)}"
            )


def measured(layout: str, words: Sequence[str]) -> list[dict[str, Any]]:
    """The rows of ``experiments.bench`` with some flags, on the processes and devices of a layout.

    Where the cores of this machine are enough, each process has cores of its own.

    Raises:
      DataError: if a process fails; it has said why.
    """
    num, devices = (int(number) for number in layout.split("x"))
    flags = os.environ.get("XLA_FLAGS", "").split()
    flags = [word for word in flags if not word.startswith(FORCED)] + [f"{FORCED}{devices}"]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": " ".join(flags)}
    with tempfile.TemporaryDirectory() as place:
        path, running = Path(place) / "rows.json", []
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
        for number, cores in enumerate(_cores(num, devices)):
            own = ["--process", str(number)] if num > 1 else []
            process = subprocess.Popen([*command, *own], env=environment, stdout=subprocess.DEVNULL)
            running.append(process)
            if cores and hasattr(os, "sched_setaffinity"):
                os.sched_setaffinity(process.pid, cores)
        try:
            codes = [process.wait() for process in running]
        finally:
            for process in running:
                process.kill()
        if any(codes):
            raise DataError(f"the bench failed with the layout {layout}; the lines above say why")
        return json.loads(path.read_text())["rows"]


def _cores(num: int, devices: int) -> list[set[int]]:
    """The cores of each process; none where there are too few of them."""
    if not hasattr(os, "sched_getaffinity"):
        return [set()] * num
    cores = sorted(os.sched_getaffinity(0))
    if num * devices > len(cores):
        return [set()] * num
    return [set(cores[i * devices : (i + 1) * devices]) for i in range(num)]
