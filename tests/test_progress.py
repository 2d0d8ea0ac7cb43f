"""The progress of long work, if stderr is not a terminal."""

from __future__ import annotations

import time

import pytest

from mgpo_jax import progress
from mgpo_jax.progress import Progress


def test_a_line_every_half_minute(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also while nothing is counted, as in the middle of a long program."""
    monkeypatch.setattr(progress, "EVERY", 0.05)
    with Progress(2000, "step", initial=500) as steps:
        steps.update(150)
        steps.show({"loss": "0.31"})
        time.sleep(0.4)
    time.sleep(0.2)
    lines = capsys.readouterr().err.splitlines()
    assert 3 <= len(lines) <= 9
    assert all(line.startswith("step 650 of 2,000 (32 %), loss 0.31, ") for line in lines)
    assert all(line.endswith(" left") for line in lines)


def test_what_a_line_says() -> None:
    steps = Progress(2000, "step", initial=500)
    steps.close()
    assert steps._line(steps._start + 30) == "step 500 of 2,000 (25 %)"
    steps.update(150)
    # 150 steps in 30 s leave 1,350 for 270 s
    assert steps._line(steps._start + 30) == "step 650 of 2,000 (32 %), 4 min 30 s left"


def test_short_work_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(0, "episode") as episodes:
        episodes.update(3)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0, "0 s"), (61.0, "1 min 1 s"), (7200.0, "2 h"), (90061.0, "25 h 1 min")],
)
def test_durations(seconds: float, text: str) -> None:
    assert progress._duration(seconds) == text
