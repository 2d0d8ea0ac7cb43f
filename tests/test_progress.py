"""What long work says where stderr is no terminal."""

from __future__ import annotations

import pytest

from mgpo_jax import progress
from mgpo_jax.progress import Progress


def test_a_line_every_half_minute(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with Progress(2000, "step", initial=500) as steps:
        for _ in range(10):
            now[0] += 10
            steps.update(50)
            steps.show({"loss": "0.31"})
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    # 150 steps in 30 s leave 1,350 for 270 s
    assert lines[0] == "step 650 of 2,000 (32 %), loss 0.31, 4 min 30 s left"
    assert lines[2].startswith("step 950 of 2,000 (48 %)")


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
