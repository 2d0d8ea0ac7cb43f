"""``experiments.reproduce``: finished pieces are kept, others continue, tables state their budget."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import pytest

import envs
from envs import episodes
from envs.errors import DataError, NotAvailableError, UsageError
from experiments import (
    ablations,
    comparison_tables,
    comparisons,
    inventory,
    paper_figures,
    reproduce,
    robustness,
)
from experiments.reproduce import main
from experiments.store import reproduce_settings, speeds
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.paper import paper_worlds
from experiments.store.presets import pretrain_preset
from experiments.store.reproduce_settings import ReproduceConfig
from experiments.store.result_files import load_results
from experiments.store.settings import PretrainConfig
from experiments.store.summary import read_summary
from mgpo_jax import methods
from mgpo_jax.files import write_json
from mgpo_jax.settings import check_settings
from mgpo_jax.tasks import test_tasks as released_tasks

FOUR_DIGITS = 1e-3  # the package keeps speeds with four digits


def tiny_preset(env: str, preset: str) -> PretrainConfig:
    assert preset == "fast"
    smoke = pretrain_preset(env, "smoke")
    train = replace(smoke.train, batch_size=8, part_size=4, bucket=64)
    return replace(
        smoke, train=train, embed_dim=8, num_layers=1, num_heads=2, holdout=4, eval_tasks=2
    )


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Trainings of two steps and adaptations of two episodes to two tasks."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MGPO_DATA", raising=False)
    for module in (ablations, reproduce_settings):
        monkeypatch.setattr(module, "pretrain_preset", tiny_preset)
    monkeypatch.setattr(ablations, "EPISODES", 2)
    monkeypatch.setattr(episodes, "MAX_SEGMENTS", 1)
    few = lambda world: jax.tree.map(lambda leaf: leaf[:2], released_tasks(world))  # noqa: E731
    monkeypatch.setattr(ablations, "test_tasks", few)
    return tmp_path


def test_table5_from_data_to_table(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = ReproduceConfig(what="table5", only=("astar2",), steps=2, trajectories=24, seeds=1)
    main(config)
    folder = tiny / "runs" / "reproduce" / "maze15"
    text = (folder / "table5.md").read_text()
    head, _, *rows = [line for line in text.splitlines() if line.startswith("|")]
    assert "2 gradient steps on 24 trajectories each" in text
    assert head.split("|")[2].strip() == "initial"
    (row,) = rows
    label, initial, final, *_, paper, gap = (cell.strip() for cell in row.strip("|").split("|"))
    assert (label, paper) == ("astar2", "-0.36 ± 0.02")
    assert float(gap) == pytest.approx(float(final) + 0.36, abs=0.006)
    results = load_results(folder / "table5" / "astar2-k5-2steps-24episodes-1seeds")
    assert results.returns.shape == (1, 2, 2)
    assert float(initial) == pytest.approx(results.eval_returns[:, :, 0].mean(), abs=0.01)
    assert (folder / "table5.png").stat().st_size > 0

    def never(*args: Any, **options: Any) -> None:
        raise AssertionError("what is finished was done again")

    monkeypatch.setattr(ablations, "train", never)
    monkeypatch.setattr(ablations, "adapt_all", never)
    (folder / "table5.md").unlink()
    main(config)
    assert (folder / "table5.md").read_text() == text

    results = folder / "table5" / "astar2-k5-2steps-24episodes-1seeds"
    for path, old, new, says in (
        (results / "meta.json", '"episodes": 2', '"episodes": 3', "holds results of other settings"),
        (
            folder / "policies" / "astar2-k5-2steps-24episodes" / "config.json",
            '"holdout": 4', '"holdout": 5', "was started with other settings: holdout 5 -> 4",
        ),
    ):  # fmt: skip
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        with pytest.raises(UsageError, match=says):
            main(config)
        path.write_text(text)
    summary = results / "summary.json"
    summary.write_text(json.dumps({**json.loads(summary.read_text()), "policy_sha256": "0" * 64}))
    with pytest.raises(DataError, match=r"are not those .* \(0{12}\): remove .*1seeds"):
        main(config)


def test_a_stopped_training_goes_on(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[PretrainConfig] = []
    monkeypatch.setattr(ablations, "train", lambda settings, go_on: asked.append(settings))
    config = ReproduceConfig(what="figure8", steps=2)
    longer = ablations.planned(config, "astar4", "astar4", max_prompt_length=10)
    policy = ablations.trained(longer)
    policy.parent.mkdir(parents=True)
    (policy.parent / "config.json").touch()
    ablations.trained(longer)
    assert [one.resume for one in asked] == [False, True]  # it goes on where it was
    for one in asked:
        assert (one.out, one.max_prompt_length) == (policy.parent, 10)
        assert (one.data.demonstrator, one.train.steps) == ("astar4", 2)
    policy.mkdir()
    ablations.trained(longer)
    assert len(asked) == 3  # the policy is only half there
    write_json(policy.parent / "config.json", longer)
    for name in ("policy/config.json", "policy/weights.npz", "training.png"):
        (policy.parent / name).touch()
    ablations.trained(longer)
    assert len(asked) == 3


def test_heads_differ_in_nothing_else(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[PretrainConfig] = []
    adapted: list[Path] = []
    monkeypatch.setattr(ablations, "train", lambda settings, go_on: asked.append(settings))
    monkeypatch.setattr(
        ablations, "adapted", lambda config, policy, folders, method: adapted.extend(folders)
    )
    lines = ablations.make(ReproduceConfig(what="heads", env=("kitchen",), steps=2))
    assert [line.label for line in lines] == ["gaussian", "fixed_gaussian", "mixture", "binned"]
    assert [line.results for line in lines] == adapted
    assert [one.head for one in asked] == [line.label for line in lines]
    same = {replace(one, head=None, out=None) for one in asked}
    assert len(same) == 1
    assert same.pop().data.trajectories == 9_000


def test_table1_from_cells_to_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """``reproduce table1 --scale smoke`` with two tasks and two episodes, and then once more."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(comparisons, "SMOKE_TASKS", 2)
    for module in (comparisons, comparison_tables):
        monkeypatch.setattr(module, "SMOKE_EPISODES", 2)
    monkeypatch.setattr(episodes, "MAX_SEGMENTS", 1)
    load = comparisons.load_policy

    def loaded(world: Any, path: Any, kind: str) -> Any:
        if kind == "ptgm":
            raise UsageError("no policy in that folder")
        return load(world, path, kind)

    monkeypatch.setattr(comparisons, "load_policy", loaded)
    config = ReproduceConfig(
        what="table1", env=("maze15",), scale="smoke", only=("gcbc", "explore")
    )
    with pytest.raises(UsageError, match="method of table1"):
        main(config)
    config = replace(config, only=("gcbc", "ucb", "ptgm"))
    main(config)
    text = capsys.readouterr().out
    _, _, *rows = [line for line in text.splitlines() if line.startswith("|")]
    gcbc, ucb, ptgm = ([cell.strip() for cell in row.strip("|").split("|")] for row in rows)
    assert [row[:2] for row in (gcbc, ucb, ptgm)] == [
        ["maze15", "GC-BC"], ["maze15", "MGPO-UCB"], ["maze15", "PTGM"],
    ]  # fmt: skip
    assert gcbc[2] == "-2.63"
    assert (gcbc[6], ucb[6]) == ("2 x 1 x 1", "2 x 1 x 2")
    assert float(gcbc[4]) == pytest.approx(float(gcbc[3]) + 2.63, abs=2e-3)
    assert ptgm[2:] == ["-0.96 ± 0.08", *["-"] * 5]
    assert "- maze15: no policy in that folder" in text
    assert "Scaled down: 2 tasks, 1 seed, 2 episodes" in text
    assert comparison_tables.files_of(config)[1].stat().st_size > 0
    (row,) = [line for line in inventory.inventory(config).splitlines() if "| table1 |" in line]
    assert row.startswith("| table1 | maze15 | 2 of 3 | 0.0 | ")

    def never(*args: Any, **options: Any) -> None:
        raise AssertionError("what is finished was done again")

    monkeypatch.setattr(comparisons, "adapt_and_save", never)
    main(config)
    assert capsys.readouterr().out == text


def test_published_cells_are_used_if_they_are_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = ReproduceConfig(what="table2")
    settings = comparisons.cell_config(config, "maze15", "ucb")
    assert comparisons.published(config, settings) == Path("results/maze15/ucb")
    assert comparisons.published(config, replace(settings, seeds=2)) is None
    assert comparisons.published(config, replace(settings, seeds=5)) == Path("results/maze15/ucb")
    assert comparisons.published(config, replace(settings, episodes=50)) is None
    for world, method in (("maze30", "ppo"), ("maze15", "ptgm-random")):  # one seed; learns nothing
        cell = comparisons.cell_config(config, world, method)
        assert comparisons.published(config, cell) == Path("results", world, method)
    assert comparisons.published(replace(config, scale="paper"), settings) is None
    monkeypatch.chdir(tmp_path)
    assert comparisons.published(config, settings) is None


def test_a_published_cell_of_fewer_seeds_stands_until_there_is_one_of_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*args: Any, **options: Any) -> None:
        raise AssertionError("what is published was done again")

    monkeypatch.setattr(comparisons, "adapt_and_save", never)
    config = ReproduceConfig(what="table8", out=tmp_path)
    cell = comparisons.made(config, "maze30", "ppo")
    assert cell.results == Path("results/maze30/ppo")
    assert (
        "- maze30, BC-finetune (PPO): 1 seed(s), where the paper has 3.\n"
        in comparison_tables.as_table([cell])
    )
    with_all = comparisons.cell_config(config, "maze30", "ppo").folder
    shutil.copytree("results/maze30/ppo", with_all)
    monkeypatch.setattr(comparisons, "finished", lambda *_: None)
    assert comparisons.made(config, "maze30", "ppo").results == with_all


def test_a_cell_that_fails_is_a_dash_and_the_others_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*args: Any, **options: Any) -> None:
        raise DataError("a return is not a finite number")

    monkeypatch.setattr(comparisons, "adapt_and_save", fails)
    config = ReproduceConfig(what="table1", env=("maze15",), only=("gcbc", "ucb"), out=tmp_path)
    says = "gcbc in maze15 failed; the notes below the table say why"
    with pytest.raises(DataError, match=says):
        main(config)
    printed = capsys.readouterr().out
    assert "| maze15 | GC-BC | -2.63 | - | - | - | - | - |" in printed
    assert "- maze15: gcbc failed: a return is not a finite number\n" in printed
    assert re.search(r"maze15 \| MGPO-UCB \| .* \| -0\.\d+ ± ", printed)
    assert "- maze15: gcbc failed" in (tmp_path / "table1-cpu.md").read_text()
    monkeypatch.setattr(comparisons, "published", lambda *_: None)
    with pytest.raises(
        DataError, match=r"figure2 is not available for maze15: .* failed: a return"
    ):
        paper_figures.draw(replace(config, what="figure2"))


def test_figures_are_drawn_of_published_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*args: Any, **options: Any) -> None:
        raise AssertionError("what is published was done again")

    monkeypatch.setattr(comparisons, "adapt_and_save", never)
    config = ReproduceConfig(what="figure2", out=tmp_path)
    (drawn,) = paper_figures.draw(config)
    assert drawn == tmp_path / "figure2-cpu_maze15_prompts.png"
    assert drawn.stat().st_size > 0
    absent = comparisons.Cell("crafter", "ucb", None, "no network is released")
    monkeypatch.setattr(paper_figures, "made", lambda *_: absent)
    with pytest.raises(UsageError, match="figure2 is not available for crafter: no network is"):
        paper_figures.draw(replace(config, env=("crafter",)))


def test_every_method_of_a_comparison_is_known() -> None:
    for name, comparison in comparisons.TABLES.items():
        for method in (*comparison.methods, *comparison.further):
            assert methods.find(method).name == method
        four = {"maze15", "maze30", "kitchen", "gridworld"}
        assert set(paper_worlds(name)) >= ({"kitchen"} if name == "table3" else four)


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (ReproduceConfig(what="tabel5"), "did you mean 'table5'"),
        (
            ReproduceConfig(what="table5", env=("gridworld",)),
            "table5 is not available for gridworld",
        ),
        (
            ReproduceConfig(what="heads"),
            "heads is not available for maze15, whose actions are discrete",
        ),
        (ReproduceConfig(what="table5", only=("astar3",)), "did you mean 'astar"),
        (ReproduceConfig(what="figure8", only=("41",)), "row of figure8"),
        (ReproduceConfig(what="table4", steps=0), "--steps must be at least 1"),
        (ReproduceConfig(what="all", only=("ucb",)), "--only ucb does not apply to all"),
        (ReproduceConfig(what="figure11", steps=5), "--steps 5 does not apply to figure11"),
        (ReproduceConfig(what="table3", only=("reinforce",)), "unknown method of table3"),
        (ReproduceConfig(what="table1", steps=5), "--steps 5 does not apply to table1"),
        (ReproduceConfig(what="table4", scale="smoke"), "--scale smoke does not apply to table4"),
        (ReproduceConfig(what="table1", env=("maze51",)), "did you mean 'maze15'"),
    ],
)
def test_usage_errors(
    config: ReproduceConfig, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def call() -> None:
        check_settings(config)
        main(config)

    with pytest.raises(UsageError, match=says):
        call()
    assert not config.folder.exists()


def test_budgets_are_those_of_the_worlds_preset() -> None:
    sizes = {"maze15": (2_000, 10_000), "maze30": (1_000, 10_000), "kitchen": (1_000, 9_000)}
    for env, size in sizes.items():
        config = ReproduceConfig(what="table4", env=(env,))
        assert (config.num_steps, config.num_trajectories) == size
    config = ReproduceConfig(what="table4", env=("gridworld",))  # has none: those of its recipe
    assert (config.num_steps, config.num_trajectories) == (3_000, 68_000)
    assert "ablation" not in envs.find("gridworld").presets


def test_cells_of_table1_have_the_units_of_their_columns() -> None:
    folder = Path("results/maze15/ucb").absolute()
    summary = read_summary(folder)
    text = comparison_tables.as_table([comparisons.Cell("maze15", "ucb", folder)])
    head, _, row = (
        [cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()[:3]
    )
    cells = dict(zip(head, row, strict=True))
    assert float(cells["CPU-minutes"]) == pytest.approx(summary["cpu_seconds"] / 60, abs=0.051)
    best = float(cells["best single episode"])
    assert best == pytest.approx(summary["best_episode_return"], abs=0.0051)
    assert best > summary["final_return"]
    assert "fresh" not in text
    text = comparison_tables.as_table(
        [
            comparisons.Cell(
                "crafter-symbolic", "bpe", folder.parents[1] / "crafter-symbolic" / "bpe"
            )
        ]
    )
    assert " (fresh) |" in text
    assert "crafter-symbolic, fresh: the mean of 16 sampled episodes outside of the search." in text


def test_the_plan_is_tried_without_each_of_its_parts(
    tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, tuple[str, Any]] = {}

    def adapted(
        config: ReproduceConfig, policy: Path | None, folders: dict[Path, Any], method: str
    ) -> None:
        assert policy is None
        ((folder, hyper),) = folders.items()
        asked[folder.name] = (method, hyper)

    monkeypatch.setattr(ablations, "adapted", adapted)
    lines = ablations.make(ReproduceConfig(what="plan", seeds=1))
    assert [line.results.name for line in lines] == list(asked)
    assert asked["ucb-1seeds"] == ("ucb", methods.find("ucb").hyper())
    assert asked["without-splicing-1seeds"][1].splice is False
    assert asked["without-rehearsal-1seeds"][1].rehearse == 0
    only = ablations.make(ReproduceConfig(what="plan", only=("without steering",)))
    assert [line.label for line in only] == ["without steering"]
    with pytest.raises(UsageError, match="plan is not available for gridworld"):
        ablations.make(ReproduceConfig(what="plan", env=("gridworld",)))


def test_table4_varies_length_and_constant(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[Path, Any] = {}

    def adapted(
        config: ReproduceConfig, policy: Path | None, folders: dict[Path, Any], method: str
    ) -> None:
        assert (policy, method) == (None, "ucb")
        asked.update(folders)

    monkeypatch.setattr(ablations, "adapted", adapted)
    lines = ablations.make(ReproduceConfig(what="table4"))
    assert [line.label for line in lines] == [
        "K = 1", "K = 2", "K = 3", "K = 5", "c = 0", "c = 1", "c = 10",
    ]  # fmt: skip
    hypers = [asked[line.results] for line in lines]
    assert [hyper.max_goals for hyper in hypers] == [1, 2, 3, 5, 5, 5, 5]
    assert [hyper.c for hyper in hypers[4:]] == [0, 1, 10]
    assert all(hyper.scale == 1 for hyper in hypers[4:])  # Eq. 3 as printed
    assert all(hyper.scale is None for hyper in hypers[:4])
    assert (lines[0].paper, lines[3].paper) == ("-2.63 ± 0.00", "-0.41 ± 0.10")


def test_published_rows_are_found_and_not_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those with the same settings and as many seeds, unless this command made its own."""
    monkeypatch.setattr(ablations, "adapted", None)  # which would be an error to call
    config = ReproduceConfig(what="plan", env=("maze30",), out=tmp_path / "new")
    reproduce.make_ablation(config)
    text = capsys.readouterr().out
    assert (tmp_path / "new/maze30/plan.md").read_text().startswith(text.strip())
    assert (tmp_path / "new/maze30/plan.png").stat().st_size > 0
    places = {part.name: part.results for part in ablations.plan(config)}
    assert places["plan"] == Path("results/maze30/plan")
    assert places["ucb"] == Path("results/maze30/ucb")
    below = Path("results/ablations/maze30/plan")
    for name in ("without-steering", "without-rehearsal", "without-splicing", "without-frontiers"):
        assert places[name] == below / name
        assert f"| {name.replace('-', ' ')} | -23.81 |" in text
    own = config.folder / "plan" / "without-steering-3seeds"
    own.mkdir(parents=True)
    assert {part.name: part.results for part in ablations.plan(config)} == {
        **places,
        "without-steering": own,
    }
    world, name = envs.find("maze30"), "without-steering"
    asked = {
        "without-steering": {"steer": 0},
        "other": {"steer": 1},
        "more": {"steer": 0, "rehearse": 1},
    }
    for label, changes in asked.items():
        settings = AdaptConfig(
            env="maze30", method="plan", hyper=methods.find("plan").hyper_in(world, changes)
        )
        found = comparisons.published(config, settings, below / name)
        assert found == (below / name if label == name else None)
    few = ablations.plan(replace(config, seeds=1, out=tmp_path))
    assert all(part.results.parent.parent.parent == tmp_path for part in few)


def test_table4_has_the_length_of_the_policy_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Path] = []
    monkeypatch.setattr(ablations, "adapted", lambda *args: asked.extend(args[2]))
    lines = ablations.make(ReproduceConfig(what="table4", env=("maze30",)))
    assert [line.label for line in lines][3:6] == ["K = 5", "K = 20", "c = 0"]
    assert lines[4].results == Path("results/maze30/ucb")  # published
    assert asked == [line.results for line in lines if line is not lines[4]]
    few = ablations.table4(ReproduceConfig(what="table4", env=("maze30",), seeds=1))
    assert few[4].results == Path("runs/reproduce/maze30/table4/K20-1seeds")


def test_all_goes_on_after_a_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[tuple[str, tuple[str, ...]]] = []

    def make(config: ReproduceConfig) -> None:
        made.append((config.what, config.env))
        if config.what == "table2":
            raise UsageError("no room")
        if config.what == "table5":
            raise NotAvailableError("one demonstrator")

    monkeypatch.setattr(reproduce, "make", make)
    config = ReproduceConfig(what="all", env=("gridworld", "maze15"), out=tmp_path)
    with pytest.raises(DataError, match=r"^1 of \d+ could not be made: table2 gridworld maze15; "):
        reproduce.make_all(config)
    both = ("gridworld", "maze15")
    assert [what for what, env in made if env == both] == [
        "table1", "table2", "table3", "table8", "figure6", "figure7", "figure11",
    ]  # fmt: skip
    one_by_one = {what for what, env in made if env == ("maze15",)}
    assert one_by_one == {
        "figure2", "figure3", "figure5", "figure9", "figure10", "table4", "table5", "figure8", "heads",
        "plan",
    }  # fmt: skip
    said = capsys.readouterr().err
    assert "table2 gridworld maze15 failed: no room" in said
    assert "skipping table5 maze15: one demonstrator" in said

    assert "table4" not in {job.what for job in inventory.jobs(replace(config, scale="smoke"))}


def test_all_has_the_worlds_of_the_paper() -> None:
    jobs = inventory.jobs(ReproduceConfig(what="all"))
    worlds = {job.what: [] for job in jobs}
    for job in jobs:
        worlds[job.what] += job.env
    assert worlds["table1"] == []  # those of the paper, in one table
    assert worlds["table4"] == ["maze15", "maze30", "kitchen"]
    assert worlds["figure8"] == ["maze15", "maze30"]
    assert worlds["heads"] == ["kitchen"]


def test_the_inventory_counts_prices_and_doubts(tmp_path: Path) -> None:
    def rows_of(world: str) -> dict[str, list[str]]:
        config = ReproduceConfig(what="list", env=(world,), out=tmp_path)
        lines = inventory.inventory(config).splitlines()[2:]
        cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
        return {row[0]: row[1:] for row in cells}

    rows = rows_of("maze15")
    assert rows["table2"][:2] == ["maze15", "6 of 6"]  # all published
    assert rows["table2"][3] == ""
    # All but the policy itself, which acts for next to nothing.
    assert rows["table1"][1] == "11 of 12"
    assert float(rows["table1"][3]) < 0.1
    # PPO, REINFORCE and PTGM have one published seed each there. The first two price three seeds of the
    # careful form, the third prices those of its two variants.
    larger = rows_of("maze30")["table1"]
    assert larger[1] == "8 of 12, 2 with fewer seeds"
    ppo, reinforce, ptgm = (
        read_summary(Path("results/maze30", name))["cpu_seconds"] / 60
        for name in ("ppo", "reinforce", "ptgm")
    )
    rest = 3 * (ppo + reinforce) / 2 + 2 * 3 * ptgm
    assert rest < float(larger[3]) < rest + 1
    # Of BC-finetune nothing is published in Kitchen that tells a price.
    assert re.fullmatch(r"\d+\.\d \+ \?", rows_of("kitchen")["table1"][3])
    spent = read_summary(Path("results/maze15/ucb"))["cpu_seconds"]
    assert rows["figure3"][1:3] == ["1 of 1", f"{spent / 60:.1f}"]
    assert rows["table3"][1] == "0 of 35"
    assert rows["table5"][1] == "0 of 4"
    # Four trainings of 2,000 steps at the speed of the released policy, and four times UCB.
    assert 4 * 2_000 * 0.2 / 60 < float(rows["table5"][3]) < 4 * (2_000 * 0.4 + 2 * spent) / 60
    # Six rows of the ablation: searches by the plan without a part, and two that are published.
    plan = read_summary(Path("results/maze15/plan"))["cpu_seconds"]
    assert rows["plan"][1] == "2 of 6"
    assert float(rows["plan"][3]) == pytest.approx(4 * plan / 60, rel=0.05)
    assert rows["table4"][1:4:2] == ["7 of 7", ""]
    assert rows["heads"][1] == "-"
    assert "heads is not available for maze15" in rows["heads"][3]
    assert rows["figure11"][1] == "0 of 1"


def test_prices_are_those_of_relatives() -> None:
    rate = inventory.seconds_per_episode
    ucb = 1 / read_summary(Path("results/maze15/ucb"))["episodes_per_cpu_second"]
    assert rate("maze15", methods.find("ucb")) == pytest.approx(ucb, rel=FOUR_DIGITS)
    similar = [rate("gridworld", methods.find(name)) for name in ("reinforce", "ppo")]
    assert rate("gridworld", methods.find("ppo-careful")) == pytest.approx(sum(similar) / 2)
    assert rate("kitchen", methods.find("ppo")) is None
    cheapest = min(
        1 / read_summary(path)["episodes_per_cpu_second"]
        for path in Path("results/gridworld").iterdir()
        if path.name in methods.names()
    )
    assert rate("gridworld", methods.find("gcbc")) == pytest.approx(cheapest, rel=FOUR_DIGITS)
    assert rate("kitchen-mjx", methods.find("spirl")) is None


def test_a_gpu_says_nothing_about_cpu_time(tmp_path: Path) -> None:
    folder = tmp_path / "maze15" / "ucb"
    shutil.copytree("results/maze15/ucb", folder)
    assert list(speeds.measured(tmp_path)["maze15"]) == ["ucb"]
    meta = folder / "meta.json"
    meta.write_text(json.dumps({**json.loads(meta.read_text()), "devices": ["cuda:0"]}))
    speeds.rates_in.cache_clear()
    assert speeds.measured(tmp_path) == {}
    assert speeds.cpu_seconds_of(folder) is None


def test_table3_by_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def never(*args: Any, **options: Any) -> None:
        raise AssertionError("what is published was done again")

    monkeypatch.setattr(comparisons, "adapt_and_save", never)
    monkeypatch.setattr(robustness, "open_case", never)
    main(ReproduceConfig(what="table3", env=("kitchen-stock",), only=("bpe",), out=tmp_path))
    printed = capsys.readouterr()
    assert "| kitchen-stock | MGPO-BPE | observations 0.01 | 0.45 (-0.20) | 0.9" in printed.out
    assert printed.err.strip() == f"table in {tmp_path / 'table3-cpu.md'}"
