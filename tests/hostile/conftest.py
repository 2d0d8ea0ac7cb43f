"""Fixtures: a process server for each worker of pytest; all share compiled programs and references."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.register_assert_rewrite("hostile.commands")

from .commands import LONG, Reference  # noqa: E402
from .processes import Server  # noqa: E402


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print the numbers of kills and of interrupted runs of each command."""
    runs: dict[str, list[int]] = {}
    for report in terminalreporter.getreports("passed") + terminalreporter.getreports("failed"):
        if report.when == "call":
            for name, kills in report.user_properties:
                if name in LONG:
                    runs.setdefault(name, []).append(kills)
    for name, kills in runs.items():
        terminalreporter.write_line(f"{name}: {sum(kills)} kills in {len(kills)} runs")


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all workers of a test run share."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "hostile"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def server(shared_folder: Path) -> Iterator[Server]:
    """A server that starts commands in their own processes."""
    server = Server(shared_folder / "cache")
    yield server
    server.close()


@pytest.fixture(scope="session")
def reference(server: Server, shared_folder: Path) -> Reference:
    """The results of uninterrupted long commands; one worker makes them for all."""
    reference = Reference(shared_folder / "reference")
    with open(shared_folder / "reference.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not reference.folder.exists():
            reference.make(server)
    return reference


@pytest.fixture
def here(server: Server, reference: Reference, tmp_path: Path) -> Iterator[Path]:
    """A current folder for commands, with a dataset and a policy; processes in it end with the test."""
    yield reference.furnish(tmp_path)
    server.end_all()
