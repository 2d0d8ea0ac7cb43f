"""``experiments.plot``: the figures of each world, and what the command refuses."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_results import ENV, MAZE, TINY, made_results

from envs.base import Environment
from envs.errors import DataError, UsageError
from envs.gridworld import GRIDWORLD
from envs.gridworld.env import NONE, GridWorld
from envs.registry import WORLDS, Judgement, World
from experiments import drawing, evaluation
from experiments.plot import PlotConfig, main
from experiments.store.policies import check_weights
from experiments.store.result_files import save_results
from experiments.store.results import Results
from experiments.store.summary import summarize
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy_files import read_policy, save_policy
from mgpo_jax.prompts import prompt_of, single_goal
from mgpo_jax.transformer import GoalTransformer

SHORT_GRID = replace(
    GRIDWORLD, name="short", make=lambda: GridWorld(name="short", horizon=12), policy_of=None
)
PLAIN = World(name="plain", make=lambda: ENV)  # without pictures


@pytest.fixture(autouse=True)
def made_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The worlds that the results below name."""
    made, find = {"tiny": TINY, "short": SHORT_GRID, "plain": PLAIN}, WORLDS.find
    monkeypatch.setattr(WORLDS, "find", lambda name: made.get(name) or find(name))


def policy_in(env: Environment, folder: Path, num_slots: int) -> Path:
    """Untrained weights on disk."""
    config = network_config(
        env.spec, embed_dim=8, num_layers=1, num_heads=2, max_prompt_length=num_slots
    )
    prompt = single_goal(jnp.zeros(env.spec.goal_dim), num_slots)
    obs, actions = jnp.zeros((1, *env.spec.obs.shape)), jnp.zeros(1, jnp.int32)
    params = GoalTransformer(config).init(jax.random.key(0), prompt, obs, actions)
    save_policy(folder, config, params, {})
    return folder


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return policy_in(ENV, tmp_path_factory.mktemp("maze") / "policy", num_slots=3)


@pytest.fixture(scope="module")
def grid_policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return policy_in(SHORT_GRID.make(), tmp_path_factory.mktemp("grid") / "policy", num_slots=8)


def mazes(policy: Path, method: str = "ucb", env: str = "tiny") -> Results:
    results = made_results(method)
    summary = {"policy_sha256": read_policy(policy).sha256}
    return replace(
        results, config={**results.config, "env": env, "policy": str(policy)}, summary=summary
    )


def grids(policy: Path) -> Results:
    """1 seed, 2 tasks, 40 episodes; the best prompt names two objects from episode 10 on."""
    order = np.array([[2, 0, 5, NONE, NONE, NONE, NONE], [6, 5, 4, 3, 2, 1, 0]], np.int32)
    objects = np.eye(7, dtype=np.float32)
    rows = [objects[task[task != NONE]].sum(axis=0) for task in order]
    first = [single_goal(jnp.asarray(goal), 8) for goal in rows]
    later = [prompt_of(np.stack([objects[2], objects[0], goal]), 8) for goal in rows]
    prompts = [[one] * 9 + [other] * 31 for one, other in zip(first, later, strict=True)]
    goals = np.array([[[one.goals for one in search] for search in prompts]], np.float32)
    mask = np.array([[[one.mask for one in search] for search in prompts]])
    parts = {"prompt.goals": goals, "prompt.mask": mask, "greedy": np.ones((1, 2, 40), bool)}
    return made_results(
        returns=np.zeros((1, 2, 40)),
        choices=parts,
        best=parts,
        eval_episodes=np.array([1, 10, 20, 40]),
        eval_returns=np.array([[[0.0, 0.33, 0.67, 1.0], [0.14, 0.29, 0.14, 1.0]]]),
        optimal_returns=np.ones(2),
        actions=None,
        reached=None,
        tasks={"order": order},
        config={"env": "short", "method": "ucb", "policy": str(policy)},
    )


Save = Callable[[str, Results], Path]


@pytest.fixture
def save(tmp_path: Path) -> Iterator[Save]:
    def write(name: str, results: Results) -> Path:
        numbers = summarize(
            results, policy_sha256="0" * 64, num_episodes=88, num_failed=0, cpu_seconds=2.0
        )
        if not results.summary:  # of a version that did not note the policy
            del numbers["policy_sha256"]
        save_results(tmp_path / name, replace(results, summary={**numbers, **results.summary}))
        return tmp_path / name

    return write


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir() if path.suffix in (".png", ".gif")}


def check_pictures(folder: Path) -> None:
    for path in folder.iterdir():
        picture = iio.imread(path)
        assert min(picture.shape[-3:-1]) > 100
        assert np.ptp(picture) > 0


def test_command_draws_everything(tmp_path: Path, save: Save, policy: Path) -> None:
    runs = (save("a", mazes(policy)), save("b", mazes(policy, "bbt")))
    main(PlotConfig(runs=runs, out=tmp_path / "out", tasks=(1,)))
    assert names(tmp_path / "out") == {
        "tiny_learning_curve.png",
        "tiny_prompts.png",
        "tiny_short_and_long.png",
        "tiny_methods.png",
        *(f"tiny_{method}_episodes.png" for method in ("ucb", "bbt")),
        *(f"tiny_{method}_evolution_task1.png" for method in ("ucb", "bbt")),
        *(f"tiny_{method}_known_task1.png" for method in ("ucb", "bbt")),
        *(f"tiny_{method}_episode_task1.gif" for method in ("ucb", "bbt")),
    }
    check_pictures(tmp_path / "out")


def test_command_draws_what_another_world_offers(
    tmp_path: Path, save: Save, grid_policy: Path
) -> None:
    run = save("run", grids(grid_policy))
    main(PlotConfig(runs=(run,), out=tmp_path / "out", tasks=(1, 0)))
    assert names(tmp_path / "out") == {
        "short_learning_curve.png",
        "short_ucb_search.png",
        "short_ucb_episodes.png",
        "short_ucb_episode_task1.gif",
    }
    check_pictures(tmp_path / "out")


def test_results_of_several_worlds_are_drawn_world_by_world(
    tmp_path: Path, save: Save, policy: Path
) -> None:
    runs = tuple(save(env, mazes(policy, env=env)) for env in ("plain", "tiny"))
    main(PlotConfig(runs=(*runs, runs[0]), out=tmp_path / "out", tasks=(0,)))
    assert names(tmp_path / "out") == {
        "plain_learning_curve.png",
        "tiny_learning_curve.png",
        "tiny_prompts.png",
        "tiny_short_and_long.png",
        "tiny_ucb_evolution_task0.png",
        "tiny_ucb_known_task0.png",
        "tiny_ucb_episodes.png",
        "tiny_ucb_episode_task0.gif",
    }


def test_an_adaptation_draws_into_its_own_folder(tmp_path: Path, grid_policy: Path) -> None:
    for world, results, wanted in (
        (TINY, made_results(), {"learning_curve.png", "prompts.png"}),
        (SHORT_GRID, grids(grid_policy), {"learning_curve.png", "search.png"}),
        (PLAIN, made_results(), {"learning_curve.png"}),
    ):
        folder = tmp_path / world.name
        folder.mkdir()
        drawing.draw_run(world, results, folder)
        assert names(folder) == wanted


def test_a_changed_picture_of_an_adaptation_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The others are drawn anew."""
    drawing.draw_run(TINY, made_results(), tmp_path)
    curve, prompts = tmp_path / "learning_curve.png", tmp_path / "prompts.png"
    before = curve.read_bytes()
    prompts.write_bytes(b"mine")
    curve.unlink()
    capsys.readouterr()
    drawing.draw_run(TINY, made_results(), tmp_path)
    assert (curve.read_bytes(), prompts.read_bytes()) == (before, b"mine")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert f"{prompts} is kept: it was changed, or not written by this command; move it" in lines[1]


def test_goals_at_the_ends_of_the_numbers_are_drawn(
    tmp_path: Path, save: Save, policy: Path
) -> None:
    results = mazes(policy)
    goals = np.full_like(results.best["prompt.goals"], 1e18)
    goals[..., 1] *= -1
    parts = {**results.best, "prompt.goals": goals}
    run = save("run", replace(results, choices=parts, best=parts))
    main(PlotConfig(runs=(run,), out=tmp_path / "out", tasks=(1,)))
    assert "tiny_prompts.png" in names(tmp_path / "out")
    check_pictures(tmp_path / "out")


def test_worlds_without_pictures_get_curves_only(tmp_path: Path, save: Save, policy: Path) -> None:
    run = save("run", mazes(policy, env="plain"))
    main(PlotConfig(runs=(run,), out=tmp_path / "out"))
    assert names(tmp_path / "out") == {"plain_learning_curve.png"}


def test_episodes_are_those_of_the_policy_under_the_prompt(policy: Path) -> None:
    results = mazes(policy)
    play = drawing.player_of(results)
    goals = results.best_goals(0, 0)
    greedy = play(jax.random.key(0), results.task(0), goals, 3, True)  # as mazes judge policies
    assert greedy.trajectory.obs.shape == (3, 6, *ENV.spec.obs.shape)
    assert isinstance(greedy.return_, np.ndarray)
    assert np.ptp(greedy.trajectory.actions, axis=0).max() == 0  # mazes are deterministic
    explored = play(jax.random.key(0), results.task(0), goals, 64, False)
    assert np.ptp(explored.trajectory.actions, axis=0).max() > 0


@pytest.mark.parametrize(("temperature", "vary"), [(1.0, True), (1e-3, False)])
def test_episodes_are_sampled_where_the_world_judges_by_samples(
    policy: Path, monkeypatch: pytest.MonkeyPatch, temperature: float, vary: bool
) -> None:
    """At its temperature: close to 0, samples are the most likely actions."""
    judged = Judgement(mode="sample", temperature=temperature, episodes=4)
    monkeypatch.setattr(WORLDS, "find", lambda name: replace(TINY, judged=judged))
    results = mazes(policy)
    play, goals = drawing.player_of(results), results.best_goals(0, 0)
    played = play(jax.random.key(0), results.task(0), goals, 64, True)
    assert (np.ptp(played.trajectory.actions, axis=0).max() > 0) == vary
    explored = play(jax.random.key(0), results.task(0), goals, 64, False)
    assert np.ptp(explored.trajectory.actions, axis=0).max() > 0


def test_methods_that_ran_twice_are_told_apart_by_their_folders(policy: Path) -> None:
    results = {
        Path(name): mazes(policy, method)
        for name, method in zip("abc", ("ucb", "bpe", "ucb"), strict=True)
    }
    assert list(drawing.labeled(results)) == ["ucb (a)", "bpe", "ucb (c)"]


def test_other_weights_are_refused(tmp_path: Path, save: Save, policy: Path) -> None:
    results = mazes(policy)
    other = replace(results, summary={"policy_sha256": "0" * 64})
    with pytest.raises(DataError, match=r"not those that .* tiny ucb were found with \(0{12}\)"):
        main(PlotConfig(runs=(save("run", other),), out=tmp_path / "out", tasks=(0,)))
    assert not (tmp_path / "out").exists()
    unknown = replace(results, summary={})  # of a version that did not note them
    check_weights(unknown, read_policy(policy), "")
    check_weights(results, read_policy(policy), "")


def test_command_refuses_what_it_cannot_draw(tmp_path: Path, save: Save, policy: Path) -> None:
    run = save("run", mazes(policy))
    tasks = {"maze": np.stack([MAZE] * 2), "goal": np.array([(1, 5), (1, 1)])}
    elsewhere = save("other", replace(mazes(policy), tasks=tasks))
    for config, message in (
        (PlotConfig(), "no result folder given"),
        (PlotConfig(runs=(run, elsewhere)), "different tasks"),
        (PlotConfig(runs=(run,), seed=2), "--seed 2 must be from 0 to 1"),
        (PlotConfig(runs=(run,), seed=-1), "--seed -1 must be from 0 to 1"),
        (PlotConfig(runs=(run,), tasks=(7,)), "must be from 0 to 1, the tasks of"),
        (PlotConfig(runs=(run,), tasks=(-1,)), "must be from 0 to 1, the tasks of"),
    ):
        with pytest.raises(UsageError, match=message):
            main(replace(config, out=tmp_path / "out"))
        assert not (tmp_path / "out").exists()
    with pytest.raises(DataError, match="no result folder"):
        main(PlotConfig(runs=(run, tmp_path / "nowhere"), out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_our_own_pictures_are_replaced_and_changed_ones_kept(
    tmp_path: Path, save: Save, policy: Path
) -> None:
    run, out = save("run", mazes(policy)), tmp_path / "out"
    config = PlotConfig(runs=(run,), out=out, tasks=(1,))
    main(config)
    main(config)
    before = {path: path.read_bytes() for path in out.iterdir()}
    edited = out / "tiny_prompts.png"
    iio.imwrite(edited, 255 - iio.imread(edited))
    kept = edited.read_bytes()
    (out / "tiny_learning_curve.png").unlink()
    with pytest.raises(
        UsageError, match=r"out/tiny_prompts\.png would be overwritten, but .*--out"
    ):
        main(config)
    assert edited.read_bytes() == kept
    assert not (out / "tiny_learning_curve.png").exists()
    edited.unlink()
    main(config)
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_a_file_that_someone_else_wrote_is_no_place_for_a_picture(
    tmp_path: Path, save: Save, policy: Path
) -> None:
    run, out = save("run", mazes(policy)), tmp_path / "out"
    out.mkdir()
    (out / "tiny_learning_curve.png").write_text("notes")
    with pytest.raises(UsageError, match="would be overwritten"):
        main(PlotConfig(runs=(run,), out=out))
    assert [path.name for path in out.iterdir()] == ["tiny_learning_curve.png"]
    with pytest.raises(UsageError, match=r"--out .*is not a folder"):
        main(PlotConfig(runs=(run,), out=run / "summary.json"))


def test_a_picture_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "picture.png"

    def fail(place: Path) -> None:
        place.write_bytes(b"half of it")
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="full"):
        drawing.write(path, fail)
    assert not list(tmp_path.iterdir())


def test_letters_that_the_font_lacks_make_no_noise(
    tmp_path: Path, save: Save, policy: Path, recwarn: pytest.WarningsRecorder
) -> None:
    """Two runs of one method have their folders in the legend."""
    runs = tuple(save(name, mazes(policy, env="plain")) for name in ("迷路", "$x_{$\\frac"))
    main(PlotConfig(runs=runs, out=tmp_path / "out"))
    assert not [str(one.message) for one in recwarn if "missing" in str(one.message)]
    check_pictures(tmp_path / "out")


def test_a_policy_that_was_moved_is_named(tmp_path: Path, save: Save, policy: Path) -> None:
    moved = tmp_path / "moved"
    run = save("run", mazes(policy_in(ENV, tmp_path / "first", num_slots=3)))
    (tmp_path / "first").rename(moved)
    config = PlotConfig(runs=(run,), out=tmp_path / "out", tasks=(1,))
    with pytest.raises((UsageError, DataError), match="--policy"):
        main(config)
    assert not (tmp_path / "out").exists()
    main(replace(config, policy=moved))
    assert "tiny_ucb_episode_task1.gif" in names(tmp_path / "out")
    other = policy_in(ENV, tmp_path / "other", num_slots=4)
    with pytest.raises(DataError, match="are not those"):
        main(replace(config, policy=other, out=tmp_path / "more"))
    assert not (tmp_path / "more").exists()


def test_worlds_that_files_name_are_only_imported_on_request(
    tmp_path: Path, save: Save, policy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = "from made_results import TINY\nfrom dataclasses import replace\n"
    (tmp_path / "named_in_a_file.py").write_text(source + "WORLD = replace(TINY, name='mine')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    run = save("run", mazes(policy))
    settings = run / "config.json"
    settings.write_text(settings.read_text().replace('"tiny"', '"named_in_a_file:WORLD"'))
    config = PlotConfig(runs=(run,), out=tmp_path / "out", tasks=(1,))
    with pytest.raises(DataError, match="give it with --env named_in_a_file:WORLD"):
        main(config)
    assert "named_in_a_file" not in sys.modules
    assert not (tmp_path / "out").exists()
    main(replace(config, env="named_in_a_file:WORLD"))
    assert "named_in_a_file.WORLD_learning_curve.png" in names(tmp_path / "out")


@pytest.mark.parametrize("method", ["../../ucb", "/ucb", "a/b:c", "$\\frac{$", "u" * 300])
def test_no_picture_lies_outside_of_the_folder(
    tmp_path: Path, save: Save, policy: Path, method: str
) -> None:
    run = save("run", mazes(policy))
    settings = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**settings, "method": method}))
    with pytest.raises((DataError, UsageError)):
        main(PlotConfig(runs=(run,), out=tmp_path / "out", tasks=(1,)))
    assert {path.name for path in tmp_path.iterdir()} == {"run"}


def test_evaluation_names_the_worlds_that_have_the_tasks(
    save: Save, policy: Path, tmp_path: Path
) -> None:
    run = save("run", mazes(policy))
    with pytest.raises(UsageError, match=r"--env short cannot run the tasks of tiny.*can: tiny"):
        evaluation.open_case(run, "short", [evaluation.Noise()])
    policy.rename(tmp_path / "moved")
    try:
        with pytest.raises(DataError, match="--policy"):
            evaluation.open_case(run, None, [evaluation.Noise()])
        case = evaluation.open_case(run, None, [evaluation.Noise()], tmp_path / "moved")
        assert case.policy.folder == tmp_path / "moved"
    finally:
        (tmp_path / "moved").rename(policy)


def test_rows_of_an_evaluation_say_what_they_are() -> None:
    row = {
        "folder": "runs/a", "env": "tiny", "optimizer": "ucb", "num_tasks": 2, "num_seeds": 1,
        "episodes": 10, "adapted": 0.5, "noise": "none", "return": 0.25, "std_over_seeds": None,
        "change": -0.25,
    }  # fmt: skip
    cells = dict(zip(evaluation.HEAD, evaluation.cells(row), strict=True))
    assert (cells["folder"], cells["tasks x seeds x episodes"]) == ("runs/a", "2 x 1 x 10")
    assert cells["return (mean ± std over seeds)"] == "0.250"
    several = evaluation.cells({**row, "std_over_seeds": 0.125})
    assert several[-2:] == ["0.250 ± 0.125", "-0.250"]
