"""The script of docs/speed.md at its smallest size, on whatever device there is."""

from __future__ import annotations

import jax
import pytest

from .measure import adapt, rates


def test_rates() -> None:
    figures = {name: value for row in rates(size=16, large=16) for name, value in row.items()}
    assert len(figures) == 4
    assert all(value > 0 for value in figures.values()), figures


@pytest.mark.slow
def test_adapt_shows_wall_time_and_compiles_once() -> None:
    first, second = adapt("maze15", 1, seeds=1, episodes=1, eval_every=1, segments=1)
    assert first["compile, s"] > 100 * second["compile, s"]
    assert first["final return"] == second["final return"]
    # An episode of the search and two that judge, on each device.
    assert second["episodes / s"] * second["run, s"] == pytest.approx(3 * jax.device_count())
