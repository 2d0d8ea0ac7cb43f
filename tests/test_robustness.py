"""Table 3: published rows of the same adaptation are used, the others are measured once."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from envs.errors import DataError, UsageError
from experiments import comparisons, reproduce, robustness
from experiments.comparison_tables import Compared
from experiments.comparisons import Cell
from experiments.evaluation import Noise
from experiments.robustness import Behind, Row
from experiments.store.reproduce_settings import ReproduceConfig
from experiments.store.summary import read_summary
from mgpo_jax import processes

CONFIG = ReproduceConfig(what="table3", env=("kitchen",), only=("ucb",))
UCB = Path("results/kitchen/ucb").absolute()


def test_published_rows_are_those_of_the_same_adaptation(tmp_path: Path) -> None:
    config = replace(CONFIG, out=tmp_path)
    cell = Cell("kitchen", "ucb", UCB)
    found = robustness.known(config, cell, Noise(obs=0.03))
    assert found is not None
    assert (found.return_, found.episodes) == (pytest.approx(0.862, abs=1e-3), 4)
    assert found.change == pytest.approx(found.return_ - found.adapted)
    assert robustness.known(config, cell, Noise(obs=0.04)) is None
    assert robustness.known(replace(config, scale="smoke"), cell, Noise(obs=0.03)) is None
    other = Cell("kitchen", "ucb", UCB.with_name("bpe"))  # another final return
    assert robustness.known(config, other, Noise(obs=0.03)) is None


def measured(noise: Noise, **changes: Any) -> dict[str, Any]:
    """A row as ``evaluate_cases`` gives it, of the published adaptation."""
    final = read_summary(UCB)["final_return"]
    row = {
        "env": "kitchen", "optimizer": "ucb", "num_tasks": 25, "num_seeds": 3, "episodes": 4,
        "obs_noise": noise.obs, "action_noise": noise.action, "adapted": final, "return": final - 0.5,
        "std_over_seeds": 0.01, "change": -0.5, "failed_episodes": 0, "num_episodes": 300,
    }  # fmt: skip
    return {**row, **changes}


@pytest.fixture
def unpublished(monkeypatch: pytest.MonkeyPatch) -> list[Noise]:
    """The adaptation is there and no row of it; returns the noises that were measured."""
    asked: list[Noise] = []

    def opened(folder: Path, env: None, sizes: Sequence[Noise]) -> Any:
        if sizes[0].obs == "official":
            raise UsageError("this world has no official implementation")
        return sizes[0]

    def evaluated(cases: Sequence[Any], episodes: int, seed: int) -> Iterator[dict[str, Any]]:
        for noise in cases:
            asked.append(noise)
            yield measured(noise)

    monkeypatch.setattr(robustness, "published_rows", lambda world: ())
    monkeypatch.setattr(robustness, "open_case", opened)
    monkeypatch.setattr(robustness, "evaluate_cases", evaluated)
    monkeypatch.setattr(robustness, "made", lambda config, world, name: Cell(world, name, UCB))
    return asked


def test_missing_rows_are_measured_once(unpublished: list[Noise], tmp_path: Path) -> None:
    config = replace(CONFIG, out=tmp_path)
    text = robustness.compare(config).text
    assert unpublished == [*robustness.SIZES[1:]]  # all that this world has
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in text.splitlines()
        if line.startswith("| kitchen")
    ]
    assert [row[2] for row in rows] == [str(noise) for noise in robustness.SIZES]
    official, weak, *_, strong = rows
    assert official[3:] == ["0.49 (-0.14)", *["-"] * 5]
    assert "- kitchen: this world has no official implementation" in text
    assert strong[3] == "0.30 (-0.33)"  # the paper's number for actions
    assert weak[4:6] == ["0.433 ± 0.010", "-0.500"]
    assert float(weak[6]) == pytest.approx(0.433 - 0.49, abs=1e-3)
    assert weak[7] == "25 x 3 x 4"
    assert (tmp_path / "table3-cpu.md").read_text().startswith(text)

    place = robustness.place_of_row(config, Cell("kitchen", "ucb", UCB), Noise(action=0.1))
    place.unlink()
    unpublished.clear()
    again = robustness.compare(config).text
    assert unpublished == [Noise(action=0.1)]
    assert again.splitlines()[:10] == text.splitlines()[:10]


@pytest.mark.parametrize("index", [0, 1])
def test_processes_share_the_measurements(
    index: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each measures the rows of its cells, as if it were alone, and process 0 makes the table."""
    measured: list[tuple[str, str, int]] = []
    tables: list[int] = []

    def rows_of(config: ReproduceConfig, world: str, method: str) -> list[Row]:
        measured.append((world, method, processes.count()))
        return [Row(world, method, Noise(), None)]

    def compare(config: ReproduceConfig) -> Compared:
        tables.append(processes.count())
        return Compared("", [])

    monkeypatch.setattr(robustness, "rows_of", rows_of)
    monkeypatch.setattr(robustness, "compare", compare)
    monkeypatch.setattr(reproduce, "join", lambda config: None)
    members = [processes.Member(number, "here", number) for number in range(2)]
    team = processes.Team(members, index, {}, lambda *_: None)
    monkeypatch.setattr(team, "combine", lambda piece, make: b"")
    monkeypatch.setattr(processes._present, "team", team)
    config = replace(CONFIG, out=tmp_path, env=("kitchen", "grid"), only=("ucb", "bpe"))
    reproduce.make_comparison(config)
    worlds, chosen = comparisons.worlds_of(config), comparisons.methods_of(config)
    assert measured == [(w, m, 1) for w in worlds for m in chosen][index::2]
    assert tables == [1][index:]


def test_the_cost_of_a_row_is_in_minutes() -> None:
    for cost, cell in ((90.0, "1.5"), (None, "")):
        found = Behind.model_validate(measured(Noise(obs=0.01), cpu_seconds=cost))
        text = robustness.as_table([Row("kitchen", "ucb", Noise(obs=0.01), found)])
        head, _, row = (
            [word.strip() for word in line.split("|")[1:-1]] for line in text.splitlines()[:3]
        )
        assert dict(zip(head, row, strict=True))["CPU-minutes"] == cell


def test_a_row_of_another_adaptation_is_not_used(unpublished: list[Noise], tmp_path: Path) -> None:
    config = replace(CONFIG, out=tmp_path)
    robustness.compare(config)
    place = robustness.place_of_row(config, Cell("kitchen", "ucb", UCB), Noise(obs=0.01))
    place.write_text(json.dumps(measured(Noise(obs=0.01), adapted=0.1)))
    with pytest.raises(
        DataError, match=r"observations-0\.01\.json is not of the adaptation in .*remove"
    ):
        robustness.compare(config)


def test_the_official_noise_is_named_in_the_file() -> None:
    place = robustness.place_of_row(CONFIG, Cell("kitchen", "ucb", UCB), Noise(obs="official"))
    assert place == Path("runs/reproduce/kitchen/noise/ucb-cpu-3seeds/observations-official.json")


def test_smoke_has_one_noise_of_each_kind() -> None:
    smoke = replace(CONFIG, scale="smoke")
    assert robustness.sizes_of(smoke) == (Noise(obs=0.01), Noise(action=0.05))
    assert robustness.num_episodes(smoke) == 1
    assert comparisons.num_seeds(smoke) == 1
