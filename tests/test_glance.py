"""Figure 11: every world that can be drawn has a panel, and the others are reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import envs
from envs.base import Episode
from envs.drawing import Pictures
from envs.errors import MissingExtraError, UsageError
from envs.registry import World
from experiments import glance
from experiments.figures import Glance, at_a_glance, look_of
from experiments.reproduce import main
from experiments.store.reproduce_settings import ReproduceConfig


def test_worlds_of_one_home_share_a_panel(capsys: pytest.CaptureFixture[str]) -> None:
    names = ("maze15", "kitchen", "kitchen-stock", "nowhere:WORLD", "kitchen-mjx")
    found = glance.worlds_together(names)
    assert [(world.name, others) for world, others in found] == [
        ("maze15", []), ("kitchen", ["kitchen-stock", "kitchen-mjx"]),
    ]  # fmt: skip
    assert "skipping nowhere:WORLD: cannot load the world" in capsys.readouterr().err


def test_a_world_is_drawn_by_the_first_still_that_it_offers() -> None:
    drawn: list[str] = []

    def never() -> Episode:
        raise AssertionError("an episode was played for nothing")

    def prompts(axes: list, tasks: list, by_color: list) -> None:
        drawn.append("prompts")
        assert (axes, tasks, by_color) == (["axes"], ["task"], [{}])

    goal = np.zeros(2, np.float32)
    start = lambda: np.zeros((4, 4, 3), np.uint8)  # noqa: E731
    look = look_of(Pictures(prompts=prompts, episodes=never), "task", goal, never, never)
    assert look is not None
    look("axes")  # type: ignore[arg-type]
    assert drawn == ["prompts"]
    framed = Pictures(frame=lambda obs: drawn.append("frame") or obs, prompts=prompts)
    look_of(framed, "task", goal, start, never)
    assert drawn == ["prompts", "frame"]
    assert look_of(Pictures(video=prompts), "task", goal, never, never) is None


@pytest.mark.parametrize(("num", "shape"), [(1, (1, 1)), (3, (1, 3)), (4, (2, 2)), (7, (3, 3))])
def test_panels_fill_their_rows(num: int, shape: tuple[int, int]) -> None:
    drawn: list[object] = []
    worlds = [Glance(f"world {i}", "What it is. " * 30, drawn.append) for i in range(num)]
    figure = at_a_glance(worlds)
    assert len(figure.subfigs) == shape[0] * shape[1]
    assert len(drawn) == num
    titles = [place.get_suptitle() for place in figure.subfigs]
    assert titles[:num] == [world.title for world in worlds]
    assert figure.get_figwidth() <= 7.4


def test_the_command_leaves_out_what_cannot_be_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing() -> None:
        raise MissingExtraError("it needs a package; install it")

    blind = World(name="blind", make=envs.find("maze15").make)
    absent = World(name="absent", make=missing)  # type: ignore[arg-type]
    worlds = [(envs.find("maze15"), []), (envs.find("gridworld"), []), (blind, []), (absent, [])]
    monkeypatch.setattr(glance, "worlds_together", lambda names: worlds)
    main(ReproduceConfig(what="figure11", out=tmp_path))
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "skipping blind: the world draws no pictures",
        "skipping absent: it needs a package; install it",
        str(tmp_path / "figure11.png"),
    ]
    assert (tmp_path / "figure11.png").stat().st_size > 10_000
    maze = envs.find("maze15")
    own = replace(maze, name="own")
    assert glance.glance_of(own).title == "own"  # a world by its place is not registered
    monkeypatch.setattr(glance, "worlds_together", lambda names: worlds[2:])
    with pytest.raises(UsageError, match="none of the worlds can be drawn"):
        main(ReproduceConfig(what="figure11", out=tmp_path))
