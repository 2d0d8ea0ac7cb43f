"""Figures as files: which ones there are for a world, and what the plot command refuses."""

from __future__ import annotations

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
from envs.registry import WORLDS, World
from experiments import drawing
from experiments.plot import PlotConfig, main
from experiments.store.policies import check_weights
from experiments.store.results import Results, save_results
from mgpo_jax.policy_files import read_policy, save_policy
from mgpo_jax.prompts import prompt_of, single_goal
from mgpo_jax.transformer import GoalTransformer, network_config

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
        save_results(tmp_path / name, results)
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
        *(f"tiny_{method}_evolution_task1.png" for method in ("ucb", "bbt")),
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


def test_worlds_without_pictures_get_curves_only(tmp_path: Path, save: Save, policy: Path) -> None:
    run = save("run", mazes(policy, env="plain"))
    main(PlotConfig(runs=(run,), out=tmp_path / "out"))
    assert names(tmp_path / "out") == {"plain_learning_curve.png"}


def test_episodes_are_those_of_the_policy_under_the_prompt(policy: Path) -> None:
    results = mazes(policy)
    play = drawing.player_of(results)
    goals = results.best_goals(0, 0)
    greedy = play(jax.random.key(0), results.task(0), goals, 3, True)
    assert greedy.trajectory.obs.shape == (3, 6, *ENV.spec.obs.shape)
    assert isinstance(greedy.return_, np.ndarray)
    assert np.ptp(greedy.trajectory.actions, axis=0).max() == 0  # mazes are deterministic
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
        (PlotConfig(runs=(run,), seed=2), "--seed 2: .* has 2 seeds"),
        (PlotConfig(runs=(run,), seed=-1), "--seed -1: .* has 2 seeds"),
        (PlotConfig(runs=(run,), tasks=(7,)), "tasks 0 to 1"),
        (PlotConfig(runs=(run,), tasks=(-1,)), "tasks 0 to 1"),
    ):
        with pytest.raises(UsageError, match=message):
            main(replace(config, out=tmp_path / "out"))
        assert not (tmp_path / "out").exists()
    with pytest.raises(DataError, match="no result folder"):
        main(PlotConfig(runs=(run, tmp_path / "nowhere"), out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
