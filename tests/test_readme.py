"""The README's Python example runs as printed, and its tables are those of the results."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from experiments.store.paper import paper_value

README = Path(__file__).parent.parent / "README.md"


@pytest.mark.slow
def test_python_blocks_run() -> None:
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, str(README), "exec"), {})


def test_the_versions_of_jax_are_those_that_were_tried() -> None:
    """CONTRIBUTING.md has what ``.ci/versions`` found last."""
    tried = re.findall(
        r"[Ww]ith jax (\d+\.\d+\.\d+)", (README.parent / "CONTRIBUTING.md").read_text()
    )
    assert len(tried) == 2
    install = " ".join((README.parent / "docs/install.md").read_text().split())
    assert "versions that were tried are {} and {} (on".format(*tried) in " ".join(
        README.read_text().split()
    )
    for version in tried:
        assert f"jax {version}," in install


def test_every_linked_file_exists() -> None:
    links = re.findall(r"\]\(([^)#]+)\)|src=\"([^\"]+)\"", README.read_text())
    for link in {a or b for a, b in links}:
        if not link.startswith("http"):
            assert (README.parent / link).exists(), link


WORLDS = {
    "MazeRunner-15": "maze15",
    "MazeRunner-30": "maze30",
    "GridWorld": "gridworld",
    "Kitchen, reduced scene": "kitchen",
    "Kitchen, reduced scene, in MJX": "kitchen-mjx",
    "Kitchen, full scene": "kitchen-stock",
    "Crafter, seen as codes: fresh episodes": "crafter-symbolic",
    "Crafter, seen as pictures: fresh episodes": "crafter",
    "Crafter with goals that say where: fresh episodes": "crafter-map",
}


def cells_below(head: str) -> dict[str, list[str]]:
    """The cells of the table whose first row starts with ``head``, by the name of the world."""
    _, _, table = README.read_text().partition(head)
    rows = [line.strip("|").split("|") for line in table.partition("\n\n")[0].splitlines()[2:]]
    return {row[0].strip(): [cell.strip(" *") for cell in row[1:]] for row in rows}


def summary_of(world: str, method: str) -> dict[str, Any] | None:
    path = README.parent / "results" / world / method / "summary.json"
    return json.loads(path.read_text()) if path.exists() else None


def test_the_table_of_prompt_optimizers_is_that_of_the_results() -> None:
    table = cells_below("| world | initial prompt |")
    del table["Crafter, seen as codes: best single episode of 100"]
    assert set(table) == set(WORLDS)
    for name, (initial, *finals, optimum, paper) in table.items():
        world = WORLDS[name]
        for method, cell in zip(
            ("plan", "ucb", "bpe", "explore", "grips", "bbt"), finals, strict=True
        ):
            found = summary_of(world, method)
            assert (found is None) == (cell == ""), (world, method)
            if found is not None:
                assert abs(float(cell) - found["final_return"]) < 0.0051
                assert len(cell.partition(".")[2]) == 2 or cell == f"{found['final_return']:.3f}"
                assert initial == f"{found['initial_return']:.2f}"
        ucb = summary_of(world, "ucb")
        assert ucb is not None
        assert optimum == ("not known" if "crafter" in world else f"{ucb['optimal_return']:.3f}")
        assert paper in ("", paper_value("table2", world, "ucb").partition(" ")[0])


def test_the_table_of_baselines_is_that_of_the_results_and_of_the_paper() -> None:
    """Numbers in brackets are the paper's; an asterisk marks results with a single seed."""
    columns = {"gcbc": "ucb", "ppo": "ppo", "spirl": "spirl", "ptgm": "ptgm", "ucb": "ucb"}
    for name, cells in cells_below("| world | goal-conditioned BC |").items():
        world = WORLDS[name]
        for (row, method), cell in zip(columns.items(), cells, strict=False):
            found = summary_of(world, method)
            ours = ""
            if found is not None:
                value = found["initial_return" if row == "gcbc" else "final_return"]
                ours = f"{value:.2f}{'*' if found['num_seeds'] == 1 else ''} "
            assert cell == f"{ours}({paper_value('table1', world, row).partition(' ')[0]})"
        plan = summary_of(world, "plan")
        assert plan is not None
        assert cells[-1] == f"{plan['final_return']:.2f}"
