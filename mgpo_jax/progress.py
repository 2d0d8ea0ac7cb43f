"""Progress of long work on stderr: a bar on a terminal, otherwise a line every half minute."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType
from typing import Any

from tqdm import tqdm

EVERY = 30.0  # seconds between two lines if stderr is not a terminal


class Progress:
    """A progress display that counts ``unit``s up to ``total``, with figures next to the count.

    Args:
      total: the final count.
      unit: what is counted, such as ``step``.
      initial: the count at the start, for resumed work.
    """

    def __init__(self, total: int, unit: str, initial: int = 0) -> None:
        self._bar = tqdm(total=total, initial=initial, unit=unit, disable=None)
        self._total, self._unit, self._initial = total, unit, initial
        self._done, self._figures = initial, ""
        self._start = time.monotonic()
        self._closed = threading.Event()
        if self._bar.disable:
            threading.Thread(target=self._report, daemon=True).start()

    def _report(self) -> None:
        """Print lines until the work is done."""
        while not self._closed.wait(EVERY):
            print(self._line(time.monotonic()), file=sys.stderr, flush=True)

    def update(self, num: int = 1) -> None:
        """Count ``num`` more."""
        self._bar.update(num)
        self._done += num

    def show(self, figures: dict[str, str]) -> None:
        """Set the figures next to the count."""
        self._bar.set_postfix(figures)
        self._figures = "".join(f", {name} {value}" for name, value in figures.items())

    def _line(self, now: float) -> str:
        share = 100 * self._done / max(self._total, 1)
        text = f"{self._unit} {self._done:,} of {self._total:,} ({share:.0f} %){self._figures}"
        num_new = self._done - self._initial
        if not num_new:
            return text
        left = (now - self._start) / num_new * (self._total - self._done)
        return f"{text}, {_duration(left)} left"

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        del kind, error, trace
        self.close()

    def close(self) -> None:
        """End the bar, which leaves its last state on the terminal."""
        self._closed.set()
        self._bar.close()


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    parts: list[tuple[Any, str]] = [(hours, "h"), (minutes, "min"), (seconds, "s")]
    shown = [f"{number} {unit}" for number, unit in parts if number]
    return " ".join(shown[:2]) or "0 s"
