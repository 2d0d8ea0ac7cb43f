"""One server of processes for each worker of pytest; compiled programs and references are shared by all."""

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
    """Say how many kills there were, in how many interrupted runs of each command."""
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
    """A folder that all workers of a test run have in common."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "hostile"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def server(shared_folder: Path) -> Iterator[Server]:
    """Starts commands in processes of their own."""
    server = Server(shared_folder / "cache")
    yield server
    server.close()


@pytest.fixture(scope="session")
def reference(server: Server, shared_folder: Path) -> Reference:
    """What the long commands make when nothing happens to them; one worker makes it for all."""
    reference = Reference(shared_folder / "reference")
    with open(shared_folder / "reference.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not reference.folder.exists():
            reference.make(server)
    return reference


@pytest.fixture
def here(server: Server, reference: Reference, tmp_path: Path) -> Iterator[Path]:
    """A current folder for commands, with a dataset and a policy; what runs there ends with the test."""
    yield reference.furnish(tmp_path)
    server.end_all()
