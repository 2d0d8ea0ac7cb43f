"""Requests to stop: Ctrl-C (SIGINT), SIGTERM, and SIGUSR1, which schedulers send before they kill.

A listener thread hears of a signal at once, even while the main thread is deep inside a compiled program.
What happens then depends on what the command is doing: by default the process cleans up and exits at once;
within ``asked_to_stop`` the command stops at its next chance. A second request always ends the process at
once. The exit code is 128 plus the signal's number.

If several processes run one command (``experiments.joining``), a request to one of them is passed on to
all. A scheduler or a terminal may signal each of them; those signals count as one request.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGUSR1") if hasattr(signal, name)
)

MOMENT = 1.0
"""Seconds that the main thread waits for the listener to end the process."""

GO_ON = "run the same command again to continue"
"""How to continue commands that skip what is finished, for messages."""


def kept() -> str:
    """The last words (``farewell``) of a command that skips what is finished when it is run again."""
    return f"stopped; finished work is kept; {GO_ON}"


class Stopped(KeyboardInterrupt):
    """Raised when a command stops because a signal asked it to; ``number`` is the signal's."""

    def __init__(self, message: str, number: int) -> None:
        super().__init__(message)
        self.number = number


class _Watch:
    """The signals received so far, and how to react to the next one."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Reset to the state before any signal and any command."""
        self.asked: list[int] = []
        self.times: Counter[int] = Counter()  # number of requests by the process that got them
        self.farewell: Callable[[], str] = lambda: ""
        self.tell: Callable[[int], None] = lambda number: None
        self.outlast: Callable[[], None] = lambda: None
        self.patient = False
        self.leaving = False

    def receive(self, number: int, process: int = 0) -> None:
        """React to a signal; returns at once, so that the next one can be received.

        Args:
          number: the signal's number.
          process: 0 if this process got the signal, another number for each other process.
        """
        self.asked.append(number)
        self.times[process] += 1
        again = self.times[process] > 1
        if self.leaving and again:
            os._exit(128 + number)
        elif self.patient and not again:
            if len(self.asked) == 1:
                _say(
                    "finishing the current step and saving a checkpoint; press Ctrl-C (or send the signal) "
                    "again to stop at once"
                )
        elif not self.leaving:
            self.leaving = True
            threading.Thread(target=self._leave, args=(number,), daemon=True).start()

    def _leave(self, number: int) -> None:
        """Print the farewell, clean up, and end the process, whatever it is doing."""
        from mgpo_jax.claims import clean_up

        try:
            if not self.patient and (text := self.farewell()):
                _say(text)
            clean_up()
            self.outlast()
        finally:
            os._exit(128 + number)


_watch = _Watch()


def _say(text: str) -> None:
    with suppress(OSError, ValueError):  # the reader may be gone
        print(f"\n{text}" if sys.stderr.isatty() else text, file=sys.stderr, flush=True)


@contextmanager
def watched() -> Iterator[None]:
    """Handle signals within the block. Outside the main thread, which alone can do so, nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _watch.forget()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    # Signals that the parent told us to ignore, as a script does for background jobs, stay ignored.
    heard = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, _hold) for number in heard}
    pipe_before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    listener = threading.Thread(target=_listen, args=(reading,), daemon=True)
    listener.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(pipe_before)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.write(writing, b"\0")  # ends the listener
        listener.join()
        os.close(writing)
        os.close(reading)
        _watch.forget()


def _hold(number: int, frame: FrameType | None) -> None:
    """Pause the main thread while the listener ends the process.

    Otherwise it could create a file after the listener has cleaned up. The pause is bounded because the
    main thread may hold a lock that the listener needs.
    """
    if not _watch.patient:
        time.sleep(MOMENT)


def _listen(reading: int) -> None:
    while number := os.read(reading, 1)[0]:
        if number in SIGNALS:
            _watch.tell(number)
            _watch.receive(number)


def tell_others(tell: Callable[[int], None], outlast: Callable[[], None]) -> None:
    """Set the hooks by which this process tells others of signals.

    Args:
      tell: called with the number of every signal that this process gets.
      outlast: called before a signal ends the process; waits for processes that must end before it.
    """
    _watch.tell, _watch.outlast = tell, outlast


def receive(number: int, process: int) -> None:
    """React to a signal that another process got; ``process`` is that process's number."""
    _watch.receive(number, 1 + process)


def is_leaving() -> bool:
    """Whether this process is about to end because of a signal."""
    return _watch.leaving


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], int]]:
    """Let the block choose when to stop.

    Yields a function that returns the number of the first signal received, or 0 if there was none.
    """
    _watch.patient = True
    try:
        yield lambda: _watch.asked[0] if _watch.asked else 0
    finally:
        _watch.patient = False


@contextmanager
def farewell(text: Callable[[], str]) -> Iterator[None]:
    """If a signal ends the process within the block, print ``text()`` on stderr unless it is empty."""
    before, _watch.farewell = _watch.farewell, text
    try:
        yield
    finally:
        _watch.farewell = before
