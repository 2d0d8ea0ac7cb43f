"""Two commands at once: in the same folder, or in need of the same dataset."""

from __future__ import annotations

import json
import re
import signal
import socket
from pathlib import Path

import pytest

from .commands import LONG, PRETRAIN, Reference
from .processes import Child, Ended, Server, Trap

COLLECTING = Trap(16, signal.SIGSTOP)
"""Holds a training up that collects its dataset first and has finished a batch of it."""


def hold(server: Server, line: str, folder: Path, at: int) -> Child:
    """A command that has done some of its operations and is held up before the next one."""
    child = server.start(line, folder, Trap(at, signal.SIGSTOP))
    child.wait_for(lambda: child.is_held)
    return child


def go_on(child: Child) -> Ended:
    child.send(signal.SIGCONT)
    done = child.wait()
    assert done.code == 0, done.err
    return done


@pytest.mark.parametrize(
    "name",
    ["collect", *(pytest.param(name, marks=pytest.mark.slow) for name in ("pretrain", "adapt"))],
)
def test_a_folder_has_one_process(
    server: Server, reference: Reference, here: Path, name: str
) -> None:
    """The second is told at once who works there, and the first is not disturbed."""
    long = LONG[name]
    first = hold(server, long.line, here, reference.operations(name) // 2)
    second = server.again(long.resumed, here)
    assert (second.code, len(second.lines)) == (1, 1), second.err
    assert re.match(rf"error: {long.out}\S* is in use by process ", second.err), second.err
    assert f"process {first.pid} on {socket.gethostname()}" in second.err
    second = server.again(long.line, here)  # which would be refused anyhow where a run has begun
    assert second.code in (1, 2)
    assert len(second.lines) == 1
    go_on(first)
    reference.check(here, long)


def test_a_training_is_told_who_trains_there(
    server: Server, reference: Reference, here: Path
) -> None:
    """And when that process is gone, so is its claim."""
    first = hold(server, PRETRAIN.line, here, 3)
    for line in (PRETRAIN.line, PRETRAIN.resumed):
        second = server.again(line, here)
        assert (second.code, len(second.lines)) == (1, 1), second.err
        assert f"error: run is in use by process {first.pid} on" in second.err
    first.send(signal.SIGKILL)
    assert first.wait().code == -signal.SIGKILL
    assert server.again(PRETRAIN.line, here).code == 0
    reference.check(here, PRETRAIN)


@pytest.mark.slow
def test_one_collects_what_two_want(server: Server, reference: Reference, here: Path) -> None:
    """The other one waits for the dataset, and both train."""
    data = here / "data"
    data.rename(here / "data_before")
    other = PRETRAIN.line.replace("--out run", "--out other")
    first = server.start(PRETRAIN.line, here, COLLECTING)
    first.wait_for(lambda: first.is_held)
    assert list(data.rglob("*.partial")), first.err
    second = server.start(other, here)
    second.wait_for(lambda: "waiting for process" in second.err)
    assert str(first.pid) in second.err
    done = go_on(first), second.wait()
    assert [end.code for end in done] == [0, 0], done[1].err
    assert ["CPU-seconds" in end.err for end in done] == [True, False]
    reference.check(here, PRETRAIN)
    weights = [here / run / "policy/weights.npz" for run in ("run", "other")]
    assert weights[0].read_bytes() == weights[1].read_bytes()
    manifests = [next((here / name).rglob("manifest.json")) for name in ("data", "data_before")]
    assert len({json.loads(path.read_text())["sha256"] for path in manifests}) == 1


@pytest.mark.slow
def test_who_waits_takes_over_from_one_that_is_killed(
    server: Server, reference: Reference, here: Path
) -> None:
    (here / "data").rename(here / "data_before")
    other = PRETRAIN.line.replace("--out run", "--out other")
    first = server.start(PRETRAIN.line, here, COLLECTING)
    first.wait_for(lambda: first.is_held)
    second = server.start(other, here)
    second.wait_for(lambda: "waiting for process" in second.err)
    first.send(signal.SIGKILL)
    done = second.wait()
    assert done.code == 0, done.err
    assert server.again(PRETRAIN.resumed, here).code == 0
    reference.check(here, PRETRAIN)


def test_who_waits_can_be_stopped(server: Server, reference: Reference, here: Path) -> None:
    (here / "data").rename(here / "data_before")
    other = PRETRAIN.line.replace("--out run", "--out other")
    first = server.start(PRETRAIN.line, here, COLLECTING)
    first.wait_for(lambda: first.is_held)
    second = server.start(other, here)
    second.wait_for(lambda: "waiting for process" in second.err)
    second.send(signal.SIGTERM)
    done = second.wait(10)
    assert done.code == 143
    assert "Traceback" not in done.err
    assert not (here / "other").exists()
    first.send(signal.SIGKILL)
    assert first.wait().code == -signal.SIGKILL
