"""The playground under node, with a document that has no layout: what clicks, keys and loading do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pages_js import in_node, needs_node

from experiments.pages.build import SCRIPTS

ROOT = Path(__file__).parents[1]
MODULES = {
    "playground": SCRIPTS / "playground.js",
    "stages": SCRIPTS / "stage.js",
    "maze": ROOT / "envs/maze/page.js",
}
ROWS = ["#######", "#.....#", "#.#.#.#", "#.#...#", "#.....#", "#.#.#.#", "#######"]
TASK = {"rows": ROWS, "goal": [1, 5]}
FACTS = {"side": 7, "horizon": 12, "start": [5, 1], "stepPenalty": 0.1, "goalReward": 1.0}
STUB = """
// A policy that remembers its tokens and, like the real one, has room for one episode.
class Remembering {
  begin(goals) { this.tokens = goals.map((goal) => goal[0]); }
  read(token) {
    if (this.tokens.length >= 4 + 2 * data.facts.horizon) throw new RangeError("the cache is full");
    this.tokens.push(token);
  }
  observe(obs) {
    this.read(obs[0] + 2 * obs[1]);
    const sum = this.tokens.reduce((a, b) => 1.3 * a + b, 0);
    return Float32Array.from([0, 1, 2, 3, 4], (i) => Math.sin(i + sum));
  }
  act(action) { this.read(10 + action); }
}
const made = (name) => new stages.Stage(maze.world, {
  name, summary: "", facts: data.facts, tasks: [{ task: data.task, text: "" }],
  network: { action_dim: 5, max_prompt_length: 4 }, sha256: "0", returnSpan: 1, deterministic: true,
  keepRewarded: false,
}, new Remembering(), () => false);
const bars = () => $("bars").textContent;
const world = (name) => $("worlds").children.find((button) => button.attributes["data-world"] === name);
// The spot of a cell: the element of the stage has 100 units, a margin of 0.35 cells and 7 cells.
const at = (row, column) => ({
  clientX: ((column + 0.85) / 7.7) * 100, clientY: ((row + 0.85) / 7.7) * 100, button: 0, isPrimary: true,
});
const click = (row, column, more = {}) => $("stage").fire("click", { ...at(row, column), ...more });
const chips = () => $("chips").children.map((chip) => chip.textContent);
// Worlds of which the first is there at once, and each other one when ready[i] is called.
const ready = {};
const loading = (names) => async (i) => {
  if (i) await new Promise((resolve) => (ready[i] = resolve));
  return made(names[i]);
};
const begun = async (names = ["one", "two"], stageOf = async (i) => made(names[i])) => {
  for (const id of ["speed"]) $(id).value = "6";
  const page = new playground.Playground(names, stageOf);
  await page.begin();
  return page;
};
"""


def in_page(body: str) -> Any:
    return in_node(MODULES, STUB + body, {"facts": FACTS, "task": TASK}, with_document=True)


@needs_node
def test_a_policy_forgets_a_search_that_another_world_interrupted() -> None:
    """It acts on the episode that is shown, even if the search left an episode of full length behind."""
    before, after, steps = in_page("""
    await begun();
    const before = bars();
    $("find").fire("click");
    world("two").fire("click");
    await later(150);
    world("one").fire("click");
    await later();
    const after = bars();
    for (let i = 0; i < 12; i++) $("step").fire("click");
    return [before, after, $("verdict").textContent];
    """)
    assert after == before
    assert steps.startswith("Ended after")


@needs_node
def test_a_search_that_is_stopped_leaves_a_fresh_episode() -> None:
    chips, verdict, found = in_page("""
    await begun();
    $("find").fire("click");
    $("stop").fire("click");
    await later(150);
    return [chips(), $("verdict").textContent, $("found").textContent];
    """)
    assert chips[-1].endswith("(1, 5)")
    assert verdict.startswith("Ready")
    assert found.startswith("After ")


@needs_node
def test_goals_that_are_cleared_during_a_search_stay_cleared() -> None:
    before, after, found = in_page("""
    const page = await begun();
    page.setGoals([[1, 3]]);
    const before = chips().length;
    $("find").fire("click");
    $("clear").fire("click");
    await later(150);
    return [before, chips().length, $("found").textContent];
    """)
    assert (before, after, found) == (2, 1, "")


@needs_node
def test_the_world_that_was_clicked_last_is_shown_whichever_loads_first() -> None:
    title, pressed = in_page("""
    const names = ["one", "slow", "quick"];
    await begun(names, loading(names));
    world("slow").fire("click");
    world("quick").fire("click");
    ready[2]();
    await later();
    ready[1]();
    await later();
    return [document.title, $("worlds").children.map((button) => button.attributes["aria-pressed"])];
    """)
    assert title == "Playground: quick"
    assert pressed == ["false", "false", "true"]


@needs_node
def test_what_begins_while_a_world_loads_ends_when_it_is_there() -> None:
    """Neither playing nor a search goes over to the new world."""
    found = in_page("""
    const results = [];
    for (const begins of ["play", "find"]) {
      const names = ["one", "two"];
      const page = await begun(names, loading(names));
      world("two").fire("click");
      $(begins).fire("click");
      ready[1]();
      await later(200);
      results.push([document.title, page.timer, page.searching, page.stage.play.numSteps, chips().length]);
    }
    return results;
    """)
    assert found == [["Playground: two", 0, False, 0, 1]] * 2


@needs_node
def test_a_touch_that_scrolls_sets_no_goal_and_neither_does_another_button() -> None:
    """A goal is set by a click, which a finger that scrolls or pinches does not make."""
    found = in_page("""
    await begun();
    const counts = [];
    $("stage").fire("pointerdown", at(4, 4));
    $("stage").fire("pointercancel", at(1, 4));
    counts.push(chips().length);
    click(4, 4, { button: 2 });
    counts.push(chips().length);
    click(4, 4);
    counts.push(chips().length);
    return counts;
    """)
    assert found == [1, 1, 2]


@needs_node
def test_only_the_first_finger_paints_and_a_fast_one_skips_no_cell() -> None:
    rows, others = in_page("""
    const page = await begun();
    page.setMode(1); // draws walls
    $("stage").fire("pointerdown", { ...at(4, 1), isPrimary: false });
    $("stage").fire("pointerdown", { ...at(4, 1), button: 2 });
    const others = page.stage.task.rows[4];
    $("stage").fire("pointerdown", at(4, 1));
    $("stage").fire("pointermove", at(4, 5));
    $("stage").fire("pointerup", at(4, 5));
    $("stage").fire("pointermove", at(1, 1));
    click(4, 5); // the browser sends it behind every press
    return [page.stage.task.rows, others];
    """)
    assert others == "#.....#"
    assert rows == [*ROWS[:4], "#######", *ROWS[5:]]


@needs_node
def test_a_screen_reader_is_told_what_is_at_the_cursor() -> None:
    said = in_page("""
    const page = await begun();
    const said = [];
    page.announce = (text) => said.push(text); // which waits otherwise
    for (const key of ["ArrowUp", "ArrowUp", "ArrowLeft", "Enter"]) $("stage").fire("keydown", { key });
    page.stage.cursor = { row: 1, column: 4 };
    for (const key of ["ArrowRight", "ArrowDown"]) $("stage").fire("keydown", { key });
    return said;
    """)
    assert said == [
        "Row 2, column 3: free", "Row 1, column 3: free", "Row 1, column 2: free",
        "Row 1, column 2: free, goal 1 of the prompt",
        "Row 1, column 5: target", "Row 2, column 5: free",
    ]  # fmt: skip


@needs_node
def test_texts_are_announced_at_most_about_once_a_second() -> None:
    """The first at once, and the last of those that came meanwhile."""
    pace = {"pace": SCRIPTS / "pace.js"}
    said = in_node(pace, """
    const said = [], say = pace.paced((text) => said.push(text), 60);
    for (let i = 0; i < 9; i++) say(i);
    await later(20);
    say(9);
    await later(200);
    say(10);
    const written = [], write = pace.settled((text) => written.push(text), 60);
    for (let i = 0; i < 9; i++) write(i);
    await later(200);
    return [said, written];
    """, with_document=True)  # fmt: skip
    assert said == [[0, 9, 10], [8]]
    markup = (SCRIPTS / "playground.html").read_text()
    assert markup.count('role="status"') == 2
    assert "aria-live" not in markup
