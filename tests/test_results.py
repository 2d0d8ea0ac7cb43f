"""Results on disk: what is read is what was written, and what is damaged is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_results import GOALS, SIDE, TINY, made_results, save_format_1

import envs
from envs.episodes import replay
from envs.errors import DataError
from envs.gridworld.env import GridWorld
from envs.registry import WORLDS, World
from experiments.store.metrics import read_metrics
from experiments.store.results import (
    Results,
    load_results,
    read_summary,
    results_of,
    save_results,
)
from experiments.store.summary import printed, summarize
from experiments.store.tables import comparison
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.prompts import single_goal
from mgpo_jax.runner import adapt
from mgpo_jax.tasks import sample_tasks, task_at
from mgpo_jax.transformer import GoalTransformer, network_config

PUBLISHED = sorted((Path(__file__).parents[1] / "results").glob("*/*/results.npz"))
GRID = World(name="short", make=lambda: GridWorld(name="short", horizon=10))


@pytest.fixture(autouse=True)
def made_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The worlds that the results below name."""
    made, find = {"tiny": TINY, "short": GRID}, WORLDS.find
    monkeypatch.setattr(WORLDS, "find", lambda name: made.get(name) or find(name))


def save(folder: Path, results: Results) -> Path:
    save_results(folder, results)
    return folder


def assert_equal(found: Results, wanted: Results) -> None:
    for field in fields(Results):
        jax.tree.map(
            np.testing.assert_array_equal,
            getattr(found, field.name),
            getattr(wanted, field.name),
            is_leaf=lambda leaf: isinstance(leaf, str),
        )


def test_results_survive_the_disk(tmp_path: Path) -> None:
    results = replace(made_results(), summary={"regret": 0.5})
    folder = save(tmp_path / "run", results)
    loaded = load_results(folder)
    assert_equal(loaded, results)
    assert loaded.actions.dtype == np.uint8
    assert loaded.reached.counts.dtype == np.int32
    assert read_summary(folder) == {"regret": 0.5}
    assert (loaded.env, loaded.method, loaded.optimum_known) == ("tiny", "ucb", True)
    np.testing.assert_allclose(loaded.task_goals, GOALS / SIDE, rtol=1e-6)
    meta = json.loads((folder / "meta.json").read_text())
    assert meta["format"] == 2
    assert meta["versions"]["jax"] == jax.__version__
    assert not list(tmp_path.glob("*partial*"))


def test_results_without_what_may_be_missing_survive_the_disk(tmp_path: Path) -> None:
    """The optimum is unknown, actions were not kept, and the method has no prompts."""
    flags = {"choice": np.zeros((2, 2, 20), np.int32)}
    results = made_results(
        optimal_returns=np.full(2, np.nan),
        actions=None,
        reached=None,
        choices=flags,
        best=flags,
    )
    folder = save(tmp_path / "run", results)
    loaded = load_results(folder)
    assert_equal(loaded, results)
    assert not loaded.optimum_known
    assert loaded.best_goals(0, 0) is None
    with np.load(folder / "results.npz") as file:
        assert not {"optimal_returns", "keys", "actions", "reached_counts"} & {*file}


def test_results_are_never_overwritten(tmp_path: Path) -> None:
    folder = save(tmp_path / "run", made_results())
    before = (folder / "results.npz").read_bytes()
    with pytest.raises(DataError, match="run exists already"):
        save_results(folder, made_results("bpe"))
    assert (folder / "results.npz").read_bytes() == before


def test_best_prompts_are_those_after_an_episode() -> None:
    results = made_results()
    assert [len(results.best_goals(1, 0, episodes)) for episodes in (1, 9, 10, 20)] == [1, 1, 2, 2]
    np.testing.assert_allclose(results.best_goals(0, 1), [[3 / SIDE, 3 / SIDE], GOALS[1] / SIDE])
    best = {name: rows[:, :, 4::5] for name, rows in results.best.items()}  # 4 rounds of 5
    of_rounds = replace(results, best=best)
    lengths = [len(of_rounds.best_goals(1, 0, episodes)) for episodes in (1, 5, 6, 10, 11, 20)]
    assert lengths == [1, 1, 2, 2, 2, 2]


def test_the_most_improved_tasks_come_first() -> None:
    assert made_results().most_improved() == [1, 0]  # by 1.5 and 2
    assert made_results().most_improved(1) == [1]


def test_results_of_the_first_version_are_read(tmp_path: Path) -> None:
    results = made_results(actions=None, reached=None)
    loaded = load_results(save_format_1(tmp_path / "run", results))
    best = {name: array for name, array in results.best.items() if name != "greedy"}
    config = {"env": "tiny", "bandit": "ucb", "policy": None}
    assert_equal(loaded, replace(results, best=best, config=config))
    assert loaded.method == "ucb"
    np.testing.assert_allclose(loaded.task_goals, GOALS / SIDE, rtol=1e-6)


@pytest.mark.parametrize("path", PUBLISHED, ids=lambda path: "-".join(path.parts[-3:-1]))
def test_published_results_are_read(path: Path) -> None:
    if "kitchen" in path.parts[-3]:
        pytest.importorskip("mujoco")
    results = load_results(path.parent)
    num = results.returns.shape[1]
    assert results.optimum_known
    assert results.task_goals.shape[0] == num == len(jax.tree.leaves(results.task_set)[0])
    goals = results.best_goals(0, num - 1)
    if results.method != "bbt":  # which moves the last goal, too
        np.testing.assert_array_equal(goals[-1], results.task_goals[num - 1])
    (row,) = comparison([results.summary]).splitlines()[2:]
    assert f"| {results.env} | {results.method} |" in row
    regret = (results.optimal_returns - results.eval_returns[:, :, -1]).mean()
    assert results.summary["regret"] == pytest.approx(regret, abs=1e-5)


Damage = Callable[[Path], Any]


def rewrite(name: str, **changes: Any) -> Damage:
    names = {change.replace("__", "."): array for change, array in changes.items()}

    def damage(folder: Path) -> None:
        with np.load(folder / name) as file:
            arrays = {**file, **names}
        kept = {key: array for key, array in arrays.items() if array is not None}
        np.savez(folder / name, **kept)

    return damage


def overwrite(name: str, content: bytes) -> Damage:
    return lambda folder: (folder / name).write_bytes(content)


def truncate(folder: Path) -> None:
    path = folder / "results.npz"
    path.write_bytes(path.read_bytes()[:-200])


DAMAGES = {
    "no arrays": (lambda folder: (folder / "results.npz").unlink(), r"results\.npz is missing"),
    "no tasks": (lambda folder: (folder / "tasks.npz").unlink(), r"tasks\.npz is missing"),
    "no config": (lambda folder: (folder / "config.json").unlink(), r"config\.json is missing"),
    "no summary": (lambda folder: (folder / "summary.json").unlink(), r"summary\.json is missing"),
    "cut": (truncate, r"results\.npz is not a readable npz"),
    "empty": (overwrite("tasks.npz", b""), r"tasks\.npz is not a readable npz"),
    "no JSON": (overwrite("summary.json", b"{"), r"summary\.json is not readable JSON"),
    "no text": (overwrite("config.json", b"\xff\xfe"), r"config\.json is not readable JSON"),
    "a list": (overwrite("config.json", b"[]"), r"config\.json does not hold a JSON object"),
    "no world": (overwrite("config.json", b'{"method": "ucb"}'), "does not name the env"),
    "no method": (overwrite("config.json", b'{"env": "tiny"}'), "does not name the method"),
    "lacks": (rewrite("results.npz", best__prompt__goals=None), r"lacks best\.prompt\.goals"),
    "lacks the choice": (rewrite("results.npz", choice__greedy=None), r"lacks choice\.greedy"),
    "lacks a number": (rewrite("results.npz", eval_returns=None), "lacks eval_returns"),
    "axes": (
        rewrite("results.npz", best__prompt__mask=np.ones((2, 2, 20, 4), bool)),
        r"best\.prompt\.mask has shape \[2, 2, 20, 4\], which does not fit the axes SNRP \(.*P 3",
    ),
    "rounds": (
        rewrite("results.npz", choice__greedy=np.ones((2, 2, 19), bool)),
        r"greedy has shape \[2, 2, 19\], which does not fit the axes SNR\* \(.*R 20",
    ),
    "steps": (
        rewrite("results.npz", actions=np.ones((2, 3, 20, 6), np.uint8)),
        r"actions has shape \[2, 3, 20, 6\], which does not fit the axes SNET\*",
    ),
    "rank": (rewrite("results.npz", optimal_returns=np.float32(1)), "optimal_returns has shape"),
    "NaN": (rewrite("results.npz", eval_returns=np.full((2, 2, 2), np.nan)), "eval_returns holds"),
    "other tasks": (rewrite("tasks.npz", goal=np.zeros((3, 2))), r"goal has shape \[3, 2\].* 2 t"),
    "no table": (rewrite("results.npz", reached_table=None), "reached goals are incomplete"),
    "no place": (
        rewrite("results.npz", reached_index=np.full(320, 9, np.uint8)),
        "reached goals are incomplete",
    ),
    "miscounted": (
        rewrite("results.npz", reached_counts=np.ones((2, 2, 20), np.uint8)),
        "80 goals were reached, in 320 steps",
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_broken_results_are_named(tmp_path: Path, name: str) -> None:
    damage, message = DAMAGES[name]
    folder = save(tmp_path / "run", made_results())
    damage(folder)
    with pytest.raises(DataError, match=message):
        load_results(folder)


FIRST_DAMAGES = {
    "lacks": (rewrite("results.npz", best_goals=None), r"lacks best\.prompt\.goals"),
    "axes": (
        rewrite("results.npz", best_masks=np.ones((2, 2, 20, 4), bool)),
        r"best\.prompt\.mask has shape \[2, 2, 20, 4\], which does not fit the axes SNRP \(.*P 3",
    ),
    "no method": (overwrite("config.json", b'{"env": "tiny"}'), "does not name the method"),
}


@pytest.mark.parametrize("name", FIRST_DAMAGES)
def test_broken_results_of_the_first_version_are_named(tmp_path: Path, name: str) -> None:
    damage, message = FIRST_DAMAGES[name]
    folder = save_format_1(tmp_path / "run", made_results())
    damage(folder)
    with pytest.raises(DataError, match=message):
        load_results(folder)


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no result folder"):
        load_results(tmp_path / "nowhere")


def test_unreadable_metrics_are_named(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    for content in ("{", "[]\n", '{"loss": 1}\n', '{"step": "one"}\n', "3\n"):
        path.write_text(content)
        with pytest.raises(DataError, match=r"metrics\.jsonl is missing or not readable"):
            read_metrics(path)
    path.unlink()
    with pytest.raises(DataError, match=r"metrics\.jsonl is missing or not readable"):
        read_metrics(path)
    path.write_text('{"step": 10, "train/loss": 1.5}\n')
    assert read_metrics(path) == [{"step": 10, "train/loss": 1.5}]


def test_episodes_in_a_world_of_chance_can_be_played_again(tmp_path: Path) -> None:
    """From the keys and actions on disk, as they were."""
    env = envs.make("short")
    config = network_config(env.spec, embed_dim=8, num_layers=1, num_heads=2, max_prompt_length=3)
    prompt = single_goal(jnp.zeros(env.spec.goal_dim), 3)
    obs, actions = jnp.zeros((1, *env.spec.obs.shape)), jnp.zeros(1, jnp.int32)
    params = GoalTransformer(config).init(jax.random.key(0), prompt, obs, actions)
    tasks = sample_tasks(env, 3, 3)
    policy = LoadedPolicy(config, params, {})
    outcome = adapt(env, policy, tasks, "gcbc", seeds=2, episodes=4, eval_every=4)
    made = {"env": "short", "method": "gcbc"}
    save_results(tmp_path / "run", results_of(outcome, made, env, tasks, np.ones(3)))
    found = load_results(tmp_path / "run")
    again = jax.jit(lambda *args: replay(args[0], env, *args[1:]))
    starts = set()
    for place in np.ndindex(found.returns.shape):
        real = found.actions[place] < 255
        task = jax.tree.map(jnp.asarray, task_at(found.task_set, place[1]))
        key = jax.random.wrap_key_data(jnp.asarray(found.keys[place]))
        episode = again(
            key, task, jnp.where(real, found.actions[place], 0).astype(jnp.int32), real.sum()
        )
        assert episode.return_ == found.returns[place]
        assert episode.trajectory.length == real.sum()
        starts.add(tuple(episode.trajectory.obs[0].tolist()))
    assert len(starts) > 10


def summary_of(results: Results) -> dict[str, Any]:
    return summarize(results, policy_sha256="0", num_episodes=88, num_failed=0, cpu_seconds=2.0)


def test_summaries_are_of_the_results() -> None:
    results = made_results(eval_episodes=np.array([1, 40]))
    summary = summary_of(results)
    assert (summary["num_tasks"], summary["num_seeds"], summary["num_episodes"]) == (2, 2, 20)
    assert (summary["initial_return"], summary["final_return"]) == (-2.0, -0.25)
    assert summary["final_return_std_over_seeds"] == pytest.approx(0.25)
    assert summary["optimal_return"] == pytest.approx(0.6)
    assert summary["regret"] == summary["regret_after_40"] == pytest.approx(0.85)
    assert summary["solved_optimally"] == 0.25  # 1 is above the optimum of 0.7 made up here
    assert summary["episodes_per_cpu_second"] == 44
    text = printed(summary)
    assert text.splitlines()[0] == "tiny, ucb: 2 tasks x 2 seeds x 20 episodes"
    assert "regret           0.850 ± 0.250" in text
    assert "solved optimally 25 %" in text
    assert "broke down" not in text
    (row,) = comparison([summary]).splitlines()[2:]
    assert "| 0.600 | 0.850 | 0.850 | 25 % |  |" in row


def test_regret_after_40_is_unknown_where_nothing_was_judged_then() -> None:
    summary = summary_of(made_results())
    assert summary["regret_after_40"] is None
    assert "  after 40       -" in printed(summary)


def test_episodes_of_broken_worlds_are_printed() -> None:
    assert "failed episodes  3 (the world broke down)" in printed(
        {**summary_of(made_results()), "failed_episodes": 3}
    )


def test_nothing_is_compared_with_an_unknown_optimum() -> None:
    summary = summary_of(made_results(optimal_returns=np.array([np.nan, np.nan])))
    unknown = {name for name, value in summary.items() if value is None}
    assert unknown == {
        "optimal_return", "regret", "regret_std_over_seeds", "regret_after_40", "solved_optimally",
    }  # fmt: skip
    assert not any(word in printed(summary) for word in ("optim", "regret", "nan"))
    (row,) = comparison([summary]).splitlines()[2:]
    assert row.endswith("|  |  |  |  |  |")


def test_the_table_stands_beside_the_papers_numbers() -> None:
    summaries = [{**summary_of(made_results(name)), "env": "maze15"} for name in ("ucb", "gcbc")]
    rows = comparison(summaries).splitlines()[2:]
    assert [row.split("|")[-2].strip() for row in rows] == ["-0.41 ± 0.10", "-2.63"]
