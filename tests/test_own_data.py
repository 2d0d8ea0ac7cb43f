"""``experiments.data``: importing logs, exporting and importing again, descriptions, and each fault."""

from __future__ import annotations

import importlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envs.errors import DataError, UsageError
from experiments import runtime
from experiments.describing import described
from experiments.dropped_ends import wrong_ends
from experiments.importing import import_dataset
from experiments.soundness import examine
from experiments.store.data_settings import ImportConfig, check_import
from mgpo_jax.dataset import load_dataset, save_dataset
from mgpo_jax.files import hash_file
from mgpo_jax.manifest import DroppedEnds

LENGTHS = (3, 2, 4)
SPEC = {"name": "toy", "horizon": 4}


def logged(num=3, seed=0, discrete=False):
    """Episodes by hand: observation t of episode e is [10 e + t, t, 1]; actions and rewards are random."""
    rng = np.random.default_rng(seed)
    found = []
    for index in range(num):
        length = LENGTHS[index % 3]
        time = np.arange(length + 1)
        actions = rng.integers(0, 4, length) if discrete else rng.uniform(-1, 1, (length, 2))
        ends = time[:length] == length - 1
        found.append(
            {
                "observations": np.stack([10 * index + time, time, 0 * time + 1], 1).astype(
                    np.float32
                ),
                "actions": actions,
                "rewards": -np.ones(length),
                "terminals": ends & (index == 0),
                "timeouts": ends & (index > 0),
            }
        )
    return found


def flat(episodes, with_next=True):
    """Episodes one after the other, as D4RL has them: observations before each action alone."""
    joined = {
        name: np.concatenate([e[name][: len(e["actions"])] for e in episodes])
        for name in episodes[0]
    }
    if with_next:
        joined["next_observations"] = np.concatenate([e["observations"][1:] for e in episodes])
    return joined


def imported(source, out="out", **settings):
    settings = settings or {"goal_columns": (0, 1)}
    config = ImportConfig(source=str(source), out=Path(out), **settings)
    check_import(config)
    said = import_dataset(config)
    dataset, manifest = load_dataset(Path(out))
    return dataset, manifest, said


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runtime, "configure", lambda: None)


def assert_same(a, b):
    assert a.arrays.keys() == b.arrays.keys()
    for name, array in a.arrays.items():
        assert array.dtype == b.arrays[name].dtype, name
        np.testing.assert_array_equal(array, b.arrays[name], name)


def test_flat_arrays_by_hand():
    np.savez("logs.npz", **flat(logged()))
    dataset, manifest, said = imported("logs.npz")
    assert "3 trajectories of 2 to 4 steps, 9 in all" in said
    assert dataset.lengths.tolist() == [3, 2, 4]
    np.testing.assert_array_equal(dataset.obs[:, 0], [0, 1, 2, 10, 11, 20, 21, 22, 23])
    np.testing.assert_array_equal(dataset.last_obs, [[3, 3, 1], [12, 2, 1], [24, 4, 1]])
    # What is achieved is what is seen after the action.
    np.testing.assert_array_equal(dataset.achieved_goals[:3], [[1, 1], [2, 2], [3, 3]])
    np.testing.assert_array_equal(dataset.outcomes, dataset.achieved_goals)
    assert dataset.goal_reached.all()
    assert dataset.terminated.tolist() == [True, False, False]
    assert dataset.truncated.tolist() == [False, True, True]
    assert manifest["spec"]["horizon"] == 4
    assert manifest["imported"]["goal"] == [0, 1]


def test_an_episode_of_t_observations_loses_its_last_action():
    np.savez("logs.npz", **flat(logged(), with_next=False))
    dataset, _, said = imported("logs.npz")
    assert "3 episodes have no observation after their last action" in said
    assert dataset.lengths.tolist() == [2, 1, 3]
    np.testing.assert_array_equal(dataset.last_obs[:, 0], [2, 11, 23])
    assert not dataset.terminated.any()  # the ends were left out


def test_next_observations_are_not_those_of_named_arrays():
    logs = flat(logged())
    np.savez("logs.npz", **logs, qpos=0 * logs["observations"])
    dataset, _, said = imported("logs.npz", goal_columns=(0,), obs_arrays=("qpos",))
    assert "3 episodes have no observation after their last action" in said
    assert dataset.lengths.tolist() == [2, 1, 3]
    assert not dataset.last_obs.any()


def test_next_observations_of_another_size_are_refused():
    logs = flat(logged())
    np.savez("logs.npz", **{**logs, "next_observations": logs["next_observations"][:, :2]})
    with pytest.raises(
        DataError, match=r"episode 0: next observations have shape \[2\], obs.* \[3\]"
    ):
        imported("logs.npz")


def test_a_folder_of_episodes_is_the_same_dataset_as_flat_arrays():
    np.savez("logs.npz", **flat(logged()))
    Path("episodes").mkdir()
    for index, episode in enumerate(logged()):
        np.savez(f"episodes/run_{index}.npz", **episode)
    assert_same(imported("logs.npz")[0], imported("episodes", "other")[0])


def test_goals_with_one_for_the_start_are_those_after_each_action():
    """Arrays named like those of our exports, with a row for each observation."""
    Path("episodes").mkdir()
    for index, episode in enumerate(logged()):
        goals = episode["observations"][:, :2]
        np.savez(f"episodes/{index}.npz", **episode, achieved_goals=goals)
    dataset, _, _ = imported("episodes", goal_columns=())
    np.testing.assert_array_equal(dataset.achieved_goals[:3], [[1, 1], [2, 2], [3, 3]])
    np.savez("episodes/0.npz", **logged()[0], achieved_goals=np.zeros((2, 2)))
    with pytest.raises(DataError, match="achieved_goals has 2 rows, wanted one for each of 3 act"):
        imported("episodes", "other", goal_columns=())


def test_single_numbers_in_a_file_are_left_out():
    np.savez("logs.npz", **flat(logged()), gamma=0.99)
    dataset, _, _ = imported("logs.npz")
    assert dataset.lengths.tolist() == [3, 2, 4]


def test_parquet_files_are_the_same_dataset():
    pyarrow = pytest.importorskip("pyarrow", reason='needs `pip install -e ".[parquet]"`')
    from pyarrow import parquet

    np.savez("logs.npz", **flat(logged()))
    Path("episodes").mkdir()
    for index, episode in enumerate(logged()):
        columns = {name: rows.tolist() for name, rows in episode.items()}
        for name in columns.keys() - {"observations"}:
            columns[name].append(None)  # there is nothing after the last observation
        parquet.write_table(pyarrow.table(columns), f"episodes/run_{index}.parquet")
    assert_same(imported("logs.npz")[0], imported("episodes", "other")[0])


def test_hdf5_is_the_same_dataset_and_its_groups_have_names():
    h5py = pytest.importorskip("h5py", reason='needs `pip install -e ".[minari]"`')
    arrays = flat(logged())
    np.savez("logs.npz", **arrays)
    with h5py.File("logs.hdf5", "w") as file:
        for name, rows in arrays.items():
            file[name] = rows
        file["infos/place"] = np.arange(9)
        file["metadata/note"] = "text"
    assert_same(imported("logs.npz")[0], imported("logs.hdf5", "other")[0])
    with pytest.raises(DataError, match=r"--goal-array place gives .*\[3, 1\], wanted .*\[4, G\]"):
        imported("logs.hdf5", "third", goal_array="place")


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("form", ["npz", "minari"])
def test_export_and_import_is_the_identity(form, discrete):
    if form == "minari":
        pytest.importorskip("minari", reason='needs `pip install -e ".[minari]"`')
    from experiments.exporting_data import export_dataset

    np.savez("logs.npz", **flat(logged(discrete=discrete)))
    first, manifest, _ = imported("logs.npz", goal_columns=(1,), horizon=7, cut=False)
    rng = np.random.default_rng(1)
    hashes = np.array([5, 6, 2**63 + 1], np.uint64)
    for number, dataset in enumerate(
        (
            first,
            replace(first, rewards=None, terminated=None, truncated=None),
            replace(
                first,
                obs=rng.integers(0, 255, (9, 33, 34, 3), dtype=np.uint8),  # as large as a picture
                last_obs=rng.integers(0, 255, (3, 33, 34, 3), dtype=np.uint8),
                task_hashes=hashes,
                goal_reached=rng.random(9) < 0.5,
                outcomes=rng.normal(size=(9, 1)).astype(np.float32),
                intended=first.actions[::-1],
            ),
        )
    ):
        folder, out = Path(f"mine{number}"), Path(f"logs{number}" + ".npz" * (form == "npz"))
        save_dataset(folder, dataset, {"spec": manifest["spec"]}, mapped=True)
        before = hash_file(folder / "obs.npy")
        export_dataset(folder, out)
        again, after, _ = imported(out, f"again{number}", name=manifest["spec"]["name"])
        assert_same(again, load_dataset(folder)[0])
        assert after["spec"] == manifest["spec"]
        assert after["sha256"] == json.loads((folder / "manifest.json").read_text())["sha256"]
        assert hash_file(folder / "obs.npy") == before


def test_minari_dictionaries_start_values_and_ids(monkeypatch):
    """A goal environment's observations; discrete actions that count from 2; found by its id."""
    minari = pytest.importorskip("minari", reason='needs `pip install -e ".[minari]"`')
    import gymnasium
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(Path("minari").absolute()))
    spaces = gymnasium.spaces
    box = spaces.Box(-np.inf, np.inf, (2,))
    rows = np.arange(8, dtype=np.float32).reshape(4, 2)
    episode = EpisodeBuffer(
        observations={"observation": rows, "achieved_goal": -rows, "desired_goal": rows},
        actions=np.array([2, 4, 3]),
        rewards=[0, 0, 1],
        terminations=[False, False, True],
        truncations=[False] * 3,
        infos={"deep": {"place": np.arange(4)}},
    )
    minari.create_dataset_from_buffers(
        "toy/logs-v0",
        [episode],
        action_space=spaces.Discrete(3, start=2),
        observation_space=spaces.Dict(
            {name: box for name in ("observation", "achieved_goal", "desired_goal")}
        ),
        author="Ada",
    )
    for number, source in enumerate(("toy/logs-v0", "minari/toy/logs-v0")):
        dataset, manifest, _ = imported(source, f"out{number}", goal_array="achieved_goal")
        np.testing.assert_array_equal(dataset.obs, rows[:3])
        np.testing.assert_array_equal(dataset.achieved_goals, -rows[1:])
        assert dataset.actions.tolist() == [0, 2, 1]
        assert manifest["spec"]["num_actions"] == 3
        assert manifest["imported"]["author"] == "Ada"
    dataset, _, _ = imported("toy/logs-v0", "place", goal_array="place", reached="changes")
    assert dataset.achieved_goals[:, 0].tolist() == [1, 2, 3]
    with pytest.raises(
        UsageError, match=r"no file, folder or local Minari dataset toy/loggs-v0.*toy/logs-v0"
    ):
        imported("toy/loggs-v0", "nothing")


GOALS = """
def half(observations):
    return observations[:, :1] / 2

def of_episode(episode):
    return episode.actions.sum(axis=1)

def few(observations):
    return observations[:1]

def broken(observations):
    raise KeyError("door")

NUMBER = 3
"""


def test_goals_by_a_function_of_observations_or_of_an_episode(monkeypatch):
    Path("my_goals.py").write_text(GOALS)
    monkeypatch.syspath_prepend(".")
    np.savez("logs.npz", **flat(logged()))
    dataset, _, _ = imported("logs.npz", "a", goal="my_goals:half")
    assert dataset.achieved_goals[:3, 0].tolist() == [0.5, 1.0, 1.5]
    dataset, _, _ = imported("logs.npz", "b", goal="my_goals:of_episode")
    np.testing.assert_allclose(dataset.achieved_goals[:, 0], dataset.actions.sum(axis=1), atol=1e-6)
    for name, error, says in (
        (
            "few",
            DataError,
            r"episode 0: --goal my_goals:few gives float32\[1, 3\], wanted .* \[4, G\]",
        ),
        ("broken", DataError, "episode 0: --goal my_goals:broken raised KeyError: 'door'"),
        ("nothing", UsageError, "cannot load --goal 'my_goals:nothing': .* has no attribute"),
        ("NUMBER", UsageError, "my_goals:NUMBER is not a function, found 3"),
    ):
        with pytest.raises(error, match=says):
            imported("logs.npz", "never", goal=f"my_goals:{name}")
    assert not Path("never").exists()


def test_actions_are_scaled_and_the_manifest_says_so():
    episodes = logged()
    for episode in episodes:
        episode["actions"] = 3 * episode["actions"] + [0, 1]
    np.savez("logs.npz", **flat(episodes))
    with pytest.raises(DataError, match=r"must be in \[-1, 1\], they go from .*--action-low"):
        imported("logs.npz", goal_columns=(0,))
    dataset, manifest, _ = imported(
        "logs.npz", goal_columns=(0,), action_low=(-3.0, -2.0), action_high=(3.0, 4.0)
    )
    wanted = np.concatenate([episode["actions"] for episode in logged()])
    np.testing.assert_allclose(dataset.actions, wanted, atol=1e-6)
    assert manifest["spec"]["action_low"] == [-3, -2]


def test_a_goal_counts_as_reached_where_it_changes():
    still = [np.array([0, 0, 1, 1]), np.array([1, 1, 2]), np.array([0, 1, 1, 1, 0])]
    episodes = [{**e, "subtask": s} for e, s in zip(logged(), still, strict=True)]
    Path("episodes").mkdir()
    for index, episode in enumerate(episodes):
        np.savez(f"episodes/{index}.npz", **episode)
    dataset, _, _ = imported("episodes", goal_array="subtask", reached="changes")
    assert dataset.goal_reached.astype(int).tolist() == [0, 1, 0, 0, 1, 1, 0, 0, 1]


def bad(change):
    episodes = logged()
    change(episodes)
    Path("episodes").mkdir()
    for index, episode in enumerate(episodes):
        np.savez(f"episodes/run_{index}.npz", **episode)


def nan_in_the_second(episodes):
    episodes[1]["observations"][1, 0] = np.nan


def three_too_many(episodes):
    episodes[1]["observations"] = np.zeros((5, 3))


def another_shape(episodes):
    episodes[2]["observations"] = np.zeros((5, 4), np.float32)


def rewards_missing(episodes):
    del episodes[1]["rewards"]


def no_actions(episodes):
    del episodes[0]["actions"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            nan_in_the_second,
            r"run_1.npz, step 1: obs holds NaN or infinity; fix it, or .* --skip-bad",
        ),
        (three_too_many, r"run_1.npz has 5 observations and 2 actions; .* T \+ 1 observations"),
        (another_shape, r"run_2.npz: obs has rows of float32\[4\], those before have float32\[3\]"),
        (rewards_missing, "run_1.npz has no rewards, unlike those before it"),
        (no_actions, "run_0.npz has no actions; it has observations, rewards, terminals, timeouts"),
    ],
)
def test_bad_episodes_are_named_and_nothing_is_written(change, says):
    bad(change)
    with pytest.raises(DataError, match=says):
        imported("episodes")
    assert not Path("out").exists()
    assert not Path("out.partial").exists()


def test_bad_episodes_can_be_left_out():
    bad(nan_in_the_second)
    dataset, manifest, said = imported("episodes", goal_columns=(0,), skip_bad=True, horizon=3)
    assert dataset.lengths.tolist() == [3]
    assert manifest["imported"]["left_out"] == 2
    assert "run_1.npz, step 1: obs holds NaN" in said
    assert "run_2.npz has 4 steps, the horizon is 3" in said


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({}, "nothing says what a goal is; give --goal-columns with some of the 3 components"),
        (
            {"goal_columns": (3,)},
            "--goal-columns 3 is out of range: observations have 3 components",
        ),
        (
            {"goal_array": "goals"},
            "episode 0 has no array named 'goals'; give --goal-array one of actions, ",
        ),
        ({"goal_columns": (0,), "obs_arrays": ("state",)}, "episode 0 has no array named 'state'"),
        (
            {"goal_columns": (0,), "goal_array": "x"},
            "--goal-columns 0 and --goal-array .x. both say",
        ),
        ({"goal_columns": (0, 0)}, "names a component twice"),
        ({"goal": "half"}, "as module:function, found 'half'"),
        (
            {"goal_columns": (0,), "action_low": (0.0,)},
            "must have the same number of values, found 0.0 and none",
        ),
        ({"goal_columns": (0,), "action_low": (1.0,), "action_high": (1.0,)}, "must be below"),
        (
            {"goal_columns": (0,), "action_low": (-1.0,) * 3, "action_high": (1.0,) * 3},
            "--action-low has 3 numbers, an action has 2",
        ),
    ],
)
def test_settings_that_do_not_fit_the_logs(settings, says):
    np.savez("logs.npz", **flat(logged()))
    config = ImportConfig(source="logs.npz", out=Path("out"), **settings)

    def run():
        check_import(config)
        import_dataset(config)

    with pytest.raises((DataError, UsageError), match=says):
        run()
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"x": np.zeros(2)}, "lacks actions; it has x"),
        (
            {"actions": np.zeros((0, 1)), "terminals": np.zeros(0)},
            r"no steps: its actions are \[0, 1",
        ),
        ({"actions": np.float32(1)}, r"no steps: its actions are \[\]"),
        (
            {"actions": np.zeros((3, 1)), "observations": np.zeros((3, 1))},
            "has no terminals, timeouts or lengths",
        ),
        ({"actions": np.zeros((3, 1)), "lengths": np.array([1, 1])}, "add up to 2 steps, found 3"),
        (
            {"actions": np.zeros((3, 1)), "terminals": np.zeros(2)},
            "a row for each of 3 actions, found 2",
        ),
    ],
)
def test_flat_files_whose_episodes_nobody_can_tell(arrays, says):
    np.savez("logs.npz", **arrays)
    with pytest.raises(DataError, match=says):
        imported("logs.npz")


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("nowhere.npz", "no file"),
        ("logs.txt", "is not a file that can be imported"),
        ("empty", "holds neither"),
    ],
)
def test_what_is_no_source(source, says):
    Path("logs.txt").write_text("text")
    Path("empty").mkdir()
    with pytest.raises(UsageError, match=says):
        imported(source)


# The check


def walk(num=12, length=30, seed=0):
    """A dataset of points that are pushed about at random, sound in every way."""
    rng = np.random.default_rng(seed)
    episodes = []
    for index in range(num):
        place, speed, seen, pushes = rng.normal(size=2), np.zeros(2), [], []
        for _ in range(length - index % 3):
            push = rng.uniform(-1, 1, 2)
            seen.append([*place, *speed])
            pushes.append(push)
            speed = 0.8 * speed + 0.2 * push
            place = place + speed
        seen.append([*place, *speed])
        last = np.arange(len(pushes)) == len(pushes) - 1
        episodes.append(
            {
                "observations": np.array(seen, np.float32),
                "actions": np.array(pushes),
                "rewards": -np.ones(len(pushes)),
                "terminals": last & (index % 3 > 0),
                "timeouts": last & (index % 3 == 0),
            }
        )
    return episodes


@pytest.fixture
def sound():
    np.savez("walk.npz", **flat(walk()))
    return imported("walk.npz", "sound")[0]


def faults(dataset, **settings):
    save_dataset(Path("changed"), dataset, {"spec": {**SPEC, "horizon": 30}}, mapped=True)
    found = examine(Path("changed"), **settings)
    return {kind: texts[0] for kind, texts in found.faults.items()}, found


def test_a_sound_dataset_has_no_faults(sound):
    assert faults(sound)[0] == {}
    assert list(faults_lines := examine(Path("changed")).lines(5)) == ["no faults"], faults_lines


def test_nan_infinity_and_actions_out_of_range_are_named(sound):
    obs, actions, last = (np.array(a) for a in (sound.obs, sound.actions, sound.last_obs))
    obs[30, 1], actions[2, 0], last[4, 2] = np.nan, 1.5, np.inf
    found, all_of = faults(replace(sound, obs=obs, actions=actions, last_obs=last))
    assert found == {
        "not finite": "trajectory 1, step 0: obs holds NaN",
        "out of range": "trajectory 0, step 2: actions holds 1.5, actions are from -1 to 1",
    }
    assert (
        all_of.faults["not finite"][1]
        == "trajectory 4, after the last step: last_obs holds infinity"
    )


def test_episodes_that_are_split_one_step_too_late(sound):
    obs = np.array(sound.obs)
    obs[30] = sound.last_obs[0]
    assert faults(replace(sound, obs=obs))[0]["off by one"].startswith(
        "trajectory 1, step 0: the first observation is the last one of trajectory 0"
    )


def test_last_observations_that_only_repeat_the_one_before(sound):
    ends = np.cumsum(sound.lengths) - 1
    found, _ = faults(replace(sound, last_obs=np.array(sound.obs)[ends]))
    assert found["last observation"].startswith(
        "trajectory 0, step 30: the observation after the last action repeats the one before it"
    )


@pytest.mark.parametrize(
    ("shift", "says"), [(-1, "the step after its own"), (1, "the step before its own")]
)
def test_actions_of_another_step(sound, shift, says):
    """A shift by one row: the last or first action of an episode comes from another one."""
    found, _ = faults(replace(sound, actions=np.roll(np.array(sound.actions), shift, axis=0)))
    assert says in found["misaligned"]


@pytest.mark.parametrize("gain", [0.3, 1.0])
def test_an_agent_that_only_reacts_is_not_taken_for_a_shift(sound, gain):
    episodes = walk()
    rng = np.random.default_rng(3)
    for episode in episodes:
        place, speed, seen = rng.normal(size=2), np.zeros(2), []
        for step in range(len(episode["actions"])):
            seen.append([*place, *speed])
            episode["actions"][step] = np.clip(-gain * place - 0.5 * speed, -1, 1)
            speed = 0.8 * speed + 0.2 * episode["actions"][step] + 0.05 * rng.normal(size=2)
            place = place + speed
        episode["observations"] = np.array([*seen, [*place, *speed]], np.float32)
    np.savez("reacts.npz", **flat(episodes))
    assert faults(imported("reacts.npz", "reacts")[0])[0] == {}


def test_time_limits_that_are_marked_as_ends(sound):
    found, _ = faults(replace(sound, terminated=np.ones(12, bool), truncated=np.zeros(12, bool)))
    assert found["time limits"].startswith(
        "trajectory 0, step 29: it is marked as terminated at the very horizon, as 4 of 4"
    )


def only_before_actions(episodes):
    """The same logs with as many observations as actions, so that the import drops the last actions."""
    return flat(episodes, with_next=False)


def early(episodes):
    """Two of three episodes end their task after 13 to 23 steps, the others at a limit of 30."""
    for index, episode in enumerate(episodes):
        length = 30 if index % 3 == 0 else 12 + index
        for name, array in episode.items():
            episode[name] = array[: length + (name == "observations")]
        last = np.arange(length) == length - 1
        episode["terminals"], episode["timeouts"] = last & (index % 3 > 0), last & (index % 3 == 0)
    return episodes


def test_ends_that_were_dropped_are_still_checked():
    episodes = early(walk())
    np.savez("right.npz", **only_before_actions(episodes))
    imported("right.npz", "right")
    assert examine(Path("right")).num_faults == 0
    assert (
        "0 terminated, 0 truncated, 12 neither; in the logs 8 terminated, 4 truncated"
        in described(Path("right"))
    )
    for episode in episodes:
        episode["terminals"], episode["timeouts"] = episode["timeouts"], episode["terminals"]
    np.savez("swapped.npz", **only_before_actions(episodes))
    dataset, manifest, _ = imported("swapped.npz", "swapped")
    assert not dataset.terminated.any()
    assert {"steps": 30, "episodes": 4, "first": 0} in manifest["dropped_ends"]["terminated"]
    found = examine(Path("swapped"))
    assert found.faults == {
        "time limits": [
            "trajectory 0, step 29 of its logs: it is marked as terminated at the very horizon, as 4 of 4 "
            "of this length are; a time limit is a truncation, or terminals and timeouts are swapped"
        ]
    }


def test_dropped_ends_with_both_marks_are_counted_apart():
    episodes = early(walk())
    for episode in episodes:
        episode["timeouts"] = episode["timeouts"] | episode["terminals"]
    np.savez("both.npz", **only_before_actions(episodes))
    manifest = imported("both.npz", "both")[1]
    assert sum(one["episodes"] for one in manifest["dropped_ends"]["both"]) == 8
    assert examine(Path("both")).num_faults == 0
    assert "cut early" not in examine(Path("both")).notes
    assert "4 truncated, 8 both, 0 neither" in described(Path("both"))


def test_a_manifest_may_count_no_dropped_ends():
    assert list(wrong_ends(DroppedEnds(), 5)) == []


def test_dropped_ends_before_the_horizon_are_a_note():
    episodes = early(walk())
    for episode in episodes:
        episode["timeouts"], episode["terminals"] = (
            episode["timeouts"] | episode["terminals"],
            np.zeros_like(episode["terminals"]),
        )
    np.savez("cut.npz", **only_before_actions(episodes))
    imported("cut.npz", "cut")
    found = examine(Path("cut"))
    assert found.num_faults == 0
    assert (
        "it is marked as truncated before the horizon of 30, as 8 are"
        in found.notes["cut early"][0]
    )


def test_logs_without_marks_of_ends_have_none_that_were_dropped():
    episodes = walk()
    for episode in episodes:
        del episode["terminals"], episode["timeouts"]
    arrays = only_before_actions(episodes)
    arrays["lengths"] = np.array([len(episode["actions"]) for episode in episodes])
    np.savez("plain.npz", **arrays)
    assert "dropped_ends" not in imported("plain.npz", "plain")[1]


def test_lengths_over_the_horizon(sound):
    found, all_of = faults(sound, horizon=27)
    assert found == {"too long": "trajectory 0, step 27: it has 30 steps, the horizon is 27"}
    assert len(all_of.faults["too long"]) == 12
    assert list(all_of.lines(1))[1] == "fault: 11 more of this kind (too long); see --most"


def test_trajectories_that_are_there_twice(sound):
    obs, actions = np.array(sound.obs), np.array(sound.actions)
    obs[90:120], actions[90:120] = (
        obs[:30],
        actions[:30],
    )  # trajectories 0 and 3 have the same length
    at = int(sound.starts[3])
    obs[at : at + 30], actions[at : at + 30] = sound.obs[:30], sound.actions[:30]
    found, _ = faults(replace(sound, obs=obs, actions=actions))
    assert found["twice"] == "trajectory 3, step 0: all of its steps are those of trajectory 0"
    hashes = np.zeros(12, np.uint64)
    save_dataset(Path("meant"), replace(sound, obs=obs, actions=actions, task_hashes=hashes), {})
    assert (
        "twice" in examine(Path("meant")).notes
    )  # a demonstrator of one task may do the same twice


def test_goals_that_are_never_reached_or_never_change(sound):
    found, _ = faults(
        replace(
            sound,
            goal_reached=np.zeros(len(sound.actions), bool),
            achieved_goals=np.ones_like(sound.achieved_goals),
        )
    )
    assert found["no goal"].startswith("trajectory 0, step 0: no goal is reached")
    assert found["still goals"].startswith("trajectory 0, step 0: the achieved goal is the same")


def test_info_says_what_is_there(sound):
    text = described(Path("sound"))
    assert "12 with 348 steps" in text
    assert "mean 29.0; quartiles 28, 28, 29, 30, 30; horizon 30" in text
    assert "8 terminated, 4 truncated, 0 neither" in text
    assert "npz walk.npz, goals [0, 1]" in text


# The command


def call(capsys, line):
    with pytest.raises(SystemExit) as stop:
        importlib.import_module("experiments.data").command(line.split())
    out, err = capsys.readouterr()
    return int(stop.value.code or 0), out, err


def test_the_command_from_logs_to_logs(capsys):
    np.savez("walk.npz", **flat(walk()))
    assert call(capsys, "import walk.npz --goal-columns 0 1 --out mine")[0] == 0
    code, out, _ = call(capsys, "check mine")
    assert (code, out) == (0, "no faults\n")
    assert call(capsys, "info mine")[0] == 0
    found = json.loads(call(capsys, "info mine --json")[1])
    assert (found["trajectories"], found["goals"]["size"]) == (12, 2)
    assert found["lengths"]["max"] <= found["horizon"]
    assert json.loads(call(capsys, "check mine --json")[1]) == {"faults": {}, "notes": {}}
    code, out, _ = call(capsys, "check mine --horizon 20 --most 2 --json")
    ((kind, faults),) = json.loads(out)["faults"].items()
    assert (code, faults["count"], len(faults["shown"])) == (1, 12, 2), kind
    assert call(capsys, "export mine --out again.npz")[0] == 0
    before = {path: hash_file(path) for path in Path().rglob("*") if path.is_file()}
    for line, code, says in (
        ("import walk.npz --goal-columns 0 --out mine", 2, "mine already exists"),
        ("export mine --out again.npz", 2, "again.npz already exists"),
        ("export mine --out mine", 2, "mine already exists"),
        ("export mine", 2, "--out is missing"),
        ("check nowhere", 2, "there is no folder nowhere"),
        ("check .", 1, "no dataset in ."),
        ("info", 2, "no dataset given"),
        ("check mine --horizon 20", 1, "mine has 12 fault(s) of 1 kind(s)"),
        ("check mine --env maze51", 2, "did you mean 'maze15'?"),
        ("check mine --env maze15", 1, "actions must hold integers, found float32"),
        ("imprt", 2, "did you mean 'import'?"),
        ("import walk.npz --typo", 2, " import --help"),
        ("", 2, "name one of import, export, check, info"),
    ):
        found, _, err = call(capsys, line)
        assert (found, says in err) == (code, True), (line, err)
    assert {path: hash_file(path) for path in Path().rglob("*") if path.is_file()} == before


GUIDE = Path(__file__).parents[1] / "docs/guides/own-data.md"


def guide_lines(word):
    """The command lines of the guide that begin with a word after ``experiments.``."""
    return re.findall(
        rf"^    python -m experiments\.{word} (.*)$", GUIDE.read_text(), flags=re.MULTILINE
    )


def test_the_guide_makes_and_checks_its_example(capsys):
    block = re.search(r"```python\n(.*?)```", GUIDE.read_text(), flags=re.DOTALL)[1]
    assert len(block.strip().splitlines()) <= 15
    exec(compile(block, str(GUIDE), "exec"), {})
    said = ""
    for line in guide_lines("data"):
        code, out, err = call(capsys, line)
        assert code == 0, (line, err)
        said += out
    for text in ("200 trajectories of 29 to 29 steps, 5800 in all", "no faults"):
        assert text in said
        assert text in " ".join(GUIDE.read_text().split())
    assert (
        "200 episodes have no observation after their last action, so that action was dropped"
        in said
    )


@pytest.mark.slow
def test_the_guide_trains_its_example(capsys):
    first, second = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), flags=re.DOTALL)
    exec(compile(first, str(GUIDE), "exec"), {})
    assert call(capsys, guide_lines("data")[0])[0] == 0
    for line in (line for line in guide_lines("pretrain") if line.startswith("--data mine")):
        with pytest.raises(SystemExit) as stop:
            importlib.import_module("experiments.pretrain").command(line.split())
        assert not stop.value.code, line
    exec(compile(second, str(GUIDE), "exec"), {})
