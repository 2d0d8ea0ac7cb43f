"""The pages in Chromium: clicks, keyboard, a phone, dark mode; never a network request or an error.

Needs playwright (extra ``browser``) and a system Chromium. Screenshots are written to the folder
``$MGPO_SHOTS`` if that is set; ``docs/playground.png`` is one of them.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import envs
from experiments.pages.playground import playground
from experiments.pages.report import report

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="no Chromium on the PATH"),
]
ROOT = Path(__file__).parents[1]
SCREENS = [(1280, "light"), (1280, "dark"), (390, "light"), (390, "dark")]
MARGIN = 0.35  # cells around a drawing
READY_SECONDS = (
    5.0  # until a page can be used; a bound for a busy machine, docs/pages.md has measured times
)
SWIPE = """
// A finger that scrolls: the browser takes the gesture over, so that there is no click.
const stage = document.getElementById("stage"), box = stage.getBoundingClientRect();
const at = { clientX: box.x + box.width / 2, clientY: box.y + box.height / 2, isPrimary: true };
for (const type of ["pointerdown", "pointercancel"])
  stage.dispatchEvent(new PointerEvent(type, { ...at, bubbles: true, pointerType: "touch" }));
"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Reports of two runs, of a plan with a map or an order, and of a kitchen, and a playground."""
    folder = tmp_path_factory.mktemp("pages")
    made = {
        "report": report([ROOT / "results/maze15/ucb", ROOT / "results/maze15/bpe"]),
        "map": report([ROOT / "results/maze15/plan"]),
        "order": report([ROOT / "results/gridworld/plan"]),
        "timeline": report([ROOT / "results/kitchen-stock/ucb"]),
        "playground": playground([envs.find("maze15"), envs.find("gridworld")]),
    }
    for name, page in made.items():
        (folder / f"{name}.html").write_text(page)
    return {name: folder / f"{name}.html" for name in made}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield chromium
        chromium.close()


class Screen:
    """A page that is open, with what went wrong in it."""

    def __init__(self, browser: Any, path: Path, width: int, scheme: str, hash_: str = "") -> None:
        phone = width < 600
        context = browser.new_context(
            viewport={"width": width, "height": 844},
            color_scheme=scheme,
            offline=True,
            is_mobile=phone,
            has_touch=phone,
        )
        self.page, self.wrong = context.new_page(), []
        self.name = f"{path.stem}_{width}_{scheme}"
        self.page.on("console", lambda said: self.wrong.append(said.text))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("request", lambda request: self.wrong.append(request.url))
        self.page.goto(path.as_uri() + hash_)
        self.wrong = self.wrong[1:]  # the page itself
        self.until("document.body.dataset.ready === 'yes'")

    def until(self, condition: str) -> None:
        """Wait; the page's policy forbids playwright's own waiting, which evaluates text in the page."""
        for _ in range(1200):
            if self.page.evaluate(condition):
                return
            time.sleep(0.1)
        raise AssertionError(f"never: {condition}")

    def text(self, id_: str) -> str:
        return self.page.inner_text(f"#{id_}")

    def point(self, row: int, column: int, side: int = 15) -> tuple[float, float]:
        """Where a cell of the stage is on the screen."""
        box = self.page.locator("#stage").bounding_box()
        unit = box["width"] / (side + 2 * MARGIN)
        at = (column + 0.5 + MARGIN, row + 0.5 + MARGIN)
        return box["x"] + at[0] * unit, box["y"] + at[1] * unit

    def check(self) -> None:
        """Nothing went wrong, nothing was asked for, and nothing scrolls sideways."""
        widths = self.page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
        assert widths[0] <= widths[1] <= self.page.viewport_size["width"]
        if folder := os.environ.get("MGPO_SHOTS"):
            self.page.screenshot(path=Path(folder) / f"{self.name}.png", full_page=True)
        assert self.wrong == []


@pytest.mark.parametrize("name", ["report", "playground", "map", "order", "timeline"])
@pytest.mark.parametrize(("width", "scheme"), SCREENS)
def test_every_screen(
    browser: Any, pages: dict[str, Path], name: str, width: int, scheme: str
) -> None:
    Screen(browser, pages[name], width, scheme).check()


@pytest.mark.parametrize("name", ["report", "playground", "map", "order", "timeline"])
def test_a_page_is_ready_soon(browser: Any, pages: dict[str, Path], name: str) -> None:
    """Measured from the beginning of the navigation; the shortest of three times is printed."""
    times = []
    for _ in range(3):
        screen = Screen(browser, pages[name], 1280, "light")
        times.append(screen.page.evaluate("performance.getEntriesByName('ready')[0].startTime"))
    size = pages[name].stat().st_size / 1e6
    print(f"{name}: {size:.2f} MB, ready after {min(times) / 1000:.2f} seconds")
    assert min(times) < 1000 * READY_SECONDS


def test_the_picture_in_the_documentation(browser: Any) -> None:
    """Three goals by which a policy reaches the target of a maze: ``docs/playground.png``."""
    screen = Screen(browser, ROOT / "docs/playground.html", 1180, "light")
    screen.page.set_viewport_size({"width": 1180, "height": 730})
    screen.page.select_option("#task", "7")
    for cell in ((10, 7), (10, 4), (8, 3)):
        screen.page.mouse.click(*screen.point(*cell))
    screen.page.locator("#speed").fill("6")
    screen.page.click("#play")
    screen.until("document.getElementById('verdict').textContent.startsWith('Ended')")
    screen.page.locator("#speed").fill("4")
    assert screen.text("verdict") == "Ended after 13 steps: return -0.30 (optimum -0.10)"
    assert screen.wrong == []
    if folder := os.environ.get("MGPO_SHOTS"):
        screen.page.mouse.move(0, 0)
        screen.page.evaluate("document.activeElement.blur()")
        screen.page.screenshot(path=Path(folder) / "playground.png")


def test_a_finger_that_scrolls_sets_no_goal(browser: Any, pages: dict[str, Path]) -> None:
    screen = Screen(browser, pages["playground"], 390, "light")
    screen.page.evaluate(f"() => {{ {SWIPE} }}")
    assert screen.page.locator("#chips .chip").count() == 1
    screen.page.touchscreen.tap(*screen.point(10, 4))
    assert screen.page.locator("#chips .chip").count() == 2
    screen.check()


def test_a_report_is_stepped_through(browser: Any, pages: dict[str, Path]) -> None:
    screen = Screen(browser, pages["report"], 1280, "light", "#19,1,60")
    assert screen.text("stage-title") == "Task 19, seed 1, episode 60"
    screen.page.keyboard.press("ArrowLeft")
    screen.page.click("#back")
    assert screen.text("stage-title") == "Task 19, seed 1, episode 58"
    screen.until("location.hash === '#19,1,58'")  # the address follows a moment later
    screen.page.click("#tasks button[data-task='3']")
    screen.page.select_option("#run", "1")
    screen.until("location.hash === '#3,1,58,1'")
    screen.page.check("#visits")
    assert screen.page.locator("#arms tbody tr").count() > 0
    screen.page.select_option("#sort", label="regret, largest first")
    first = screen.page.locator("#tasks button").first.get_attribute("aria-label")
    assert "solved" not in first
    screen.page.focus("#curves svg")
    screen.page.keyboard.press("ArrowLeft")
    assert "episode 90: MGPO-UCB -0.2" in screen.text("curves")
    screen.check()


@pytest.mark.parametrize("hash_", ["#999,-3,x", "#", "#1,2", "#<b>,1,1", "#1e9,1e9,1e9,1e9"])
def test_odd_addresses_show_what_there_is(browser: Any, pages: dict[str, Path], hash_: str) -> None:
    screen = Screen(browser, pages["report"], 1280, "light", hash_)
    assert screen.text("stage-title").startswith("Task ")
    screen.check()


def test_a_policy_is_led_by_clicks(browser: Any, pages: dict[str, Path]) -> None:
    screen = Screen(browser, pages["playground"], 1280, "light")
    for cell in ((10, 4), (7, 4)):
        screen.page.mouse.click(*screen.point(*cell))
    assert screen.page.locator("#chips .chip").all_inner_texts()[:2] == ["1\n(10, 4)", "2\n(7, 4)"]
    screen.page.locator("#speed").fill("6")
    screen.page.click("#play")
    screen.until("document.getElementById('verdict').textContent.startsWith('Ended')")
    screen.page.click("text=Draw walls")
    screen.page.mouse.move(*screen.point(11, 1))
    screen.page.mouse.down()
    screen.page.mouse.move(*screen.point(11, 5), steps=10)
    screen.page.mouse.up()
    screen.page.click("#undo")
    assert screen.page.locator("#chips .chip").count() == 2
    screen.page.select_option("#task", "13")
    assert screen.page.locator("#chips .chip").count() == 1
    screen.check()


def test_a_policy_is_led_by_keys(browser: Any, pages: dict[str, Path]) -> None:
    screen = Screen(browser, pages["playground"], 1280, "dark")
    screen.page.focus("#stage")
    for key in ("ArrowUp", "ArrowUp", "ArrowLeft", "Enter", "ArrowUp", " "):
        screen.page.keyboard.press(key)
    assert screen.page.locator("#chips .chip").all_inner_texts()[:2] == ["1\n(5, 6)", "2\n(4, 6)"]
    screen.page.keyboard.press("Backspace")
    assert screen.page.locator("#chips .chip").count() == 2
    assert "Agent at row 13, column 7" in screen.page.get_attribute("#stage", "aria-label")
    screen.check()


def test_a_prompt_is_found_in_the_page(browser: Any, pages: dict[str, Path]) -> None:
    screen = Screen(browser, pages["playground"], 390, "light")
    screen.page.tap("#fresh")
    screen.page.tap("#find")
    screen.until("document.getElementById('found').textContent.startsWith('After 100 episodes')")
    screen.page.tap("[data-world=gridworld]")
    screen.until("document.title === 'Playground: gridworld'")
    screen.page.tap("#step")
    assert screen.text("verdict").startswith("1 step")
    screen.check()
