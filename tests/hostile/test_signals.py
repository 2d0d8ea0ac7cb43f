"""Signals that ask a command to stop: finished work is kept, and one line says how to continue."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from .commands import COLLECT, LONG, PRETRAIN, WORLD, Reference
from .processes import Ended, Server, Trap

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
CASES = [(name, number) for name in LONG for number in STOPS]
QUICK = list(zip(LONG, STOPS, strict=True))


def assert_stopped(done: Ended, number: int) -> str:
    """Check how a command ended; returns its last line, which may be missing where nothing was done."""
    assert done.code == 128 + number, done.err
    for word in ("Traceback", "error:", "Error"):
        assert word not in done.err
    return done.lines[-1] if done.lines else ""


@pytest.mark.parametrize(
    ("name", "number"),
    [case if case in QUICK else pytest.param(*case, marks=pytest.mark.slow) for case in CASES],
)
def test_a_stopped_command_goes_on(
    server: Server, reference: Reference, here: Path, name: str, number: int
) -> None:
    long = LONG[name]
    done = server.run(long.line, here, Trap(reference.operations(name) // 2, number))
    assert "--resume" in assert_stopped(done, number)
    assert sum("--resume" in line for line in done.lines) == 1
    assert not (here / long.out / "policy").exists()
    done = server.again(long.resumed, here)
    assert done.code == 0, done.err
    reference.check(here, long)


@pytest.mark.parametrize("name", ["adapt", "collect"])
def test_stopped_before_anything_is_done_nothing_is_left(
    server: Server, reference: Reference, here: Path, name: str
) -> None:
    long = LONG[name]
    before = sorted(here.rglob("*"))
    done = server.run(long.line, here, Trap(3, signal.SIGTERM))
    text = assert_stopped(done, signal.SIGTERM)
    assert ("--resume" in text) == (sorted(here.rglob("*")) != before), text
    done = server.again(long.resumed if "--resume" in text else long.line, here)
    assert done.code == 0, done.err
    reference.check(here, long)


@pytest.mark.parametrize(
    "share",
    [0.02, *(pytest.param(share, marks=pytest.mark.slow) for share in (0.01, 0.05, 0.1, 0.2))],
)
def test_a_training_that_hardly_began_goes_on(
    server: Server, reference: Reference, here: Path, share: float
) -> None:
    trap = Trap(max(1, round(share * reference.operations("pretrain"))), signal.SIGTERM)
    done = server.run(PRETRAIN.line, here, trap)
    text = assert_stopped(done, signal.SIGTERM)
    done = server.again(PRETRAIN.resumed if "--resume" in text else PRETRAIN.line, here)
    assert done.code == 0, done.err
    reference.check(here, PRETRAIN)


@pytest.mark.slow
def test_a_second_signal_ends_at_once(server: Server, reference: Reference, here: Path) -> None:
    """Both arrive while the process is held up, so that it finds them together."""
    child = server.start(
        PRETRAIN.line, here, Trap(reference.operations("pretrain") // 2, signal.SIGSTOP)
    )
    child.wait_for(lambda: child.is_held)
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGCONT):
        child.send(number)
    done = child.wait()
    assert done.code in (130, 143)
    assert "Traceback" not in done.err
    assert "stopped at step" not in done.err
    done = server.again(PRETRAIN.resumed, here)
    assert done.code == 0, done.err
    reference.check(here, PRETRAIN)


@pytest.mark.parametrize(
    "seconds",
    [
        0.1,
        0.5,
        1.0,
        *(pytest.param(0.06 + 0.1 * n, marks=pytest.mark.slow) for n in range(30)),
    ],
)
def test_ctrl_c_during_imports_is_quiet(server: Server, here: Path, seconds: float) -> None:
    """Moments are CPU time since the start, which a busy machine does not shift."""
    child = server.from_scratch(COLLECT.line, here)
    child.wait_for(lambda: child.cpu_seconds >= seconds)
    begun = (here / "dataset.partial").exists()
    child.send(signal.SIGINT)
    start = time.monotonic()
    done = child.wait()
    begun = begun or (here / "dataset").exists()  # a few moments are enough to collect it all
    assert (done.code, done.out) == (130, "")
    assert begun or len(done.lines) <= 1, done.err
    assert "Traceback" not in done.err
    assert time.monotonic() - start < 5


def test_a_command_in_a_thread_leaves_signals_alone(
    server: Server, reference: Reference, here: Path
) -> None:
    done = server.run(COLLECT.line, here, thread="yes")
    assert done.code == 0, done.err
    reference.check(here, COLLECT)


def test_a_usage_error_in_a_thread_leaves_signals_alone(server: Server, here: Path) -> None:
    done = server.run(f"collect {WORLD} --trajectories 0", here, thread="yes")
    assert done.code == 2
    assert len(done.lines) == 1
