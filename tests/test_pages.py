"""HTML pages as files: their content, inputs that are refused, and no markup from users' texts."""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from made_results import LUCKY, TINY, made_results
from pages_data import Elements, config_of, data_of, saved
from PIL import Image

from envs.errors import DataError, UsageError
from envs.gridworld import GRIDWORLD
from envs.maze import MAZE15
from envs.registry import WORLDS, World
from experiments.pages.build import SCRIPTS, Bundle, as_text, html, script_of
from experiments.pages.knowledge import NO_ARM, knowledge_of
from experiments.pages.packing import packed, smallest, unpacked
from experiments.pages.playground import world_data
from experiments.pages.report import report, report_data, report_of_run, write_report
from experiments.pages.worlds import page_of
from experiments.playground import PlaygroundConfig
from experiments.playground import main as playground_main
from experiments.report import ReportConfig
from experiments.report import main as report_main
from experiments.store.result_files import load_results
from experiments.store.results import Results
from experiments.store.rows import read_row
from experiments.store.seals import is_sealed
from mgpo_jax.methods import METHODS, Method
from mgpo_jax.policy_files import load_policy

ROOT = Path(__file__).parents[1]
HOSTILE = "</script><script>alert(1)</script><b onclick=x>&amp;\u2028"
DRAWN = replace(TINY, page=MAZE15.page)
PLAIN = replace(TINY, name="plain", pictures=None)


@pytest.fixture(autouse=True)
def made_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    made, find = {"tiny": DRAWN, "plain": PLAIN}, WORLDS.find
    monkeypatch.setattr(WORLDS, "find", lambda name: made.get(name) or find(name))


@pytest.fixture
def result(tmp_path: Path) -> Path:
    return saved(tmp_path / "result", made_results(config=config_of("tiny")))


def test_modules_are_joined_each_once_and_behind_what_they_import(tmp_path: Path) -> None:
    (tmp_path / "a.js").write_text(
        'import { b } from "./b.js";\nimport { c } from "./c.js";\nexport const a = b + c;\n'
    )
    (tmp_path / "b.js").write_text('import { c } from "./c.js";\nexport const b = c;\n')
    (tmp_path / "c.js").write_text("export const c = 1;\nexport function* d() {}\n")
    bundle = Bundle()
    assert bundle.add(tmp_path / "a.js") == bundle.add(tmp_path / "a.js")
    assert [bundle.source.index(f"const {n} =") for n in "cba"] == sorted(
        bundle.source.index(f"const {n} =") for n in "cba"
    )
    assert "return { c, d };" in bundle.source
    assert not re.search(r"^(import|export)\b", bundle.source, re.M)


@pytest.mark.parametrize(
    "source",
    [
        "export let a = 1;",
        "export default 1;",
        'import * as b from "./b.js";',
        'import { b as c } from "./b.js";',
        'import { a } from "./a.js";',
    ],
)
def test_other_module_syntax_is_refused(tmp_path: Path, source: str) -> None:
    (tmp_path / "a.js").write_text(source)
    (tmp_path / "b.js").write_text("export const b = 1;")
    with pytest.raises(ValueError, match=r"a\.js"):
        Bundle().add(tmp_path / "a.js")


def test_code_behind_a_comment_with_types_is_refused_and_other_comments_go(tmp_path: Path) -> None:
    """The comments are removed; nothing between two of them may go with them."""
    path = tmp_path / "a.js"
    path.write_text("/** One. */\nexport const a = /** @type {any} */ (1);\n/**\n * Two.\n */\n")
    bundle = Bundle()
    bundle.add(path)
    assert "const a = /** @type {any} */ (1);" in bundle.source
    assert "One" not in bundle.source
    assert "Two" not in bundle.source
    path.write_text("/** @type {number} */ const b = 1;\nconst c = b;\n/** Three. */\n")
    with pytest.raises(ValueError, match=r"a\.js: 'const b = 1;' must be on a line below"):
        Bundle().add(path)


def test_packed_arrays_come_back() -> None:
    rng = np.random.default_rng(0)
    arrays = {
        "a": rng.normal(size=(3, 4)).astype(np.float32),
        "b": rng.normal(size=5).astype(np.float16),
        "c": smallest(rng.integers(0, 300, (2, 0, 3))),
        "d": smallest(np.array([[70_000, 1]])),
        "e": smallest(np.array([255])),
    }
    found = unpacked(json.loads(as_text(packed(arrays))))
    assert {name: array.dtype for name, array in found.items()} == {
        name: array.dtype for name, array in arrays.items()
    }
    assert arrays["d"].dtype == np.uint32
    assert arrays["e"].dtype == np.uint8
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
    with pytest.raises(ValueError, match="float64"):
        packed({"a": np.zeros(1)})


def test_json_in_a_page_holds_no_markup() -> None:
    text = as_text({HOSTILE: [HOSTILE, 1.5, None]})
    assert json.loads(text) == {HOSTILE: [HOSTILE, 1.5, None]}
    assert not set("<>&\u2028") & set(text)
    with pytest.raises(ValueError, match="JSON"):
        as_text(float("nan"))


def test_the_policy_allows_the_own_script_and_style_and_nothing_else() -> None:
    page = html("<p>x</p>\n", script_of(SCRIPTS / "report.js", [None]), {"runs": []})
    elements = Elements(page)
    (policy,) = [a["content"] for a, _ in elements.of("meta") if a.get("http-equiv")]
    assert policy is not None
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert rules["img-src"] == "data:"
    scripts = [text for attrs, text in elements.of("script") if "type" not in attrs]
    for rule, contents in (("script-src", scripts), ("style-src", [elements.of("style")[0][1]])):
        (content,) = contents
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert rules[rule] == f"'sha256-{digest}'"
    loads = {"src", "href", "action", "style", "srcset"}
    assert not [
        attrs
        for _, attrs in elements.found
        if loads & attrs.keys() or any(n.startswith("on") for n in attrs)
    ]


@pytest.mark.parametrize("script", ["x = '</SCRIPT>'", "// <!-- <script>"])
def test_a_script_that_would_end_its_element_is_refused(script: str) -> None:
    with pytest.raises(ValueError, match="must not hold"):
        html("", script, {})


@pytest.mark.parametrize("name", ["report", "playground"])
def test_the_markup_has_every_element_that_the_script_asks_for(name: str) -> None:
    elements = Elements((SCRIPTS / f"{name}.html").read_text())
    ids = [attrs["id"] for _, attrs in elements.found if "id" in attrs]
    asked = set(re.findall(r'byId\("([\w-]+)"\)', (SCRIPTS / f"{name}.js").read_text()))
    asked |= set(re.findall(r'listen\("([\w-]+)"', (SCRIPTS / f"{name}.js").read_text()))
    assert len(set(ids)) == len(ids)
    assert asked - {"stage"} <= set(ids)
    labels = [attrs for tag, attrs in elements.found if tag == "input" and attrs["type"] == "range"]
    assert all("aria-label" in attrs or name == "playground" for attrs in labels)


def test_a_report_is_the_same_every_time_and_is_sealed(tmp_path: Path, result: Path) -> None:
    write_report([result], tmp_path / "a.html")
    write_report([result], tmp_path / "b.html")
    content = (tmp_path / "a.html").read_bytes()
    assert content == (tmp_path / "b.html").read_bytes()
    assert is_sealed(content, ".html")
    data = data_of(content.decode())
    assert data["world"]["facts"]["side"] == 7
    assert data["tasks"][1] == {
        "task": {"rows": [
            "#######", "#.....#", "#.#.#.#", "#.#...#", "#.....#", "#.#.#.#", "#######"
        ], "goal": [5, 1]},
        "text": "goal at row 5, column 1",
    }  # fmt: skip
    facts = dict(data["runs"][0]["facts"])
    assert facts["tasks x seeds x episodes"] == "2 x 2 x 20"
    assert facts["devices"] == f"{jax.device_count()} x cpu"


def test_an_adaptation_has_a_page_beside_its_pictures(
    result: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that was changed stays."""
    report_of_run(result)
    assert data_of((result / "report.html").read_text())["world"]["name"] == "tiny"
    (result / "report.html").write_text("<p>mine</p>")
    capsys.readouterr()
    report_of_run(result)
    assert (result / "report.html").read_text() == "<p>mine</p>"
    assert "is kept" in capsys.readouterr().err


def test_prompts_and_actions_in_a_report_are_those_of_the_results(result: Path) -> None:
    results = load_results(result)
    (run,) = report_data({result: results}, [read_row(result)])["runs"]
    arrays = unpacked(run["arrays"])
    coded, numbers, known = arrays["choice"].ravel(), [], 0
    for code in coded.tolist():
        numbers.append(code - 1 if code else known)
        known += not code
    for name, found in (("choices", numbers), ("best", arrays["best"].ravel().tolist())):
        part = getattr(results, name)
        where = np.ndindex(*part["prompt.mask"].shape[:3])
        for place, number in zip(where, found, strict=True):
            row = arrays["prompts"][number]
            goals = arrays["goals"][row[row > 0] - 1]
            np.testing.assert_array_equal(
                goals, part["prompt.goals"][place][part["prompt.mask"][place]]
            )
    assert arrays["actions"].tolist() == [2] * 4 * 80
    assert arrays["lengths"].tolist() == np.full((2, 2, 20), 4).tolist()


def test_a_world_without_a_page_has_times_of_its_goals(tmp_path: Path) -> None:
    folder = saved(tmp_path / "plain", made_results(config=config_of("plain")))
    data = data_of(report([folder]))
    arrays = unpacked(data["runs"][0]["arrays"])
    assert "actions" not in arrays
    assert arrays["reachedCounts"].sum() == len(arrays["reachedSteps"]) == 320
    np.testing.assert_allclose(
        arrays["goals"][arrays["reachedGoals"][:2]], np.array([(4, 3), (3, 3)]) / 7
    )
    assert data["tasks"][0] == {"task": None, "text": ""}
    assert "[null]" in report([folder])


def test_texts_of_files_enter_a_report_as_text(tmp_path: Path, result: Path) -> None:
    for name, change in (
        ("config.json", {"seed": 3, "hyper": {"c": HOSTILE}}),
        ("meta.json", {"command": [HOSTILE], "revision": HOSTILE, "versions": {"jax": HOSTILE}}),
    ):
        path = result / name
        path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    odd = tmp_path / "<script>alert(2)<"
    odd.mkdir()
    shutil.move(result, odd / "result")
    page = report([odd / "result"])
    assert len(Elements(page).of("script")) == 2
    assert not Elements(page).of("b")
    assert "<script>alert" not in page
    facts = dict(data_of(page)["runs"][0]["facts"])
    assert facts["revision"] == facts["command"] == HOSTILE
    assert "alert(2)" in facts["folder"]


def test_facts_of_a_world_judged_by_samples_tell_luck_from_what_is_reproducible(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, result: Path
) -> None:
    names = ("best single episode", "fresh", "fresh minus initial", "score", "goals achieved")
    facts = dict(data_of(report([result]))["runs"][0]["facts"])
    assert [facts[name] for name in names] == [""] * 5  # mazes are judged by one greedy episode
    monkeypatch.setattr(WORLDS, "find", lambda name: replace(LUCKY, pictures=None))
    achieved = np.full((2, 2, 2, 2), 0.5, np.float32)
    lucky = saved(
        tmp_path / "lucky", made_results(config=config_of("tiny"), eval_achieved=achieved)
    )
    facts = dict(data_of(report([lucky]))["runs"][0]["facts"])
    assert facts["best single episode"].startswith("-1.000 (of the search")
    assert facts["fresh"].startswith("-0.250 (the final return, of 4 sampled episodes")
    assert facts["fresh minus initial"] == "1.750 [1.500, 2.000] (95 % over tasks)"
    assert facts["score"].startswith("50.00 (initially 50.00; geometric mean")
    assert facts["goals achieved"] == "50.0 % of 2 (initially 50.0 %)"


def test_several_runs_are_compared_with_the_first(tmp_path: Path, result: Path) -> None:
    other = saved(
        tmp_path / "other", made_results("bpe", shift=0.25, config=config_of("tiny", "bpe"))
    )
    data = data_of(report([result, other, result]))
    assert [run["comparison"] != "" for run in data["runs"]] == [False, True]
    assert data["runs"][1]["comparison"].startswith("0.250")
    assert len({run["colors"]["light"][0] for run in data["runs"]}) == 2


def test_runs_on_other_tasks_are_refused(tmp_path: Path, result: Path) -> None:
    tasks = made_results().tasks
    changed = {**tasks, "goal": tasks["goal"][::-1]}
    other = saved(tmp_path / "other", made_results(tasks=changed, config=config_of("tiny")))
    with pytest.raises(UsageError, match="ran on different tasks"):
        report([result, other])


def test_pictures_and_videos_stand_below(tmp_path: Path, result: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(result, folder)
    image = Image.new("RGB", (4, 3), "red")
    image.save(folder / "task_0.gif", save_all=True, append_images=[Image.new("RGB", (4, 3))])
    image.save(tmp_path / "<b>.png")
    page = report([folder], [tmp_path / "<b>.png"])
    assert "<b>.png" not in page
    shown = data_of(page)["pictures"]
    assert [picture["name"] for picture in shown] == ["<b>", "task 0"]
    head, _, content = shown[1]["source"].partition(",")
    assert head == "data:image/gif;base64"
    assert base64.b64decode(content) == (folder / "task_0.gif").read_bytes()
    assert data_of(report([result]))["pictures"] == []


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.png", b"<svg>", "is not a picture that a page can show"),
        ("a.svg", b"<svg>", "is not a picture that a page can show"),
        ("a.gif", b"GIF89a" + bytes(4_000_000), "5.3 MB as text in a page, which has 5 MB at most"),
        ("none.gif", None, "cannot be read: No such file"),
    ],
)
def test_what_is_no_picture_is_refused(
    tmp_path: Path, result: Path, name: str, content: bytes | None, says: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(UsageError, match=says):
        report([result], [tmp_path / name])


def test_a_page_that_would_be_too_large_leaves_out_the_episodes(
    result: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("experiments.pages.report.MOST_BYTES", 1)
    data = data_of(report([result]))
    assert not data["withEpisodes"]
    assert "actions" not in unpacked(data["runs"][0]["arrays"])


@pytest.mark.parametrize(
    ("world", "method"),
    [
        *itertools.product(["maze15", "gridworld"], ["ucb", "bpe", "explore"]),
        ("crafter", "ucb"),  # its encoder prepares weights, which a replay does not have
    ],
)
def test_arms_are_those_of_an_adaptation(world: str, method: str) -> None:
    """Of published results: means are those of the returns, and rows follow the rules of Algorithm 1."""
    if world == "crafter":
        pytest.importorskip("craftax", reason="Crafter needs craftax")
    results = load_results(ROOT / "results" / world / method, parts=("choices",))
    part = few_tasks(results, 4)
    knowledge = knowledge_of(part)
    assert knowledge is not None
    rows, pulls, means = knowledge
    assert (pulls[:, :, 0] == 1).all()
    assert (rows[:, :, 0] == 0).all()
    for seed, task in np.ndindex(pulls.shape[:2]):
        history: dict[int, list[float]] = {}
        for episode, row in enumerate(rows[seed, task].tolist()):
            if row == NO_ARM:
                continue
            if pulls[seed, task, episode] == 1:
                history[row] = []
            history[row].append(float(part.returns[seed, task, episode]))
            assert len(history[row]) == pulls[seed, task, episode]
            assert np.mean(history[row]) == pytest.approx(means[seed, task, episode], abs=1e-4)


def test_an_arm_can_be_pulled_more_than_255_times() -> None:
    results = few_tasks(load_results(ROOT / "results/maze15/ucb", parts=("choices",)), 1)
    repeated = {
        name: np.repeat(array[:1, :, :1], 600, axis=2) for name, array in results.choices.items()
    }
    knowledge = knowledge_of(
        replace(results, returns=np.full((1, 1, 600), -1.0, np.float32), choices=repeated)
    )
    assert knowledge is not None
    pulls = knowledge.pulls[0, 0].tolist()
    assert pulls == sorted(pulls)
    assert pulls[-1] > 255


def test_searches_that_ended_early_are_not_taken_for_those_of_another_version() -> None:
    results = few_tasks(load_results(ROOT / "results/maze15/ucb", parts=("choices",)), 1)
    with pytest.raises(DataError, match="ended early"):
        knowledge_of(replace(results, config={**results.config, "stop_at": -0.2}))


def few_tasks(results: Results, num: int) -> Results:
    def cut(parts: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {name: array[:, :num] for name, array in parts.items()}

    return replace(
        results,
        tasks={name: array[:num] for name, array in results.tasks.items()},
        returns=results.returns[:, :num],
        choices=cut(results.choices),
        best=cut(results.best),
    )


def test_a_record_that_the_method_does_not_come_to_is_named(result: Path) -> None:
    """Made results have prompts that no search drew."""
    path = result / "config.json"
    config = json.loads(path.read_text())
    path.write_text(json.dumps({**config, "hyper": {"c": 1.0}}))
    (run,) = data_of(report([result]))["runs"]
    assert "another version" in run["note"]
    assert "arm" not in unpacked(run["arrays"])


def test_methods_without_arms_and_older_settings_have_none(result: Path) -> None:
    assert knowledge_of(load_results(result)) is None  # no hyper-parameters on record
    for method in ("bbt", "grips", "ppo", "reinforce-careful"):
        assert knowledge_of(few_tasks(load_results(ROOT / "results/maze15" / method), 1)) is None


def test_a_method_that_needs_weights_is_named(
    result: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page says why it does not show what the method knew, and shows everything else."""

    def make(setting: Any, params: Any, hyper: Any) -> Any:
        return params["weights"]

    method = Method(name="hungry", make=make, summary="needs weights")
    monkeypatch.setitem(METHODS._registered, "hungry", method)
    settings = {**config_of("tiny", "hungry"), "hyper": {}}
    (result / "config.json").write_text(json.dumps(settings))
    summary = json.loads((result / "summary.json").read_text())
    (result / "summary.json").write_text(
        json.dumps({**summary, "method": "hungry", "optimizer": "hungry"})
    )
    (run,) = data_of(report([result]))["runs"]
    assert "what hungry knew cannot be shown" in run["note"]
    assert "TypeError: 'NoneType' object is not subscriptable" in run["note"]
    assert "returns" in unpacked(run["arrays"])


def test_a_report_of_15_000_episodes_is_small() -> None:
    folder = ROOT / "results/maze15/ucb"
    page = report([folder])
    assert len(page) < 200_000
    arrays = unpacked(data_of(page)["runs"][0]["arrays"])
    assert arrays["lengths"].size == 15_000
    assert arrays["lengths"].sum() == len(arrays["actions"]) == 307_562


def test_a_playground_has_the_weights_in_half_precision() -> None:
    policy = load_policy(GRIDWORLD)
    data = world_data(GRIDWORLD, policy)
    weights, like = unpacked(data["weights"]), policy.params["params"]
    assert {array.dtype for array in weights.values()} == {np.dtype(np.float16)}
    kernel = np.asarray(like["blocks_0"]["query"]["kernel"])
    np.testing.assert_array_equal(weights["blocks_0/query/kernel"], kernel.astype(np.float16))
    assert len(data["tasks"]) == 50
    assert data["returnSpan"] == 1.0
    assert (data["deterministic"], data["keepRewarded"]) == (False, True)


def test_weights_that_half_precision_cannot_hold_are_refused() -> None:
    policy = load_policy(MAZE15)
    head = {**policy.params["params"]["head"], "bias": np.full(5, 1e5, np.float32)}
    params = {"params": {**policy.params["params"], "head": head}}
    with pytest.raises(UsageError, match="head/bias"):
        world_data(MAZE15, policy._replace(params=params))


def test_a_policy_that_the_page_cannot_run_is_refused() -> None:
    policy = load_policy(MAZE15)
    joint = replace(policy.config, tokens_per_step=1)
    with pytest.raises(UsageError, match=r"encoder linear and 1 token\(s\) per step"):
        world_data(MAZE15, policy._replace(config=joint))


def test_a_world_without_rules_has_no_playground() -> None:
    with pytest.raises(
        UsageError,
        match=r"no playground can be made of .*World\.page\) does not implement the rules",
    ):
        world_data(PLAIN, load_policy(MAZE15))
    assert page_of(World(name="none", make=PLAIN.make)).script is None


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (ReportConfig(), "no result folder"),
        (ReportConfig(runs=(Path("x"),), out=Path("report.txt")), "must end in .html"),
        (ReportConfig(runs=(Path("x"),), out=Path("no/where.html")), "there is no folder no"),
        (ReportConfig(runs=(Path("x"),), out=Path("mine.html")), "was not written by this command"),
        (PlaygroundConfig(env=()), "names no world"),
        (PlaygroundConfig(env=("maze15", "maze30"), policy=Path("x")), "page of one world"),
        (PlaygroundConfig(env=("maze51",)), "did you mean"),
        (PlaygroundConfig(out=Path("mine.html")), "was not written by this command"),
    ],
)
def test_requests_that_cannot_be_met_are_refused(
    config: Any, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.html").write_text("<p>mine</p>")
    run = report_main if isinstance(config, ReportConfig) else playground_main
    with pytest.raises(UsageError, match=re.escape(says)):
        run(config)
    assert Path("mine.html").read_text() == "<p>mine</p>"


def test_the_commands_write_and_replace_their_pages(
    tmp_path: Path, result: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        report_main(ReportConfig(runs=(result,)))
        playground_main(PlaygroundConfig())
    assert is_sealed(Path("playground.html").read_bytes(), ".html")
    assert data_of(Path("playground.html").read_text())["worlds"][0]["name"] == "maze15"


def test_the_documented_playground_is_of_today() -> None:
    """``docs/playground.html`` is built by a command; docs/pages.md says by which."""
    page = (ROOT / "docs/playground.html").read_text()
    data = data_of(page)
    names = [world["name"] for world in data["worlds"]]
    assert names == ["maze15", "gridworld", "maze30"]
    again = "build docs/playground.html again (docs/pages.md)"
    worlds = [WORLDS.find(name) for name in names]
    script = script_of(SCRIPTS / "playground.js", [page_of(world).script for world in worlds])
    assert f"<script>{script}</script>" in page, again
    assert f"<style>{(SCRIPTS / 'style.css').read_text()}</style>" in page
    assert (SCRIPTS / "playground.html").read_text() in page, again
    for world, kept in zip(worlds, data["worlds"], strict=True):
        today = json.loads(as_text(world_data(world, load_policy(world))))
        assert with_arrays(kept) == with_arrays(today), again


def with_arrays(data: dict[str, Any]) -> dict[str, Any]:
    """The data of a world with its arrays as bytes, since versions of zlib compress differently."""
    seen = data["seen"]
    arrays = unpacked(data["weights"]) | (unpacked(seen["goals"]) if seen else {})
    content = {name: (array.shape, array.tobytes()) for name, array in arrays.items()}
    return {**data, "weights": content, "seen": seen and seen["reach"]}


def test_the_scripts_are_well_typed() -> None:
    tsc = shutil.which("tsc")
    if tsc is None:
        pytest.skip("no tsc on the PATH checks the types of the JavaScript")
    done = subprocess.run(
        [tsc, "-p", ROOT / "experiments/pages"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout
