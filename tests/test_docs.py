"""The documentation: links, anchors and pictures exist, and the site builds if mkdocs is installed."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from conftest import TWO_DEVICES

import mgpo_jax

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
TOUR = ROOT / "docs" / "tour.py"
PICTURES_MAX = 400_000  # bytes of all pictures in the tour, as text
FENCED = re.compile(r"^```.*?^```[^\n]*$", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^()\s]+)\)")
PICTURE = re.compile(r"<(?:img|a)\b[^>]*(?:src|href)=\"([^\"]+)\"")


def hooks() -> ModuleType:
    spec = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs" / "hooks.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def links_of(text: str) -> list[str]:
    """The targets of all links and pictures outside of code."""
    prose = FENCED.sub("", text)
    prose = "\n".join(line for line in prose.splitlines() if not line.startswith("    "))
    return [*LINK.findall(prose), *PICTURE.findall(prose)]


def anchors_of(text: str) -> set[str]:
    """The anchors of all headings, as GitHub makes them."""
    seen: dict[str, int] = {}
    anchors = set()
    for line in FENCED.sub("", text).splitlines():
        if match := re.match(r"#{1,6} +(.*?)[ #]*$", line):
            words = re.sub(r"\]\([^)]*\)", "]", match[1]).lower()
            anchor = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
            count = seen[anchor] = seen.get(anchor, -1) + 1
            anchors.add(f"{anchor}-{count}" if count else anchor)
    return anchors


def faults_of(page: Path, text: str) -> Iterator[str]:
    """Every relative link of a page that leads nowhere."""
    for link in links_of(text):
        path, _, anchor = link.partition("#")
        if re.match(r"[a-z]+:", link):
            continue
        target = page.parent / path if path else page
        if not target.exists():
            yield f"{link}: no such file"
        elif anchor and target.suffix == ".md":
            there = text if target == page else target.read_text()
            if anchor not in anchors_of(there):
                yield f"{link}: no such heading"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_anchors_and_pictures_hold(page: Path) -> None:
    assert list(faults_of(page, page.read_text())) == []


def test_what_leads_nowhere_is_found() -> None:
    text = """# The worlds: `maze15`, and more

[a](docs/nothing.md) [`b`](#nothing) [c [d]](#the-worlds-maze15-and-more) <img width="3" src="docs/no.png">
[e](https://nowhere.example) [f](docs/plan.md#with-a-map) [g](docs/plan.md#with-a-mop)

    [indented](nothing.md)

```python
table[name](nothing)
# Heading
```

[h](#heading)
"""
    assert list(faults_of(ROOT / "README.md", text)) == [
        "docs/nothing.md: no such file",
        "#nothing: no such heading",
        "docs/plan.md#with-a-mop: no such heading",
        "#heading: no such heading",
        "docs/no.png: no such file",
    ]


def test_links_are_mended_for_the_site() -> None:
    change = hooks().links_in_site
    home = '[a](docs/plan.md#x) [b](https://x.y) [c](tests/own.py) [d](#e) <img src="docs/a.png">'
    want = '[a](plan.md#x) [b](https://x.y) c [d](#e) <img src="a.png">'
    assert change(home, "README.md") == want
    guide = "[a](../plan.md) [b](../../README.md) [`c`](../../mgpo_jax/x.py) [d](own-data.md)"
    want = "[a](../plan.md) [b](../index.md) `c` [d](own-data.md)"
    assert change(guide, "docs/guides/x.md") == want
    code = "```python\nf[a](docs/plan.md)\n```\n"
    assert change(code, "README.md") == code


def test_the_navigation_takes_what_there_is() -> None:
    pages = ["index.md", "guides/b.md", "guides/a.md", "speed.md", "new.md", "training.md"]
    assert hooks().navigation(pages) == [
        {"Home": "index.md"},
        {"Guides": ["training.md", "guides/a.md", "guides/b.md"]},
        {"Speed": "speed.md"},
        {"More": ["new.md"]},
    ]


def test_the_reference_has_every_public_name() -> None:
    site = hooks()
    pages = dict(site.reference())
    names = site.public_names()
    assert names.keys() == set(mgpo_jax.__all__)
    assert names["ucb"] == "mgpo_jax.optimizers.ucb.ucb"
    for place in names.values():
        module = place.rpartition(".")[0]
        page = module if module in site.MODULES else site.PACKAGE
        shown = module if module in site.MODULES else place
        assert f"::: {shown}\n" in pages[f"api/{page}.md"]


@pytest.mark.parametrize(
    "place",
    [
        "envs.gymnasium_world.GymnasiumWorld",
        "envs.live.Moment",
        "envs.to_gymnasium.WorldEnv",
        "envs.checks.check_world",
    ],
)
def test_the_reference_has_what_own_worlds_need(place: str) -> None:
    module, _, name = place.rpartition(".")
    assert f"::: {module}\n" in dict(hooks().reference())[f"api/{module}.md"]
    source = ROOT.joinpath(*module.split("."))
    path = source / "__init__.py" if source.is_dir() else source.with_suffix(".py")
    defined = [node for node in ast.parse(path.read_text()).body if hasattr(node, "name")]
    assert ast.get_docstring(next(node for node in defined if node.name == name))


def test_the_site_builds_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    needed = ("mkdocs", "material", "mkdocstrings_handlers")
    if any(importlib.util.find_spec(name) is None for name in needed):
        pytest.skip('mkdocs is not installed: pip install -e ".[docs]"')
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir"]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        [*command, str(tmp_path)], cwd=ROOT, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    loading = re.compile(
        r"<(?:script|img|iframe|link rel=\"stylesheet\")[^>]*\"(?:https?:)?//[^\"]*\""
    )
    for page in tmp_path.rglob("*.html"):
        if page.name != "playground.html":
            assert loading.findall(page.read_text()) == [], page
    assert (tmp_path / "guides" / "own-data.html").is_file()
    assert 'id="mgpo_jax.acting.Actor"' in (tmp_path / "api" / "mgpo_jax.html").read_text()


def cells_of(script: str) -> list[tuple[str, str]]:
    """Kind and source of the cells of a script in the percent format."""
    cells = []
    for part in re.split(r"^# %%", script, flags=re.MULTILINE)[1:]:
        head, _, body = part.partition("\n")
        if head.strip() == "[markdown]":
            body = re.sub(r"^# ?", "", body, flags=re.MULTILINE)
        cells.append(("markdown" if head.strip() else "code", body.strip()))
    return cells


def test_the_notebook_of_the_tour_is_that_of_its_script() -> None:
    notebook = json.loads(TOUR.with_suffix(".ipynb").read_text())
    found = [(cell["cell_type"], "".join(cell["source"]).strip()) for cell in notebook["cells"]]
    assert found == cells_of(TOUR.read_text()), "make it again; its first cell says how"


def test_the_notebook_has_its_outputs() -> None:
    notebook = json.loads(TOUR.with_suffix(".ipynb").read_text())
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
    assert not [output for output in outputs if output["output_type"] == "error"]
    pictures = [
        output["data"]["image/png"] for output in outputs if "image/png" in output.get("data", {})
    ]
    assert len(pictures) == 7
    assert sum(map(len, pictures)) < PICTURES_MAX
    text = hooks().tour_page(notebook)
    assert text.count("![what the code above draws](data:image/png;base64,") == 7
    assert "```text\ntarget (row, column)" in text
    assert list(faults_of(TOUR, text)) == []


@pytest.mark.parametrize(
    "methods",
    # Most of what the plan takes here is compilation.
    [["ucb"], pytest.param(["ucb", "plan"], marks=pytest.mark.slow)],
    ids=" ".join,
)
def test_the_tour_runs(methods: list[str]) -> None:
    env = {
        **os.environ,
        "TOUR_EPISODES": "4",
        "TOUR_METHODS": " ".join(methods),
        "XLA_FLAGS": os.environ["XLA_FLAGS"].replace(TWO_DEVICES, ""),  # one compiles less
        "MPLBACKEND": "Agg",
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, "-W", "error::DeprecationWarning:__main__", str(TOUR)]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("target (row, column):")
    assert [line.split(":")[0] for line in lines[2:]] == methods
