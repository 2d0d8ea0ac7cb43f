"""Requests to stop: the first signal, the second signal, and commands outside of the main thread."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from experiments import signals

HEAD = """
import os, signal, sys, time
from experiments import signals
def send(number):
    os.kill(os.getpid(), number)
    time.sleep(0.3)
"""


def outcome(body: str) -> tuple[int, str, str]:
    words = [sys.executable, "-c", HEAD + body]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGUSR1"])
def test_a_command_is_left_at_once(name: str) -> None:
    code, out, err = outcome(
        f"with signals.watched():\n    send(signal.{name})\nprint('not reached')"
    )
    assert (code, out, err) == (128 + getattr(signal, name), "", "")


def test_what_is_said_and_cleaned_up_on_leaving(tmp_path) -> None:
    code, out, err = outcome(
        f"""
from pathlib import Path
from mgpo_jax.files import new_folder
with signals.watched(), new_folder(Path({str(tmp_path / "new")!r})) as place:
    (place / "file").write_text("")
    with signals.farewell(lambda: "stopped; nothing is lost"):
        send(signal.SIGTERM)
"""
    )
    assert (code, out, err) == (143, "", "stopped; nothing is lost\n")
    assert list(tmp_path.iterdir()) == []


def test_a_patient_command_ends_when_it_likes() -> None:
    code, out, err = outcome(
        """
with signals.watched():
    with signals.asked_to_stop() as asked:
        print(asked(), flush=True)
        send(signal.SIGUSR1)
        print(asked() == signal.SIGUSR1, flush=True)
print("its own way", flush=True)
"""
    )
    assert (code, out) == (0, "0\nTrue\nits own way\n")
    asked = "finishing the current step and saving a checkpoint"
    again = "press Ctrl-C (or send the signal) again to stop at once"
    assert err == f"{asked}; {again}\n"


def test_the_second_request_ends_it() -> None:
    code, out, _ = outcome(
        """
with signals.watched(), signals.asked_to_stop():
    send(signal.SIGTERM)
    print("still there", flush=True)
    send(signal.SIGINT)
    print("not reached", flush=True)
"""
    )
    assert (code, out) == (130, "still there\n")


def test_nobody_reads_the_messages_any_more() -> None:
    """As when the program behind a pipe has ended; the signal counts all the same."""
    code, out, _ = outcome(
        """
reading, writing = os.pipe()
os.close(reading)
os.dup2(writing, 2)
with signals.watched(), signals.farewell(lambda: "stopped"):
    send(signal.SIGTERM)
    print("not reached", flush=True)
"""
    )
    assert (code, out) == (143, "")


def test_what_the_parent_ignores_stays_ignored() -> None:
    """Shells start background jobs of scripts so."""
    code, out, _ = outcome(
        """
signal.signal(signal.SIGINT, signal.SIG_IGN)
with signals.watched():
    send(signal.SIGINT)
    print("still there", flush=True)
"""
    )
    assert (code, out) == (0, "still there\n")


def test_the_main_thread_need_not_come_back() -> None:
    """A compiled program keeps it busy for minutes; here a lock that nobody opens does."""
    process = subprocess.Popen(
        [
            sys.executable,
            "-c",
            f"{HEAD}import threading\nwith signals.watched():\n    print('in', flush=True)\n"
            "    lock = threading.Lock()\n    lock.acquire()\n    lock.acquire()",
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "in\n"
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 130


def test_handlers_are_as_before() -> None:
    before = [signal.getsignal(number) for number in signals.SIGNALS]
    with signals.watched():
        assert [signal.getsignal(number) for number in signals.SIGNALS] != before
    assert [signal.getsignal(number) for number in signals.SIGNALS] == before


def test_a_thread_leaves_signals_alone() -> None:
    before = [signal.getsignal(number) for number in signals.SIGNALS]
    seen = []

    def work() -> None:
        with signals.watched(), signals.asked_to_stop() as asked:
            seen.append(([signal.getsignal(number) for number in signals.SIGNALS], asked()))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [(before, 0)]


def test_ctrl_c_while_importing(tmp_path) -> None:
    """Ctrl-C while a command is being imported ends it with 130 and without a traceback."""
    for wait in (0.3, 0.8, 1.6):
        process = subprocess.Popen(
            [sys.executable, "-m", "experiments.adapt", "--policy", str(tmp_path)],
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "MGPO_CACHE": str(tmp_path / "cache")},
        )
        time.sleep(wait)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
        # The command itself fails, as there is no policy; it may be over when the signal comes.
        assert process.returncode in (130, 2, -signal.SIGINT), err
        assert "Traceback" not in err
