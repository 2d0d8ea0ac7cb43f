"""A report is never too large: pictures that have no room are left out first, then details in stages."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from made_results import TINY, made_results
from pages_data import config_of, data_of, saved

import experiments.pages.report as pages
from envs.errors import UsageError
from envs.maze import MAZE15
from envs.page import Page
from envs.registry import WORLDS
from experiments.pages.packing import unpacked
from experiments.pages.pictures import those_with_room
from experiments.pages.report import report, report_data
from experiments.pages.runs import LEFT_OUT, Detail
from experiments.store.result_files import load_results
from experiments.store.rows import read_row

ROOT = Path(__file__).parents[1]
DRAWN = replace(TINY, page=MAZE15.page)
TRACKED = replace(
    TINY,
    name="tracked",
    page=lambda env: Page(
        script=ROOT / "envs/crafter/page.js", track=lambda state: jnp.append(state.position, 250)
    ),
)
FILMED = replace(TINY, name="filmed")
STILL = replace(
    TINY,
    name="still",
    pictures=lambda env: MAZE15.pictures(env)._replace(video=None, frame=None),
)


@pytest.fixture(autouse=True)
def made_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    made, find = (
        {
            "tiny": DRAWN,
            "tracked": TRACKED,
            "filmed": FILMED,
            "still": STILL,
            "mine.py:WORLD": FILMED,
        },
        WORLDS.find,
    )
    known = WORLDS.known
    monkeypatch.setattr(WORLDS, "find", lambda name: made.get(name) or find(name))
    monkeypatch.setattr(WORLDS, "known", lambda name, *rest: made.get(name) or known(name, *rest))


@pytest.fixture
def tracked(tmp_path: Path) -> Path:
    """With what its optimizer knew, which is made up."""
    return saved(tmp_path / "tracked", made_results(config=config_of("tracked")))


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Calls that recompute what an optimizer knew."""
    calls: list[Any] = []

    def knowledge(results: Any) -> tuple[dict[str, np.ndarray], str]:
        calls.append(results)
        shape = results.returns.shape
        return {"arm": np.zeros(shape, np.uint8), "pulls": np.ones(shape, np.uint8)}, ""

    monkeypatch.setattr(pages, "_knowledge", knowledge)
    return calls


def arrays_in(data: Any) -> dict[str, np.ndarray]:
    return unpacked(data["runs"][0]["arrays"])


def test_each_stage_leaves_out_something_more(tracked: Path, known: list[Any]) -> None:
    del known
    found = {tracked: load_results(tracked)}
    arrays = [arrays_in(report_data(found, [read_row(tracked)], stage)) for stage in Detail]
    gone = [before.keys() - after.keys() for before, after in itertools.pairwise(arrays)]
    assert gone == [
        {"trackStride", "trackCounts", "track"},
        {"reachedCounts", "reachedSteps", "reachedGoals"},
        set(),
        {"arm", "pulls"},
        {"prompts", "choice", "best", "greedy"},
    ]
    assert [part["goals"].dtype for part in arrays] == [np.float32] * 3 + [np.float16] * 3
    np.testing.assert_allclose(arrays[3]["goals"], arrays[2]["goals"], atol=1e-3)
    assert len(arrays[2]["goals"]) < len(arrays[1]["goals"])  # those of prompts alone


@pytest.mark.parametrize("stage", list(Detail))
def test_a_page_leaves_out_as_little_as_has_to_be(
    stage: Detail, tracked: Path, known: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the optimizer knew is computed once, however many stages are tried."""
    results = load_results(tracked)
    sizes = {}
    for one in Detail:
        data = report_data({tracked: results}, [read_row(tracked)], one)
        sizes[one] = len(pages._page({**data, "pictures": []}, results).encode())
    # A note on what is left out needs room, too, so these small results do not shrink at every stage.
    monkeypatch.setattr(pages, "MOST_BYTES", sizes[stage])
    best = next(one for one in Detail if sizes[one] <= sizes[stage])
    known.clear()
    page = report([tracked])
    data = data_of(page)
    assert len(known) == 1
    assert data["withEpisodes"] == (best < Detail.NO_COURSES)
    assert (LEFT_OUT[Detail.NO_TRACKS] in "".join(data["notes"])) == (best >= Detail.NO_TRACKS)
    wanted = arrays_in(report_data({tracked: results}, [read_row(tracked)], best))
    assert arrays_in(data).keys() == wanted.keys()


def test_tracks_are_not_made_if_there_is_no_room_for_the_rest(
    tracked: Path, known: list[Any], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    del known

    def refuse(results: Any, page: Any) -> Any:
        raise AssertionError("tracks were made")

    monkeypatch.setattr("experiments.pages.runs.tracks_of", refuse)
    monkeypatch.setattr(pages, "MOST_BYTES", 1)
    data = data_of(report([tracked]))
    assert arrays_in(data).keys() == {"returns", "evalEpisodes", "evalReturns", "goals"}
    said = capsys.readouterr().err
    assert data["notes"][0] in said
    assert "cannot be made smaller" in said


def test_pictures_that_have_no_room_are_left_out_before_episodes(tmp_path: Path) -> None:
    folder = saved(tmp_path / "result", made_results(config=config_of("tiny")))
    for name in ("first", "second"):
        (folder / f"{name}.gif").write_bytes(b"GIF89a" + bytes(2_900_000))
    page = report([folder])
    data = data_of(page)
    assert len(page.encode()) <= 5_000_000
    assert data["withEpisodes"]
    assert "actions" in arrays_in(data)
    assert [picture["name"] for picture in data["pictures"]] == ["first"]
    assert data["notes"] == [
        "Left out, because the page would have more than 5 MB: the pictures second."
    ]


def test_a_small_picture_is_kept_behind_a_large_one() -> None:
    sizes = {"a": 900, "b": 900, "c": 9}
    pictures: list[Any] = [{"name": name, "source": "x" * n} for name, n in sizes.items()]
    kept, others = those_with_room(pictures, 1200)
    assert [picture["name"] for picture in kept] == ["a", "c"]
    assert others == ["b"]
    assert those_with_room(pictures, -1) == ([], ["a", "b", "c"])


def test_a_page_that_cannot_draw_a_world_says_how_to_get_pictures(tmp_path: Path) -> None:
    folder = saved(tmp_path / "filmed", made_results(config=config_of("filmed")))
    notes = data_of(report([folder]))["notes"]
    assert f"python -m experiments.plot {folder} --tasks 0 --out figures-of-report" in notes
    assert f"python -m experiments.report {folder} --pictures figures-of-report/*.gif" in notes
    own = saved(tmp_path / "own", made_results(config=config_of("mine.py:WORLD")))
    notes = data_of(report([own]))["notes"]
    flag = "--env mine.py:WORLD"
    assert f"python -m experiments.plot {own} {flag} --tasks 0 --out figures-of-report" in notes
    assert f"python -m experiments.report {own} {flag} --pictures figures-of-report/*.gif" in notes
    shutil.copy(ROOT / "docs/playground.png", folder.parent / "a.png")
    assert data_of(report([folder], [folder.parent / "a.png"]))["notes"] == []


def test_a_world_without_videos_is_told_no_command_for_them(tmp_path: Path) -> None:
    folder = saved(tmp_path / "still", made_results(config=config_of("still")))
    assert data_of(report([folder]))["notes"] == []


def test_a_video_in_a_folder_that_is_too_large_is_left_out(tmp_path: Path) -> None:
    folder = saved(tmp_path / "result", made_results(config=config_of("tiny")))
    (folder / "long.gif").write_bytes(b"GIF89a" + bytes(3_900_000))
    data = data_of(report([folder]))
    assert data["pictures"] == []
    assert "the pictures long" in data["notes"][0]
    with pytest.raises(UsageError, match=r"has 5\.2 MB as text in a page, which has 5 MB at most"):
        report([folder], [folder / "long.gif"])


@pytest.mark.slow
def test_a_search_in_which_each_prompt_has_many_goals_of_its_own() -> None:
    """BBT in Crafter: even without its episodes, the page would have 5.7 MB of arrays."""
    pytest.importorskip("craftax", reason="Crafter needs craftax")
    page = report([ROOT / "results/crafter-symbolic/bbt"])
    data = data_of(page)
    assert len(page.encode()) <= 5_000_000
    assert "half of the digits of goals" in data["notes"][0]
    assert {"prompts", "choice", "best"} <= arrays_in(data).keys()
