"""Training on a user's own dataset: its recipe, with and without a world, and what can follow."""

from __future__ import annotations

import importlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hostile.work import Evaluation, WorkBegan, begin

import envs
from experiments import runtime, training, watching
from experiments.networks import moments
from experiments.parsing import parse
from experiments.store.presets import pretrain_default, with_settings
from experiments.store.recipes import recipe, schedule, told
from experiments.store.settings import PretrainConfig
from mgpo_jax import Actor, Dataset, load_policy, save_dataset
from mgpo_jax.manifest import Facts, SpecEntry, read_facts
from mgpo_jax.policy_files import read_policy
from mgpo_jax.settings import check_settings
from mgpo_jax.tasks import benchmark_tasks, task_hashes
from mgpo_jax.training import Trainer

HORIZON = 12
SIZES = (
    "--embed-dim 8 --num-layers 1 --num-heads 2 --max-prompt-length 2 --batch-size 8 --part-size 4"
)
STEPS = "--bucket 12 --steps 4 --warmup-steps 1 --eval-every 2 --save-every 2"
BASE = f"--data mine {SIZES} {STEPS} --optimizer adamw"


def make_data(num: int = 20, seed: int = 0) -> Dataset:
    rng = np.random.default_rng(seed)
    lengths = rng.integers(3, HORIZON + 1, num).astype(np.int32)
    total = int(lengths.sum())
    goals = rng.normal(size=(total, 2)).astype(np.float32)
    return Dataset(
        obs=rng.integers(0, 9, (total, 3, 3), dtype=np.uint8),
        actions=rng.uniform(-1, 1, (total, 2)).astype(np.float32),
        achieved_goals=goals,
        goal_reached=np.ones(total, bool),
        outcomes=goals,
        lengths=lengths,
        last_obs=rng.integers(0, 9, (num, 3, 3), dtype=np.uint8),
    )


def pretrain(words: str) -> int:
    with pytest.raises(SystemExit) as stop:
        importlib.import_module("experiments.pretrain").command(words.split())
    return int(stop.value.code or 0)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A dataset of no world, the same packed, and a training on each."""
    root = tmp_path_factory.mktemp("own")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setattr(runtime, "configure", lambda: None)
        spec = {"name": "arm", "horizon": HORIZON, "truncate_in_hindsight": False}
        save_dataset(Path("mine"), make_data(), {"spec": spec}, mapped=True)
        save_dataset(Path("packed"), make_data(), {"spec": spec})
        assert pretrain(f"{BASE} --out first") == 0
        assert pretrain(f"{BASE.replace('mine', 'packed')} --out second") == 0
    return root


@pytest.fixture
def here(trained, tmp_path, monkeypatch):
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runtime, "configure", lambda: None)
    monkeypatch.setattr(watching, "ReturnsOnTheWay", Evaluation)
    return tmp_path


def test_a_policy_of_no_world_can_be_loaded_and_acts(here):
    policy = load_policy(path="first/policy")
    assert (policy.made["env"], policy.config.head, policy.config.horizon) == ("none", "binned", 12)
    assert len(policy.config.obs_mean) == 9
    actor = Actor(policy, [[0.5, 1.0]])
    action = actor.reset(np.zeros((3, 3), np.uint8))
    assert action.shape == (2,)
    assert (np.abs(actor.act(np.ones((3, 3), np.uint8))) <= 1).all()
    rows = [json.loads(line) for line in Path("first/metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [2, 4]
    assert "val/loss" in rows[0]
    assert not any(name.startswith("eval/") for name in rows[0])


def test_a_mapped_and_a_packed_dataset_train_the_same_weights(here):
    assert read_policy(Path("first/policy")).sha256 == read_policy(Path("second/policy")).sha256
    hashes = [
        json.loads(Path(f"{n}/meta.json").read_text())["dataset_sha256"]
        for n in ("first", "second")
    ]
    assert hashes[0] != hashes[1]  # of the files, not of what they hold


def test_a_finished_run_takes_more_steps_and_a_new_one_starts_from_its_weights(here, capsys):
    before = read_policy(Path("first/policy")).sha256
    assert pretrain(f"{BASE} --out first --resume") == 0
    assert "is already finished" in capsys.readouterr().err
    more = BASE.replace("--steps 4", "--steps 6")
    assert pretrain(f"{more} --out first") == 2
    assert "already exists" in capsys.readouterr().err
    assert pretrain(f"{more} --seed 1 --out first --resume") == 2  # only the steps may grow
    capsys.readouterr()
    assert pretrain(f"{more} --out first --resume") == 0
    said = capsys.readouterr().err
    assert (
        "the run has 4 steps and continues to 6: the learning rate is that of a training of 6"
        in said
    )
    assert "resuming first at step 4" in said
    assert read_policy(Path("first/policy-4")).sha256 == before
    assert read_policy(Path("first/policy")).made["steps"] == 6
    rows = [
        json.loads(line)["step"] for line in Path("first/metrics.jsonl").read_text().splitlines()
    ]
    assert rows == [2, 4, 6]
    assert pretrain(f"{more} --out first --resume") == 0
    assert "is already finished" in capsys.readouterr().err
    assert pretrain(f"{BASE} --out first --resume") == 2  # fewer steps are other settings
    capsys.readouterr()
    assert (
        pretrain(f"--data mine --init first/policy --batch-size 8 --part-size 4 {STEPS} --out on")
        == 0
    )
    assert (
        "schedule: 4 gradient steps of 8 trajectories, which is 1.8 epochs;"
        in capsys.readouterr().err
    )
    on = read_policy(Path("on/policy"))
    assert on.made["init_sha256"] == read_policy(Path("first/policy")).sha256
    assert on.config.embed_dim == 8


def test_a_run_that_was_killed_while_it_took_more_steps_can_go_on(here, monkeypatch, capsys):
    more = BASE.replace("--steps 4", "--steps 6")
    with monkeypatch.context() as patch:
        patch.setattr(
            training, "restore_state", lambda *args: (_ for _ in ()).throw(KeyboardInterrupt)
        )
        assert pretrain(f"{more} --out first --resume") == 130
    assert read_policy(Path("first/policy")).made["steps"] == 4
    capsys.readouterr()
    assert pretrain(f"{more} --out first --resume") == 0
    assert "resuming first at step 4" in capsys.readouterr().err
    assert read_policy(Path("first/policy")).made["steps"] == 6


WRONG = {
    "--env none": "--env none is for data of your own",
    "--data nowhere": "no dataset in nowhere: there is no such folder; give the folder of a dataset",
    "--data first/policy/weights.npz": "it is a file, and a dataset is a folder; import logs with",
    "--data first/policy": "(manifest.json is missing), so it was not imported; import logs with",
    "--data mine --demonstrator expert": "so --demonstrator does not apply to it",
    "--data mine --data-seed 1": "so --data-seed does not apply to it",
    "--data mine --method ptgm": "--method ptgm needs a world",
    "--data mine --trajectories 21": "--trajectories 21 is more than the 20 in mine",
    "--data mine --holdout 20": "--holdout 20 leaves nothing of 20 trajectories",
    "--data mine --head categorical": "unknown head for arm 'categorical'",
    "--data mine --env maze15 --preset smoke": "actions must hold integers, found float32; import it",
    "--data mine --init first/policy --embed-dim 16": "contradicts the policy in first/policy",
}


@pytest.mark.parametrize("words", WRONG)
def test_what_is_refused(here, words, capsys):
    assert pretrain(f"{words} --out new") in (1, 2)
    assert WRONG[words] in capsys.readouterr().err
    assert not Path("new/config.json").exists()


def test_the_data_of_a_run_must_stay_what_it_was(here, capsys):
    """Moved data is the same, other data is refused."""
    shutil.move("mine", "moved")
    more = BASE.replace("--steps 4", "--steps 6").replace("mine", "moved")
    save_dataset(
        Path("other"), make_data(seed=1), {"spec": {"name": "arm", "horizon": 12}}, mapped=True
    )
    assert pretrain(f"{more.replace('moved', 'other')} --out first --resume") == 1
    assert "was trained on 'mine' with the hash" in capsys.readouterr().err
    assert pretrain(f"{more} --out first --resume") == 0


def doors(**more: np.ndarray) -> Dataset:
    """Logs of the world in ``own_world``."""
    rng = np.random.default_rng(0)
    total = 20 * 5
    goals = np.eye(9, dtype=np.float32)[rng.integers(0, 9, total)]
    return Dataset(
        obs=rng.integers(0, 2, (total, 3, 3), dtype=np.uint8),
        actions=rng.integers(0, 3, total).astype(np.int32),
        achieved_goals=goals,
        goal_reached=np.ones(total, bool),
        outcomes=goals,
        lengths=np.full(20, 5, np.int32),
        **more,
    )


@pytest.mark.parametrize("slow", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_with_a_world_its_shapes_and_recipe_hold(here, capsys, monkeypatch, slow):
    """Logs of a world are watched in it, also where it has no demonstrators."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    save_dataset(Path("doors"), doors(), {}, mapped=True)
    words = f"--env own_world:UNSHOWN --data doors {SIZES} {STEPS} --eval-tasks 2 --out doors-run"
    if not slow:  # as far as the first step, whose program takes long to compile
        monkeypatch.setattr(Trainer, "step", begin)
        with pytest.raises(WorkBegan):
            pretrain(words)
        assert json.loads(Path("doors-run/config.json").read_text())["env"] == "own_world:UNSHOWN"
        return
    assert pretrain(words) == 0
    assert "--holdout 2" in capsys.readouterr().err
    policy = load_policy("own_world:UNSHOWN", "doors-run/policy")
    assert (policy.config.horizon, policy.config.head) == (12, "categorical")


def test_logs_of_a_test_task_are_refused_and_not_given_up(here, capsys, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)
    world = envs.find("own_world:UNSHOWN")
    env = world.make()
    (one,) = task_hashes(env, benchmark_tasks(env, world.num_test_tasks))[:1]
    save_dataset(Path("doors"), doors(task_hashes=np.full(20, one)), {}, mapped=True)
    assert pretrain("--env own_world:UNSHOWN --data doors --out doors-run") == 1
    said = capsys.readouterr().err
    assert "doors holds a test task; leave its trajectory out of your logs and import them" in said


def facts(num=1000, mean=50, longest=80, **changes):
    given = {
        "folder": Path("data"),
        "num_trajectories": num,
        "num_steps": num * mean,
        "longest": longest,
        "obs_shape": (4,),
        "obs_dtype": "float32",
        "goal_dim": 2,
        "num_actions": None,
        "action_dim": 2,
        "spec": SpecEntry(name="data", horizon=longest),
        "env": None,
    }
    return Facts(**{**given, **changes})


def test_the_recipe_follows_sizes():
    found = recipe(facts())
    assert (found["embed_dim"], found["num_layers"], found["batch_size"]) == (128, 3, 64)
    assert (found["head"], found["max_prompt_length"], found["steps"]) == ("binned", 5, 500)
    assert (found["holdout"], found["standardize_obs"], found["tokens_per_step"]) == (100, True, 2)
    small = recipe(facts(num=5, mean=3, longest=3, num_actions=4, obs_dtype="bool"))
    assert (small["embed_dim"], small["max_prompt_length"], small["head"]) == (64, 3, "categorical")
    assert (small["holdout"], small["standardize_obs"], small["bucket"]) == (1, False, 4)
    large = recipe(facts(num=100_000, mean=300, longest=1000))
    assert (large["embed_dim"], large["batch_size"], large["tokens_per_step"]) == (256, 16, 1)
    assert (large["steps"], large["max_prompt_length"]) == (20_000, 20)
    assert 1000 / large["bucket"] <= 8


def test_every_recipe_is_a_sound_training():
    for num in (2, 50, 10_000, 1_000_000):
        for mean in (1, 7, 60, 900):
            config = with_settings(PretrainConfig(), recipe(facts(num, mean, 2 * mean)))
            check_settings(config)
            assert config.holdout < config.data.trajectories
            assert config.train.batch_size % config.train.part_size == 0
            assert config.embed_dim % config.num_heads == 0


def test_what_was_chosen_is_printed_and_flags_change_it(here):
    words = "--data mine --steps 100 --schedule constant"
    config = parse(PretrainConfig, words.split(), pretrain_default)
    text = told(config, read_facts(Path("mine")))
    assert "20 trajectories" in text
    assert "--embed-dim 64" in text
    assert "--steps 100" in text
    assert "--standardize-obs" in text
    assert schedule(config).endswith("rises to 0.003 within 50 steps and then stays constant")
    assert config.folder == Path("runs/pretrain/mine/fast-seed0")


@pytest.mark.parametrize("dtype", ["float32", "uint8", "int32"])
def test_moments_have_the_bits_of_numpy_in_pieces_of_any_size(dtype):
    rng = np.random.default_rng(0)
    rows = (50 * rng.normal(size=(1001, 3, 2)) + 100).astype(dtype)
    wanted = rows.reshape(1001, 6)
    for piece in (6, 64, 1 << 24):
        mean, std = moments(rows, piece)
        np.testing.assert_array_equal(mean, wanted.mean(axis=0, dtype=np.float64))
        np.testing.assert_array_equal(std, wanted.std(axis=0, dtype=np.float64))
