"""``pretrain --init``: the network of the initial policy, refused settings, and exact resume."""

from __future__ import annotations

import hashlib
import importlib
import json
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from hostile.work import Evaluation
from jax.flatten_util import ravel_pytree

from envs.errors import DataError, UsageError
from envs.specs import ArraySpec, Discrete, EnvSpec
from experiments import networks, runtime, training, watching
from experiments.parsing import parse
from experiments.store.initial import initial_at
from experiments.store.presets import pretrain_default, pretrain_preset
from experiments.store.runs import begin, check_start, has_begun, identity
from experiments.store.settings import DEFAULT_WORLD, PretrainConfig, training_settings
from mgpo_jax import Dataset, LoadedPolicy, TrainConfig, pretrain
from mgpo_jax.files import hash_file
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy_files import read_policy, save_policy
from mgpo_jax.settings import check_contradictions
from mgpo_jax.sharding import device_mesh
from mgpo_jax.training import Trainer, continued_network

PRETRAINED = Path(__file__).parents[1] / "mgpo_jax/pretrained"
Run = Callable[..., tuple[int, str]]

BASE = (
    "pretrain --preset smoke --trajectories 40 --holdout 8 --steps 6 --batch-size 8 --part-size 4 "
    "--bucket 64 --eval-tasks 2 --eval-every 3 --save-every 2"
)
SIZES = "--max-prompt-length 3 --embed-dim 8 --num-layers 1 --no-prompt-order --standardize-obs"
FIRST = f"{BASE} {SIZES} --out first"
ON = f"{BASE} --init first/policy --out on"


def call(line: str) -> int:
    name, *words = line.split()
    with pytest.raises(SystemExit) as stop:
        importlib.import_module(f"experiments.{name}").command(words)
    return int(stop.value.code or 0)


@contextmanager
def after_four_steps() -> Iterator[Callable[[], int]]:
    """Ctrl-C, asked for after every step."""
    asked = iter([0, 0, 0, signal.SIGINT])
    yield lambda: next(asked)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training, and two that start from its weights.

    ``half`` is ``on``, stopped after four of its six steps; ``other`` holds a policy with other weights.
    """
    root = tmp_path_factory.mktemp("init")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setattr(runtime, "configure", lambda: None)
        patch.setattr(watching, "ReturnsOnTheWay", Evaluation)
        patch.delenv("MGPO_DATA", raising=False)
        assert call(FIRST) == 0
        first = read_policy(Path("first/policy"))
        other = jax.tree.map(lambda leaf: 1.5 * leaf, first.params)
        save_policy(Path("other/policy"), first.config, other, first.made)
        assert call(ON) == 0
        patch.setattr(training, "asked_to_stop", after_four_steps)
        assert call(ON.replace("--out on", "--out half")) == 128 + signal.SIGINT
    return root


@pytest.fixture
def here(runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the runs as the current folder."""
    shutil.copytree(runs, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runtime, "configure", lambda: None)
    monkeypatch.setattr(watching, "ReturnsOnTheWay", Evaluation)
    monkeypatch.delenv("MGPO_DATA", raising=False)
    return tmp_path


@pytest.fixture
def command(here: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command in this process; returns its exit code and what it wrote to stderr."""

    def run(line: str) -> tuple[int, str]:
        capsys.readouterr()
        return call(line), capsys.readouterr().err

    return run


def parsed(line: str) -> PretrainConfig:
    return parse(PretrainConfig, line.split()[1:], pretrain_default)


def assert_same(found: Any, wanted: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, found, wanted)


def weights(run: str) -> Any:
    return read_policy(Path(run) / "policy").params


def document(path: str) -> dict[str, Any]:
    return json.loads(Path(path).read_text())


def test_the_first_step_starts_from_the_weights_of_the_policy(here: Path) -> None:
    """Moments and schedule start afresh; the network is that of the policy, but for its dropout."""
    config = parsed(f"{ON} --dropout 0.25")
    first = read_policy(Path("first/policy"))
    init = networks.initial_policy(config, training.envs.make("maze15").spec)
    assert init is not None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training.runs, "has_begun", lambda folder: False)
        patch.setattr(training.runs, "begin", lambda *args: None)
        run = training.Run(config, "")
    state, fresh = run.initial_state(), run.trainer.init()
    assert state.step == 0
    assert_same(state.params, first.params)
    assert_same(state.opt_state, fresh.opt_state)
    assert run.network == replace(first.config, dropout=0.25)
    assert run.network.obs_mean == first.config.obs_mean != ()
    assert not np.array_equal(*(ravel_pytree(params)[0] for params in (state.params, fresh.params)))


def test_defaults_of_the_network_are_those_of_the_policy(here: Path) -> None:
    config, usual = parsed(ON), parsed(ON.replace("--init first/policy ", ""))
    assert config.init == Path("first/policy")
    wanted = {
        "max_prompt_length": 3, "embed_dim": 8, "num_layers": 1, "prompt_order": False,
        "standardize_obs": True, "head": "categorical",
    }  # fmt: skip
    assert config == replace(usual, init=config.init, **wanted)
    # The same values may be given.
    assert parsed(f"{ON} {SIZES} --head categorical") == config


def test_dropout_stays_a_setting_of_the_training(here: Path) -> None:
    """It belongs to no weights: the preset or a flag chooses it."""
    assert parsed(ON).dropout == 0.0
    assert parsed(f"{ON} --dropout 0.25").dropout == 0.25
    assert parsed(ON.replace("--preset smoke", "--preset paper")).dropout == 0.1
    assert parsed(ON.replace("--preset smoke", "--preset paper")).num_heads == 4


def test_the_low_level_of_ptgm_starts_from_a_multi_goal_policy(command: Run) -> None:
    """Shared parameters are taken over, the layer of the prior is new, and a resumed run is the same."""
    line = f"{BASE} --method ptgm --init first/policy --out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training.runs, "has_begun", lambda folder: False)
        patch.setattr(training.runs, "begin", lambda *args: None)
        run = training.Run(parsed(f"{line} new"), "")
    first = read_policy(Path("first/policy"))
    found, fresh = run.initial_state().params["params"], run.trainer.init().params["params"]
    assert set(found) - set(first.params["params"]) == {"prior"}
    assert set(first.params["params"]) == set(found) - {"prior"}
    assert_same({name: found[name] for name in set(found) - {"prior"}}, first.params["params"])
    assert_same(found["prior"], fresh["prior"])
    assert run.network.obs_mean == first.config.obs_mean != ()
    assert run.network.max_prompt_length == 1
    assert len(run.network.commands) == 169

    code, text = command(f"{line} whole")
    assert code == 0, text
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "asked_to_stop", after_four_steps)
        assert command(f"{line} cut")[0] == 130
    code, text = command(f"{line} cut --resume")
    assert code == 0, text
    assert_same(weights("cut"), weights("whole"))


def test_other_kinds_start_from_networks_of_their_own_only(command: Run) -> None:
    code, text = command(f"{BASE} --method spirl --init first/policy --out new")
    assert code == 2
    assert "--method spirl cannot start from first/policy, a network of the kind mgpo" in text


def test_files_say_where_the_training_started(here: Path) -> None:
    sha256 = hash_file(Path("first/policy/weights.npz"))
    assert document("on/meta.json")["init_sha256"] == sha256
    made = document("on/policy/config.json")["made"]
    assert (made["init_sha256"], made["config"]["init"]) == (sha256, "first/policy")
    for name in ("weights.npz", "config.json"):
        assert Path("on/init", name).read_bytes() == Path("first/policy", name).read_bytes()
    assert "init_sha256" not in document("first/meta.json")
    assert "init_sha256" not in document("first/policy/config.json")["made"]
    assert not Path("first/init").exists()


def test_a_released_policy_of_an_older_version_is_known_by_its_network() -> None:
    assert initial_at(PRETRAINED / "kitchen") == (
        {
            "max_prompt_length": 6, "prompt_order": True, "embed_dim": 128, "num_layers": 3,
            "num_heads": 4, "encoder": "linear", "head": "binned", "tokens_per_step": 2,
            "standardize_obs": True,
        },
        hash_file(PRETRAINED / "kitchen/weights.npz"),
    )  # fmt: skip
    assert not initial_at(PRETRAINED / "maze30").network["standardize_obs"]


COPY = "contradicts the policy in half/init, whose network has"
POLICY = "contradicts the policy in first/policy, whose network has"
CONTRADICTIONS = {
    "--embed-dim 16": f"--embed-dim 16 {POLICY} embed_dim 8;",
    "--num-layers 2": f"--num-layers 2 {POLICY} num_layers 1;",
    "--num-heads 2": f"--num-heads 2 {POLICY} num_heads 4;",
    "--max-prompt-length 5": f"--max-prompt-length 5 {POLICY} max_prompt_length 3;",
    "--prompt-order": f"--prompt-order {POLICY} prompt_order False;",
    "--no-standardize-obs": f"--no-standardize-obs {POLICY} standardize_obs True;",
    "--tokens-per-step 1": f"--tokens-per-step 1 {POLICY} tokens_per_step 2;",
    "--encoder cells": f"--encoder cells {POLICY} encoder linear;",
    "--head gaussian": f"--head gaussian {POLICY} head categorical;",
}


@pytest.mark.parametrize("flags", CONTRADICTIONS)
def test_flags_that_contradict_the_policy_are_refused(command: Run, flags: str) -> None:
    code, text = command(f"{ON} {flags}".replace("--out on", "--out new"))
    assert (code, CONTRADICTIONS[flags] in text.replace("'", "")) == (2, True), text
    assert text.endswith("leave it out\n")
    assert text.count("\n") == 1
    assert not Path("new").exists()


def test_a_call_without_a_command_line_is_checked_too(here: Path) -> None:
    with pytest.raises(UsageError, match="--embed-dim 16 contradicts the policy in first/policy"):
        training.train(replace(parsed(ON), embed_dim=16, out=Path("new")))
    assert not Path("new").exists()


def edited(**changes: Any) -> Callable[[Path], None]:
    """A change of entries of the network in a policy's config."""

    def do(policy: Path) -> None:
        path = policy / "config.json"
        config = json.loads(path.read_text())
        config["network"] = {**config["network"], **changes}
        path.write_text(json.dumps(config))

    return do


def cut(policy: Path) -> None:
    path = policy / "weights.npz"
    path.write_bytes(path.read_bytes()[:-100])


WRONG: dict[str, tuple[Callable[[Path], Any], int, str]] = {
    "nothing": (shutil.rmtree, 2, "no policy in wrong (config.json is missing); give the folder of"),
    "no config": (lambda path: (path / "config.json").unlink(), 2, "no policy in wrong"),
    "half a config": (
        lambda path: (path / "config.json").write_text('{"format": 2'),
        1,
        "wrong/config.json is not readable JSON",
    ),
    "no hash": (
        lambda path: (path / "config.json").write_text('{"network": {}}'),
        1,
        "wrong/config.json lacks sha256",
    ),
    "a width of text": (edited(embed_dim="8"), 1, "network.embed_dim must be an integer, found '8'"),
    "heads that do not fit": (edited(num_heads=3), 1, "network.num_heads must divide embed_dim 8"),
    "another number of layers": (edited(num_layers=2), 1, "has the weights of 1 blocks"),
    "a mean of another size": (edited(obs_mean=[0.0]), 1, "obs_mean must hold 6 numbers or none"),
    "cut weights": (cut, 1, "wrong/weights.npz is missing, truncated or differs from the hash"),
    "no weights": (lambda path: (path / "weights.npz").unlink(), 1, "wrong/weights.npz is missing"),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_policies_that_cannot_be_started_from_are_refused(command: Run, what: str) -> None:
    damage, wanted, says = WRONG[what]
    shutil.copytree("first/policy", "wrong")
    damage(Path("wrong"))
    shutil.rmtree("data")  # nothing is collected either
    code, text = command(f"{BASE} --init wrong --out new")
    assert (code, says in text) == (wanted, True), text
    assert text.startswith("error: ")
    assert text.count("\n") == 1
    assert not Path("new").exists()
    assert not Path("data").exists()


def test_a_training_tells_its_schedule(command: Run) -> None:
    """Also with --resume, which job scripts always give."""
    code, text = command(ON.replace("--out on", "--out new --resume"))
    assert code == 0
    assert "resuming" not in text
    assert (
        "schedule: 6 gradient steps of 8 trajectories, which is 1.5 epochs; the learning rate"
        in text
    )


def test_a_run_is_no_policy(command: Run) -> None:
    code, text = command(f"{BASE} --init first --out new")
    assert (code, "with --init, such as RUN/policy" in text) == (1, True), text


@pytest.mark.parametrize("env", ["maze30", "gridworld", "kitchen"])
def test_a_policy_of_another_world_is_refused(command: Run, env: str) -> None:
    code, text = command(f"{ON} --env {env}".replace("--out on", "--out new"))
    assert (code, "it was trained for another world" in text) == (1, True), text
    assert "the policy in first/policy has" in text
    assert text.count("\n") == 1
    assert not Path("new").exists()
    assert not Path("data", env).exists()


HALF = ON.replace("--out on", "--out half --resume")


def replace_policy() -> None:
    """Put other weights where the run was started from, as a release does."""
    shutil.rmtree("first/policy")
    shutil.copytree("other/policy", "first/policy")


def remove_checkpoints() -> None:
    shutil.rmtree("half/checkpoints")


MEANWHILE: dict[str, tuple[Callable[[], Any], ...]] = {
    "the policy was replaced": (replace_policy,),
    "the policy was replaced before the first checkpoint": (replace_policy, remove_checkpoints),
    "the policy and meta.json were removed": (
        lambda: shutil.rmtree("first"),
        lambda: Path("half/meta.json").unlink(),
    ),
    "the copy was removed": (lambda: shutil.rmtree("half/init"),),
}


@pytest.mark.parametrize("meanwhile", MEANWHILE)
def test_a_resumed_run_equals_an_uninterrupted_one(command: Run, meanwhile: str) -> None:
    for change in MEANWHILE[meanwhile]:
        change()
    code, text = command(HALF)
    assert code == 0, text
    is_new = remove_checkpoints in MEANWHILE[meanwhile]
    assert ("resuming half at step 4" in text, "schedule: 6 gradient" in text) == (
        not is_new,
        is_new,
    )
    assert_same(weights("half"), weights("on"))
    assert hash_file(Path("half/policy/weights.npz")) == hash_file(Path("on/policy/weights.npz"))
    found, wanted = (
        [json.loads(row) for row in Path(run, "metrics.jsonl").read_text().splitlines()]
        for run in ("half", "on")
    )
    for row in (*found, *wanted):
        del row["cpu_seconds_per_step"]
    assert found == wanted
    names = [
        {
            str(path.relative_to(run))
            for path in Path(run).rglob("*")
            if "checkpoints" not in str(path)
        }
        for run in ("half", "on")
    ]
    assert names[0] == names[1]


def test_a_resumed_run_in_its_own_folder_reads_its_copy(here: Path) -> None:
    """The folder depends on the world, which is the default one if none is named."""
    folder = parsed(f"pretrain --env {DEFAULT_WORLD}").folder
    shutil.copytree("half", folder)
    shutil.rmtree("first")
    resumed = "pretrain --init first/policy --resume"
    assert parsed(resumed) == parsed(f"{resumed} --env {DEFAULT_WORLD}")
    assert parsed(resumed).embed_dim == 8


def test_a_run_with_other_weights_or_without_is_another_run(command: Run) -> None:
    for line, says in {
        HALF.replace("first/policy", "other/policy"): "init 'first/policy' -> 'other/policy'",
        HALF.replace("--init first/policy", SIZES): "init 'first/policy' -> None",
        HALF.replace("first/policy", "nowhere"): "no policy in nowhere",
        f"{FIRST} --resume --init other/policy": "settings: init None -> 'other/policy'; give",
    }.items():
        code, text = command(line)
        assert (code, says in text) == (2, True), text
        assert text.count("\n") == 1


def test_the_same_weights_may_lie_elsewhere(command: Run) -> None:
    shutil.move("first/policy", "elsewhere")
    code, text = command(f"{ON} --resume".replace("first/policy", "elsewhere"))
    assert (code, text) == (0, "on is already finished\n")


def test_without_a_copy_the_recorded_hash_decides(command: Run) -> None:
    shutil.rmtree("half/init")
    hashes = [hash_file(Path(run, "policy/weights.npz"))[:12] for run in ("first", "other")]
    replace_policy()
    for change in (lambda: None, remove_checkpoints):
        change()
        code, text = command(HALF)
        assert code == 1
        assert f"half was started from weights with the hash '{hashes[0]}.., those in" in text
        assert f"those in first/policy have {hashes[1]}..; put the policy back there" in text
        assert text.count("\n") == 1
        assert not Path("half/init").exists()


def test_a_copy_with_other_weights_is_refused(command: Run) -> None:
    shutil.rmtree("half/init")
    shutil.copytree("other/policy", "half/init")
    code, text = command(HALF)
    assert (code, "those in half/init have" in text) == (1, True), text
    Path("half/meta.json").unlink()  # the checkpoint knows it as well
    code, text = command(HALF)
    assert (code, "is of a run with other settings or data" in text) == (1, True), text


DAMAGES = {
    "text": (edited(embed_dim="8"), 1, "network.embed_dim must be an integer, found '8'"),
    "heads": (edited(num_heads=3), 1, "network.num_heads must divide embed_dim 8, found 3"),
    "other heads": (edited(num_heads=2), 2, f"--num-heads 4 {COPY} num_heads 2"),
    "cut weights": (cut, 1, "half/init/weights.npz is missing, truncated or differs"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_copy_names_the_way_out(command: Run, damage: str) -> None:
    do, wanted, says = DAMAGES[damage]
    do(Path("half/init"))
    code, text = command(HALF)
    assert (code, says in text) == (wanted, True), text
    assert text.count("\n") == 1
    assert text.endswith("; remove half/init, and --init is read again\n"), text


def test_flags_of_a_resumed_run_are_those_of_its_start(command: Run) -> None:
    for flags, says in {
        "--embed-dim 16": "embed_dim 8 -> 16",
        "--dropout 0.5": "dropout 0.0 -> 0.5",
    }.items():
        code, text = command(f"{HALF} {flags}")
        assert (code, f"started with other settings: {says}; give" in text) == (2, True), text


@pytest.mark.parametrize("line", [ON, FIRST.replace("first", "on")])
def test_a_killed_start_is_in_nobodys_way(here: Path, line: str) -> None:
    """It was killed while it copied the policy."""
    shutil.rmtree("on")
    Path("on/init").mkdir(parents=True)
    for name in ("meta.json", "init/weights.npz", "init/.writing-0a.npz"):
        Path("on", name).write_text("half")
    config = parsed(line)
    check_start(config)
    begin(config, {"init_sha256": hash_file(Path("first/policy/weights.npz"))})
    found = {str(path.relative_to("on")) for path in Path("on").rglob("*") if path.is_file()}
    names = ("config.json", "goals.npz", "weights.npz")
    copied = {f"init/{name}" for name in names} if config.init else set()
    assert found == {"config.json", "meta.json"} | copied
    assert Path("on/init").exists() == bool(config.init)


@pytest.mark.parametrize("mine", ["init/notes.txt", "init/weights.npz"])
def test_a_folder_of_the_user_is_left_alone(command: Run, mine: str) -> None:
    path = Path("mine", mine)
    path.parent.mkdir(parents=True)
    path.write_text("mine")
    code, text = command(ON.replace("--out on", "--out mine"))
    assert (code, "mine already exists and is not a training run" in text) == (2, True), text
    assert path.read_text() == "mine"


def test_a_policy_that_is_replaced_while_it_is_copied_is_noticed(here: Path) -> None:
    read_before = {"init_sha256": hash_file(Path("first/policy/weights.npz"))}
    replace_policy()
    config = replace(parsed(ON), out=Path("new"))
    config.folder.mkdir()
    with pytest.raises(DataError, match="first/policy was replaced just now; run the same command"):
        begin(config, read_before)
    assert not has_begun(config.folder)
    check_start(config)  # it can be started


def test_the_hash_of_the_weights_is_part_of_what_a_run_is() -> None:
    config = PretrainConfig(env=DEFAULT_WORLD)
    # Runs from random weights keep the identity that they had before there were others.
    assert identity(config, "ab") == hashlib.sha256(b'[{}, "ab"]').hexdigest()
    assert identity(config, "ab", "cd") == hashlib.sha256(b'[{}, "ab", "cd"]').hexdigest()
    moved = replace(config, init=Path("elsewhere"))
    assert identity(moved, "ab", "cd") == identity(config, "ab", "cd")
    assert training_settings(moved) == training_settings(config)
    assert len({identity(config, "ab", init) for init in ("", "cd", "ce")}) == 3


def test_presets_do_not_start_from_a_policy() -> None:
    for preset in ("fast", "paper", "smoke"):
        assert pretrain_preset("maze15", preset).init is None


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (
            {"embed_dim": 8},
            "--embed-dim 8 contradicts X, whose network has embed_dim 4; leave it out",
        ),
        (
            {"prompt_order": False},
            "--no-prompt-order contradicts X, whose network has prompt_order True",
        ),
        ({"head": "mixture"}, "--head 'mixture' contradicts X, whose network has head 'binned'"),
    ],
)
def test_contradictions_name_both_values(given: dict[str, Any], says: str) -> None:
    network = {"embed_dim": 4, "prompt_order": True, "head": "binned"}
    check_contradictions({**network, "dropout": 0.5, "head": None}, network, "X")
    with pytest.raises(UsageError) as error:
        check_contradictions({**network, **given}, network, "X")
    assert str(error.value).startswith(says)


# The library function.
HORIZON = 6
TRAIN = TrainConfig(
    steps=2, batch_size=4, part_size=4, bucket=HORIZON, optimizer="adamw", learning_rate=1e-9,
    warmup_steps=0, schedule="constant",
)  # fmt: skip
SPEC = EnvSpec(
    name="toy",
    obs=ArraySpec((3,)),
    goal_dim=2,
    actions=Discrete(3),
    horizon=HORIZON,
    return_range=(0.0, 1.0),
    truncate_in_hindsight=True,
)


@pytest.fixture(scope="module")
def toy() -> tuple[Dataset, LoadedPolicy]:
    """Random trajectories, and a policy with random weights."""
    rng = np.random.default_rng(0)
    lengths = np.array([6, 2, 5, 4], np.int32)
    actions = rng.integers(3, size=lengths.sum()).astype(np.int32)
    goals = rng.random((lengths.sum(), 2)).astype(np.float32)
    dataset = Dataset(
        obs=np.eye(3, dtype=np.float32)[actions],
        actions=actions,
        achieved_goals=goals,
        goal_reached=np.ones(len(goals), bool),
        outcomes=goals,
        lengths=lengths,
    )
    network = network_config(SPEC, max_prompt_length=3, embed_dim=8, num_layers=1, dropout=0.0)
    trainer = Trainer(TRAIN, network, dataset, device_mesh(1))
    return dataset, LoadedPolicy(network, trainer.init().params, {})


def test_a_library_call_starts_from_a_policy(toy: Any, tmp_path: Path) -> None:
    dataset, policy = toy
    save_policy(tmp_path / "policy", policy.config, policy.params, policy.made)
    init = read_policy(tmp_path / "policy")
    found = pretrain(dataset, SPEC, TRAIN, init, embed_dim=8)
    assert found.config == init.config
    assert found.made == {"steps": 2, "init_sha256": init.sha256}
    close = lambda a, b: np.testing.assert_allclose(a, b, atol=1e-7)  # noqa: E731 (tiny steps)
    jax.tree.map(close, found.params, policy.params)
    assert_same(init.params, policy.params)  # the training has not given them away


def test_only_dropout_may_change(toy: Any) -> None:
    _, policy = toy
    same = continued_network(policy.config, {"num_layers": 1, "dropout": 0.5}, "X")
    assert same == replace(policy.config, dropout=0.5)
    assert continued_network(same, {}, "X").dropout == 0.0  # as in the recipe
    with pytest.raises(UsageError, match="--horizon 7 contradicts X, whose network has horizon 6"):
        continued_network(policy.config, {"horizon": 7}, "X")


def test_a_library_call_says_what_does_not_fit(toy: Any) -> None:
    dataset, policy = toy
    with pytest.raises(UsageError, match="--embed-dim 16 contradicts the policy given as init"):
        pretrain(dataset, SPEC, TRAIN, policy, embed_dim=16)
    for init in (policy, None):
        with pytest.raises(
            UsageError, match="unknown setting of the network 'embed_dmi'; did you mean"
        ):
            pretrain(dataset, SPEC, TRAIN, init, embed_dmi=16)
    with pytest.raises(UsageError, match="horizon of a network follows from the world toy; leave"):
        pretrain(dataset, SPEC, TRAIN, horizon=5)
    with pytest.raises(UsageError, match="num_heads must divide embed_dim 10, found 4"):
        pretrain(dataset, SPEC, TRAIN, embed_dim=10)
    with pytest.raises(UsageError, match=r"num.layers must be at least 1, found 0"):
        pretrain(dataset, SPEC, TRAIN, num_layers=0)
    with pytest.raises(UsageError, match="batch_size 8 is not a multiple of part_size 16"):
        pretrain(dataset, SPEC, TrainConfig(batch_size=8), num_layers=1, embed_dim=8)
    foreign = policy._replace(config=replace(policy.config, goal_dim=5))
    with pytest.raises(DataError, match="the policy given as init has goal_dim 5, toy needs 2"):
        pretrain(dataset, SPEC, TRAIN, foreign)


def test_the_weights_that_are_given_are_copied(toy: Any) -> None:
    dataset, policy = toy
    trainer = Trainer(TRAIN, policy.config, dataset, device_mesh(1))
    state = trainer.init(policy.params)
    assert_same(state.params, policy.params)
    for ours, theirs in zip(
        jax.tree.leaves(state.params), jax.tree.leaves(policy.params), strict=True
    ):
        assert ours.unsafe_buffer_pointer() != theirs.unsafe_buffer_pointer()


@pytest.mark.parametrize("cut", [True, False])
def test_a_library_call_cuts_trajectories_where_the_world_allows_it(
    toy: Any, monkeypatch: pytest.MonkeyPatch, cut: bool
) -> None:
    class AskedError(Exception):
        pass

    def planning(config: TrainConfig, dataset: Dataset, truncate: bool, *more: Any) -> None:
        raise AskedError(truncate)

    monkeypatch.setattr("mgpo_jax.training.batch_stream", planning)
    dataset, policy = toy
    with pytest.raises(AskedError) as asked:
        pretrain(dataset, replace(SPEC, truncate_in_hindsight=cut), TRAIN, policy)
    assert asked.value.args == (cut,)


@pytest.mark.parametrize("env", ["maze15", "gridworld"])
def test_a_run_trains_on_what_is_not_held_out_and_cuts_it_where_the_world_allows_it(
    env: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every trajectory has a length of its own, the last two are held out."""
    spec, num = training.envs.make(env).spec, 12
    lengths = np.arange(21, 21 + num, dtype=np.int32)
    goals = np.zeros((lengths.sum(), spec.goal_dim), np.float32)
    whole = Dataset(
        obs=np.zeros((len(goals), *spec.obs.shape), spec.obs.dtype),
        actions=np.zeros(len(goals), np.int32),
        achieved_goals=goals,
        goal_reached=np.ones(len(goals), bool),
        outcomes=goals,
        lengths=lengths,
    )
    monkeypatch.setattr(training, "prepare_dataset", lambda *args: (whole, tmp_path, "0" * 64))
    monkeypatch.setattr(training, "watched", lambda *args: lambda params: {})
    config = parsed(f"{BASE} --env {env} --embed-dim 8 --num-layers 1")
    run = training.Run(replace(config, holdout=2, out=tmp_path), "")
    np.testing.assert_array_equal(run.fit.lengths, lengths[:-2])
    np.testing.assert_array_equal(run._held_out.lengths, lengths[-2:])
    parts = [part for batch in islice(run.batches(0), 8) for part in batch]
    assert max(part.indices.max() for part in parts) == num - 3
    cut = np.concatenate([lengths[part.indices] - part.lengths for part in parts])
    assert cut.min() >= 0
    assert (cut > 0).any() == spec.truncate_in_hindsight == (env == "maze15")
