"""Results on disk: round trips, and errors that name the damage."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_results import ENV, GOALS, SIDE, TINY, made_results, save_format_1

import envs
from envs.episodes import replay
from envs.errors import DataError, UsageError
from envs.gridworld.env import GridWorld
from envs.maze.env import MazeRunner
from envs.registry import WORLDS, Judgement, World
from envs.wrappers import behind_noise
from experiments.store.metrics import read_metrics
from experiments.store.policies import load_policy_of
from experiments.store.result_files import PARTS, load_results, save_results
from experiments.store.results import Results, results_of
from experiments.store.summary import read_summary, summarize
from experiments.store.summary_text import printed
from mgpo_jax.kinds import MULTI_GOAL
from mgpo_jax.methods import BbtHyper, policy_kind
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.policy_files import read_policy, save_policy
from mgpo_jax.prompts import single_goal
from mgpo_jax.runner import adapt
from mgpo_jax.settings import check_settings
from mgpo_jax.tasks import sample_tasks, task_at
from mgpo_jax.transformer import GoalTransformer

PUBLISHED = sorted((Path(__file__).parents[1] / "results").glob("*/*/results.npz"))
GRID = World(name="short", make=lambda: GridWorld(name="short", horizon=60))


@pytest.fixture(autouse=True)
def made_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The worlds that the results below name."""
    for world in (TINY, GRID):
        monkeypatch.setitem(WORLDS._registered, world.name, world)


def with_summary(results: Results, sha256: str = "0" * 64) -> Results:
    return replace(results, summary=summary_of(results, sha256))


def save(folder: Path, results: Results) -> Path:
    save_results(folder, with_summary(results))
    return folder


def assert_equal(found: Results, wanted: Results) -> None:
    names = {field.name for field in fields(Results)} - {"folder", "summary"}
    for name in names:
        jax.tree.map(
            np.testing.assert_array_equal,
            getattr(found, name),
            getattr(wanted, name),
            is_leaf=lambda leaf: isinstance(leaf, str),
        )


def test_results_survive_the_disk(tmp_path: Path) -> None:
    results = made_results()
    folder = save(tmp_path / "run", results)
    loaded = load_results(folder)
    assert_equal(loaded, results)
    assert loaded.folder == folder
    assert loaded.actions.dtype == np.uint8
    assert loaded.reached.counts.dtype == np.int32
    assert loaded.summary == read_summary(folder)
    assert loaded.summary["regret"] == pytest.approx(0.85)
    assert (loaded.env, loaded.method, loaded.optimum_known) == ("tiny", "ucb", True)
    assert "num_parts" in vars(loaded)  # the world was not asked again
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
    with pytest.raises(DataError, match="run already exists"):
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
    folder = save_format_1(tmp_path / "run", results)
    (folder / "summary.json").write_text(json.dumps(summary_of(results)))
    loaded = load_results(folder)
    best = {name: array for name, array in results.best.items() if name != "greedy"}
    config = {"env": "tiny", "bandit": "ucb", "policy": None}
    assert_equal(loaded, replace(results, best=best, config=config))
    assert loaded.method == "ucb"
    assert loaded.num_parts.tolist() == [0, 0]
    np.testing.assert_allclose(loaded.task_goals, GOALS / SIDE, rtol=1e-6)


@pytest.mark.parametrize("path", PUBLISHED, ids=lambda path: "-".join(path.parts[-3:-1]))
def test_published_results_are_read(path: Path) -> None:
    if "kitchen" in path.parts[-3]:
        pytest.importorskip("mujoco")
    in_crafter = "crafter" in path.parts[-3]
    if in_crafter:
        pytest.importorskip("craftax")
    results = load_results(path.parent)
    num = results.returns.shape[1]
    assert results.optimum_known != in_crafter
    assert results.task_goals.shape[0] == num == len(jax.tree.leaves(results.task_set)[0])
    goals = results.best_goals(0, num - 1)
    assert (goals is not None) == (policy_kind(results.method) == MULTI_GOAL)
    if goals is not None and results.method != "bbt":  # which moves the last goal, too
        np.testing.assert_array_equal(goals[-1], results.task_goals[num - 1])
    if in_crafter:
        assert results.summary["regret"] is None
        return
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
    "no world": (overwrite("config.json", b'{"method": "ucb"}'), "lacks env"),
    "no method": (overwrite("config.json", b'{"env": "tiny"}'), "lacks method"),
    "lacks": (rewrite("results.npz", best__prompt__goals=None), r"lacks best\.prompt\.goals"),
    "lacks the choice": (rewrite("results.npz", choice__greedy=None), r"lacks choice\.greedy"),
    "lacks a number": (rewrite("results.npz", eval_returns=None), "lacks eval_returns"),
    "axes": (
        rewrite("results.npz", best__prompt__mask=np.ones((2, 2, 20, 4), bool)),
        r"best\.prompt\.mask has shape \[2, 2, 20, 4\], wanted \[seed 2, task 2, round 20, slot 3\]",
    ),
    "rounds": (
        rewrite("results.npz", choice__greedy=np.ones((2, 2, 19), bool)),
        r"has shape \[2, 2, (19|20).*\], wanted \[seed 2, task 2, round (19|20), ",
    ),
    "steps": (
        rewrite("results.npz", actions=np.ones((2, 3, 20, 6), np.uint8)),
        r"actions has shape \[2, 3, 20, 6\], wanted \[seed 2, task 2, episode 20, step, \.\.\.\]",
    ),
    "rank": (rewrite("results.npz", optimal_returns=np.float32(1)), "optimal_returns has shape"),
    "NaN": (rewrite("results.npz", eval_returns=np.full((2, 2, 2), np.nan)), "eval_returns holds"),
    "other tasks": (
        rewrite("tasks.npz", goal=np.zeros((3, 2))),
        r"goal has shape \[3, 2\], wanted \[task 2, \.\.\.\]",
    ),
    "no table": (rewrite("results.npz", reached_table=None), "reached goals are incomplete"),
    "no place": (
        rewrite("results.npz", reached_index=np.full(320, 9, np.uint8)),
        "reached_index holds 9, reached_table has 4 goals",
    ),
    "miscounted": (
        rewrite("results.npz", reached_counts=np.ones((2, 2, 20), np.uint8)),
        "80 goals were reached, in 320 steps",
    ),
}


def configured(**changes: Any) -> Damage:
    def damage(folder: Path) -> None:
        path = folder / "config.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))

    return damage


TWO = (2, 2, 20)
DAMAGES |= {
    "NaN for an episode": (
        rewrite("results.npz", eval_episodes=np.array([np.nan, 20])),
        "eval_episodes must hold integers, found float64",
    ),
    "episodes that fall": (
        rewrite("results.npz", eval_episodes=np.array([20, 1])),
        r"eval_episodes must ascend from 1 to at most 20, found \[20, 1\]",
    ),
    "an episode too many": (
        rewrite("results.npz", eval_episodes=np.array([1, 2**63 - 1])),
        r"eval_episodes must ascend from 1 to at most 20",
    ),
    "dates": (
        rewrite("results.npz", returns=np.zeros(TWO, "M8[s]")),
        r"returns must hold numbers, found datetime64\[s\]",
    ),
    "complex goals": (
        rewrite("results.npz", best__prompt__goals=np.zeros((*TWO, 3, 2), complex)),
        r"best\.prompt\.goals must hold numbers, found complex128",
    ),
    "goals far away": (
        rewrite("results.npz", best__prompt__goals=np.full((*TWO, 3, 2), 1e19)),
        r"best\.prompt\.goals holds 1e\+19 at seed 0, task 0, round 0, slot 2, number 0, must be",
    ),
    "no goals": (
        rewrite("results.npz", best__prompt__goals=np.full((*TWO, 3, 2), np.nan)),
        r"best\.prompt\.goals holds nan at seed 0, task 0, round 0, slot 2, number 0, must be",
    ),
    "prompts without a goal": (
        rewrite("results.npz", best__prompt__mask=np.zeros((*TWO, 3), bool)),
        r"best\.prompt\.mask leaves no goal at seed 0, task 0, round 0",
    ),
    "parts below zero": (
        rewrite("results.npz", num_parts=np.array([3, -1])),
        "num_parts holds -1 at task 1, must be from 0 to",
    ),
    "parts of other tasks": (
        rewrite("results.npz", num_parts=np.array([3, 3, 3])),
        r"num_parts has shape \[3\], wanted \[task 2\]",
    ),
    "mazes of words": (
        rewrite("tasks.npz", maze=np.full((2, 7, 7), "wall")),
        "maze must hold numbers or booleans, found <U4",
    ),
    "another number of seeds": (configured(seeds=3), r"returns has shape .* wanted \[seed 3, task"),
    "outside": (configured(env="../../x"), r"config\.json: env is not a name that is allowed here"),
    "an escape": (configured(env="\x1b[31m"), r"env is not a name that is allowed .* '\\x1b\[31m'"),
    "a long name": (configured(env="x" * 300), "env is not a name that is allowed here"),
    "an unknown world": (configured(env="tinny"), r"config\.json: unknown world 'tinny'; did you"),
    "a place": (
        configured(env="no_such_module:WORLD"),
        r"names the world 'no_such_module:WORLD', .*; give it with --env no_such_module:WORLD",
    ),
    "a method with a slash": (
        configured(method="u/cb"),
        "method is not a name that is allowed here",
    ),
    "a formula": (configured(method=r"$\frac{$"), "method is not a name that is allowed here"),
    "an unknown method": (configured(method="ucbb"), "unknown method 'ucbb'; did you mean 'ucb'"),
    "a number for a policy": (configured(policy=3), r"config\.json: policy must be text, found 3"),
    "a list for a policy": (
        configured(policy=[]),
        r"config\.json: policy must be text, found \[\]",
    ),
    "no text in meta": (overwrite("meta.json", b"[]"), r"meta\.json does not hold a JSON object"),
    "of a later version": (
        overwrite("meta.json", b'{"format": 3}'),
        r"meta\.json has format 3, this version reads 1 and 2",
    ),
    "nested without end": (overwrite("config.json", b"[" * 5000), "is not readable JSON"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_broken_results_are_named(tmp_path: Path, name: str) -> None:
    damage, message = DAMAGES[name]
    folder = save(tmp_path / "run", made_results())
    damage(folder)
    with pytest.raises(DataError, match=message) as caught:
        load_results(folder)
    assert "\n" not in str(caught.value)


def test_what_is_not_used_may_hold_anything(tmp_path: Path) -> None:
    """A method need not care for slots that it does not use, prompts that only act, and its own numbers."""
    results = made_results()
    unused = ~results.best["prompt.mask"][..., None]
    goals = np.where(unused, np.float32(np.nan), results.best["prompt.goals"])
    goals[unused[..., 0], 1] = np.inf
    own = np.full((2, 2, 20, 4), -np.inf)
    parts = {**results.best, "prompt.goals": goals, "score": own}
    acted = {**parts, "prompt.goals": np.full_like(goals, np.nan)}
    made = replace(results, choices=acted, best=parts)
    loaded = load_results(save(tmp_path / "run", made))
    assert_equal(loaded, made)
    assert np.isfinite(loaded.best_goals(0, 0)).all()


def test_tasks_of_results_are_checked_like_those_of_a_user(tmp_path: Path) -> None:
    folder = save(tmp_path / "run", made_results())
    rewrite("tasks.npz", goal=np.array([(1, 5), (99, 1)]))(folder)
    with pytest.raises(DataError, match=r"tasks\.npz: task 1: goal \(99, 1\) is not a free cell"):
        _ = load_results(folder).task_set


def test_only_what_is_asked_for_is_read(tmp_path: Path) -> None:
    """Damage in an array that nobody asks for is not seen."""
    folder = save(tmp_path / "run", made_results())
    rewrite("results.npz", actions=np.full((2, 2, 20, 6), "no"))(folder)
    found = load_results(folder, PARTS - {"actions", "reached"})
    assert (found.actions, found.reached) == (None, None)
    assert found.choices.keys() == found.best.keys() == made_results().best.keys()
    assert load_results(folder, ()).choices == {}
    with pytest.raises(DataError, match="actions must hold numbers, found <U2"):
        load_results(folder)


def policy_in(folder: Path, seed: int) -> str:
    """A policy for the world ``tiny``; returns the hash of its weights."""
    config = network_config(ENV.spec, embed_dim=8, num_layers=1, max_prompt_length=3)
    prompt = single_goal(jnp.zeros(ENV.spec.goal_dim), 3)
    obs, actions = jnp.zeros((1, *ENV.spec.obs.shape)), jnp.zeros(1, jnp.int32)
    params = GoalTransformer(config).init(jax.random.key(seed), prompt, obs, actions)
    save_policy(folder, config, params, {})
    return read_policy(folder).sha256


def test_a_policy_is_found_where_it_was_moved_with_its_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Named relative to the working directory, then moved with the results, and read from elsewhere."""
    (tmp_path / "old").mkdir()
    monkeypatch.chdir(tmp_path / "old")
    sha256 = policy_in(Path("policy"), 0)
    results = made_results(config={"env": "tiny", "method": "ucb", "policy": "policy"})
    save_results(Path("runs/one"), with_summary(results, sha256))
    monkeypatch.chdir(tmp_path)
    loaded = load_results(tmp_path / "old/runs/one")
    assert load_policy_of(loaded, TINY).sha256 == sha256
    (tmp_path / "old").rename(tmp_path / "new")
    loaded = load_results(tmp_path / "new/runs/one")
    assert load_policy_of(loaded, TINY).sha256 == sha256
    # Another policy at the old place is not taken for it.
    policy_in(tmp_path / "old/policy", 1)
    assert load_policy_of(loaded, TINY).folder.resolve() == (tmp_path / "new/policy").resolve()
    (tmp_path / "new/policy").rename(tmp_path / "mine")
    with pytest.raises(
        DataError, match=r"are not those .*: give the folder of the policy .*, using --policy"
    ):
        load_policy_of(loaded, TINY)
    assert load_policy_of(loaded, TINY, tmp_path / "mine").sha256 == sha256
    with pytest.raises(DataError, match=r"old/policy .* are not those that .*--policy"):
        load_policy_of(loaded, TINY, tmp_path / "old/policy")
    (tmp_path / "old/policy").rename(tmp_path / "gone")
    with pytest.raises(
        DataError, match=r"the policy of .* tiny ucb is not in .*; give .* --policy"
    ):
        load_policy_of(loaded, TINY)


def test_the_first_episode_may_be_judged_twice(tmp_path: Path) -> None:
    """Before it and after it, as where a choice is judged after every episode."""
    results = made_results()
    save_results(tmp_path / "one", with_summary(results, "0" * 64))
    rewrite("results.npz", eval_episodes=np.array([1, 1]))(tmp_path / "one")
    np.testing.assert_array_equal(load_results(tmp_path / "one").eval_episodes, [1, 1])


def test_a_damaged_policy_does_not_hide_a_sound_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside the moved results lies a damaged one, at the old place the sound one."""
    monkeypatch.chdir(tmp_path)
    sha256 = policy_in(Path("policy"), 0)
    results = made_results(config={"env": "tiny", "method": "ucb", "policy": "policy"})
    save_results(Path("runs/one"), with_summary(results, sha256))
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "runs").rename(tmp_path / "elsewhere/runs")
    policy_in(tmp_path / "elsewhere/policy", 0)
    (tmp_path / "elsewhere/policy/weights.npz").write_bytes(b"")
    loaded = load_results(tmp_path / "elsewhere/runs/one")
    assert load_policy_of(loaded, TINY).folder.resolve() == (tmp_path / "policy").resolve()
    (tmp_path / "policy/config.json").write_text("{")
    with pytest.raises(DataError, match=r"elsewhere/.*weights\.npz is missing, truncated"):
        load_policy_of(loaded, TINY)


FIRST_DAMAGES = {
    "lacks": (rewrite("results.npz", best_goals=None), r"lacks best\.prompt\.goals"),
    "axes": (
        rewrite("results.npz", best_masks=np.ones((2, 2, 20, 4), bool)),
        r"best_masks has shape \[2, 2, 20, 4\], wanted \[seed 2, task 2, round 20, slot 3\]",
    ),
    "no method": (overwrite("config.json", b'{"env": "tiny"}'), "lacks method"),
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


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("", " has no rows"),
        ("{", ", line 1 is not readable JSON"),
        ("[]\n", ", line 1 does not hold a JSON object"),
        ('{"loss": 1}\n', ", line 1: step must be an integer above 0, found none"),
        ('{"step": "one"}\n', ", line 1: step must be a number, found 'one'"),
        ('{"step": 1, "loss": NaN}\n', ", line 1: loss must be a finite number, found nan"),
        ('{"step": 2}\n{"step": 2}\n', ", line 2: step must be an integer above 2, found 2"),
        ('{"step": 2, "loss": 1}\n{"step": 4}\n', ", line 2 lacks loss"),
        ('{"step": 2, "loss": 1}\n{"step": 4, "lo', ", line 2 is not readable JSON"),
    ],
)
def test_unreadable_metrics_are_named(tmp_path: Path, content: str, says: str) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text(content)
    with pytest.raises(DataError, match=re.escape(f"{path}{says}; resume the run with")):
        read_metrics(path, ["loss"])


def test_metrics_come_back(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    with pytest.raises(DataError, match=r"metrics\.jsonl is missing; resume the run"):
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
    save(tmp_path / "run", results_of(outcome, made, env, tasks, np.ones(3)))
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


def test_episodes_behind_noise_can_be_played_again(tmp_path: Path) -> None:
    """The settings of results say behind which noise their world was."""
    noise = {"obs_noise": 0.1, "action_noise": 0.5}
    policy_in(tmp_path / "policy", 0)
    policy, made = read_policy(tmp_path / "policy"), made_results()
    env = behind_noise(ENV, **noise)
    hyper = {"steer": 0}  # which compiles faster
    outcome = adapt(env, policy, made.task_set, "plan", hyper, seeds=1, episodes=3, eval_every=3)
    settings = {"env": "tiny", "method": "plan", **noise}
    save(tmp_path / "run", results_of(outcome, settings, env, made.task_set, np.ones(2)))
    found = load_results(tmp_path / "run")
    assert found.environment == env
    np.testing.assert_array_equal(found.num_scored, outcome.num_scored)
    for place in np.ndindex(found.returns.shape):
        assert found.replay(*place).return_ == found.returns[place]
    assert made.environment is ENV


def summary_of(results: Results, sha256: str = "0" * 64) -> dict[str, Any]:
    return summarize(results, policy_sha256=sha256, num_episodes=88, num_failed=0, cpu_seconds=2.0)


def test_the_widest_search_that_is_allowed_can_be_read(tmp_path: Path) -> None:
    """Of the smallest population, whose steps vary most."""
    with pytest.raises(UsageError, match=r"std.init must be at most 1000, found 1000000000.0"):
        check_settings(BbtHyper(std_init=1e9))
    policy_in(tmp_path / "policy", 0)
    policy, made = read_policy(tmp_path / "policy"), made_results()
    hyper = {"population_size": 2, "std_init": 1000.0}
    outcome = adapt(ENV, policy, made.task_set, "bbt", hyper, seeds=2, episodes=40, eval_every=40)
    settings = {"env": "tiny", "method": "bbt"}
    results = results_of(outcome, settings, ENV, made.task_set, np.ones(2))
    loaded = load_results(save(tmp_path / "run", results))
    assert np.abs(loaded.choices["prompt.goals"]).max() > 1000
    assert_equal(loaded, results)


def test_a_summary_asks_the_world_once_which_tasks_can_be_solved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    traced: list[None] = []
    monkeypatch.setattr(
        MazeRunner, "solvable", lambda self, task: (traced.append(None), jnp.ones((), bool))[1]
    )
    assert summary_of(made_results())["unsolvable_tasks"] == 0
    assert len(traced) == 1


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
    assert "failed" not in text


def test_regret_after_40_is_unknown_where_nothing_was_judged_then() -> None:
    summary = summary_of(made_results())
    assert summary["regret_after_40"] is None
    assert "  after 40       -" in printed(summary)


def in_parts(**changes: Any) -> Results:
    """2 seeds of tasks of 3 and 7 objects."""
    order = np.array([[2, 0, 5, -1, -1, -1, -1], [6, 5, 4, 3, 2, 1, 0]], np.int32)
    flags = {"choice": np.zeros((2, 2, 20), np.int32)}
    final = np.array([[1, 6 / 7], [1 / 3, 1]], np.float32)
    made = {
        "tasks": {"order": order},
        "config": {"env": "short", "method": "gcbc"},
        "eval_returns": np.stack([np.zeros((2, 2), np.float32), final], axis=-1),
        "choices": flags,
        "best": flags,
        "reached": None,
    }
    return made_results(**{**made, **changes})


def test_parts_that_were_done_are_counted_and_printed(tmp_path: Path) -> None:
    folder = save(tmp_path / "run", in_parts())
    with np.load(folder / "results.npz") as file:
        assert file["num_parts"].tolist() == [3, 7]
    loaded = load_results(folder)
    assert loaded.num_parts.tolist() == [3, 7]
    shares = [(1.0, 4), (0.75, 4), (0.75, 4), (1.0, 2), (1.0, 2), (1.0, 2), (0.5, 2)]
    assert loaded.summary["part_shares"] == shares
    lines = printed(loaded.summary).splitlines()
    first = lines.index(
        "parts in order   share of searches that did the first k parts (searches with at least k parts)"
    )
    assert lines[first + 1] == "  p1             1.00 (4)"
    assert lines[first + 7] == "  p7             0.50 (2)"
    assert lines[first + 8].startswith("speed")


def test_parts_are_not_counted_where_only_a_mean_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten episodes of 3 parts each with a mean of 1/3: nobody knows how many did one part."""
    several = {"env": "short", "method": "gcbc", "eval_episodes": 10}
    folder = save(tmp_path / "run", in_parts(config=several))
    loaded = load_results(folder)
    assert loaded.num_parts.tolist() == [3, 7]
    assert loaded.summary["part_shares"] is None
    assert "parts" not in printed(loaded.summary)
    often = replace(GRID, judged=Judgement(episodes=10))
    monkeypatch.setitem(WORLDS._registered, "short", often)
    assert summary_of(in_parts())["part_shares"] is None
    assert summary_of(in_parts(config={**several, "eval_episodes": 1}))["part_shares"] is not None


def test_a_world_that_is_not_rewarded_in_parts_has_none(tmp_path: Path) -> None:
    folder = save(tmp_path / "run", made_results())
    assert load_results(folder).num_parts.tolist() == [0, 0]
    assert read_summary(folder)["part_shares"] is None
    assert "parts" not in printed(read_summary(folder))


def test_episodes_of_broken_worlds_are_printed() -> None:
    assert "failed episodes  3 (the simulation failed)" in printed(
        {**summary_of(made_results()), "failed_episodes": 3}
    )


def test_nothing_is_compared_with_an_unknown_optimum() -> None:
    summary = summary_of(made_results(optimal_returns=np.array([np.nan, np.nan])))
    unknown = {name for name, value in summary.items() if value is None}
    assert unknown == {
        "optimal_return", "regret", "regret_std_over_seeds", "regret_after_40", "solved_optimally",
        "part_shares",
    }  # fmt: skip
    assert not any(word in printed(summary) for word in ("optim", "regret", "nan"))
