"""``experiments.release``: the released files, and runs that are refused before anything is written."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from experiments.release import command
from experiments.store.metrics import cpu_seconds_of_training
from experiments.store.settings import PretrainConfig
from mgpo_jax.files import to_json
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy_files import load_policy, save_policy
from mgpo_jax.prompts import single_goal
from mgpo_jax.tasks import load_tasks, num_tasks
from mgpo_jax.transformer import GoalTransformer

ROW = {
    "train/loss": 1.5, "val/loss": 1.6, "val/accuracy": 0.4, "eval/initial_return": 0.1,
    "cpu_seconds_per_step": 0.5,
}  # fmt: skip


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A finished run in ``gridworld``, as a training leaves it."""
    env = envs.make("gridworld")
    config = network_config(env.spec, embed_dim=8, num_layers=1)
    prompt = single_goal(jnp.zeros(env.spec.goal_dim), 5)
    obs, actions = jnp.zeros((1, *env.spec.obs.shape)), jnp.zeros(1, jnp.int32)
    params = GoalTransformer(config).init(jax.random.key(0), prompt, obs, actions)
    settings = to_json(PretrainConfig(env="gridworld"))
    made = {"env": "gridworld", "config": settings, "steps": 4}
    save_policy(tmp_path / "run" / "policy", config, params, made)
    rows = "".join(json.dumps({"step": step, **ROW}) + "\n" for step in (2, 4))
    (tmp_path / "run" / "metrics.jsonl").write_text(rows)
    command = "python -m experiments.pretrain --out /tmp/a --steps 4 --out=b"
    meta = {"command": command.split(), "revision": "x"}
    (tmp_path / "run" / "meta.json").write_text(json.dumps(meta))
    (tmp_path / "run" / "training.png").touch()
    return tmp_path / "run"


Release = Callable[..., tuple[int, str]]


@pytest.fixture
def release(run: Path, capsys: pytest.CaptureFixture[str]) -> Release:
    """Runs the command; returns its exit code and what it wrote to stderr."""

    def call(*more: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as stop:
            command([str(run), "--out", str(run.with_name("packed")), *more])
        return int(stop.value.code or 0), capsys.readouterr().err

    return call


def test_a_run_is_packed(run: Path, release: Release) -> None:
    assert release()[0] == 0
    packed = run.with_name("packed")
    assert {path.name for path in packed.iterdir()} == {
        "README.md", "config.json", "metrics.jsonl", "tasks.npz", "training.png", "weights.npz",
    }  # fmt: skip
    world = envs.find("gridworld")
    assert num_tasks(load_tasks(packed / "tasks.npz", world.make())) == world.num_test_tasks
    assert load_policy(world, packed).made["steps"] == 4
    assert "\n    python -m experiments.pretrain --steps 4\n" in (packed / "README.md").read_text()
    assert not list(run.parent.glob("*.partial"))


def test_a_run_without_meta_is_packed(run: Path, release: Release) -> None:
    (run / "meta.json").unlink()
    assert release()[0] == 0
    assert "(not known)" in (run.with_name("packed") / "README.md").read_text()


def test_a_release_that_breaks_off_leaves_nothing(
    run: Path, release: Release, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*args: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("experiments.store.cards.save_tasks", stop)
        assert release()[0] == 130
    assert [path.name for path in run.parent.iterdir() if path.name != "run"] == []
    assert release()[0] == 0


def test_the_card_names_the_policy_that_a_training_began_from(run: Path, release: Release) -> None:
    card = run.with_name("packed") / "README.md"
    assert release()[0] == 0
    assert "initialized from" not in card.read_text()
    shutil.rmtree(card.parent)
    configured(config=CONTINUED, init_sha256="0a" * 32)(run)
    assert release()[0] == 0
    row = f"| initialized from | the weights of the policy the/first\\n, SHA-256 {'0a' * 32} |"
    assert row in card.read_text().splitlines()


def test_the_card_tells_how_that_policy_was_trained(run: Path, release: Release) -> None:
    shutil.copytree(run / "policy", run / "init")
    configured("init", config=CONTINUED, init_sha256="0b" * 32)(run)
    configured(config=CONTINUED, init_sha256="0a" * 32)(run)
    assert release()[0] == 0
    before = PretrainConfig(env="gridworld")
    row = (
        f"| that policy was trained for | {before.train.steps:,} steps of {before.train.batch_size} "
        f"trajectories, {before.data.trajectories:,} demonstrations, seed 0; initialized from "
        f"the weights of the policy the/first\\n, SHA-256 {'0b' * 32} |"
    )
    assert row in (run.with_name("packed") / "README.md").read_text().splitlines()


def test_the_card_says_that_the_data_are_a_users_own(run: Path, release: Release) -> None:
    """Of any name, in a world whose demonstrators have made none of them."""
    path = run / "policy" / "config.json"
    document = json.loads(path.read_text())
    document["made"]["config"]["data"] |= {"data_folder": "logs/mine", "trajectories": 321}
    path.write_text(json.dumps(document))
    assert release()[0] == 0
    card = (run.with_name("packed") / "README.md").read_text()
    assert "| data | 321 trajectories of the dataset mine |" in card
    assert "demonstrations" not in card


@pytest.mark.parametrize(
    ("sha256", "text"),
    [("0c" * 32, "seed 0 (6,798 in stock, 2 in reduced) |"), ("0d" * 32, "seed 0 |")],
)
def test_the_card_counts_the_variants_of_the_dataset(
    run: Path, release: Release, sha256: str, text: str
) -> None:
    """A manifest that is of other data by now says nothing."""
    data = run.with_name("data")
    data.mkdir()
    manifest = {"format": 2, "sha256": "0c" * 32, "variants": {"stock": 6798, "reduced": 2}}
    (data / "manifest.json").write_text(json.dumps(manifest))
    meta = {"dataset": str(data), "dataset_sha256": sha256}
    (run / "meta.json").write_text(json.dumps(meta))
    assert release()[0] == 0
    row = (run.with_name("packed") / "README.md").read_text().splitlines()[6]
    assert row.startswith("| data | ")
    assert row.endswith(text)


def configured(folder: str = "policy", **changes: Any) -> Callable[[Path], Any]:
    """Change entries of ``made`` in the config of a policy of the run."""

    def damage(run: Path) -> None:
        path = run / folder / "config.json"
        document = json.loads(path.read_text())
        document["made"] = {**document["made"], **changes}
        path.write_text(json.dumps(document))

    return damage


def written(name: str, text: str) -> Callable[[Path], Any]:
    return lambda run: (run / name).write_text(text)


CONTINUED = to_json(PretrainConfig(env="gridworld", init=Path("the/first\n")))
CUT = json.dumps({"step": 2, **ROW}) + '\n{"step": 4, "trai'
DAMAGES = {
    "another world": (configured(env="maze15"), "has obs_shape (9,), maze15 needs (6,)"),
    "an unknown world": (configured(env="gridworl"), "did you mean 'gridworld'"),
    "a place": (configured(env="no_such:WORLD"), "give it with --env no_such:WORLD"),
    "no world": (configured(env=None), "lacks made.env or made.config"),
    "settings of another world": (
        configured(config=to_json(PretrainConfig(env="maze15"))),
        "made.env is 'gridworld', made.config.env is 'maze15'",
    ),
    "no hash of the weights that it began from": (
        configured(config=CONTINUED),
        "has made.config.init, but lacks made.init_sha256",
    ),
    "a hash that is none": (
        configured(config=CONTINUED, init_sha256="ab"),
        "made.init_sha256 must be a SHA-256, 64 hexadecimal digits, found 'ab'",
    ),
    "no settings": (configured(config=[]), "made.config must be an object, found []"),
    "no metrics": (lambda run: (run / "metrics.jsonl").unlink(), "metrics.jsonl is missing"),
    "empty metrics": (written("metrics.jsonl", ""), "metrics.jsonl has no rows"),
    "cut metrics": (written("metrics.jsonl", CUT), "metrics.jsonl, line 2 is not readable JSON"),
    "lists": (written("metrics.jsonl", "[]\n"), "line 1 does not hold a JSON object"),
    "no loss": (
        written("metrics.jsonl", json.dumps({"step": 2, **ROW, "val/loss": None}) + "\n"),
        "line 1: val/loss must be a number, found None",
    ),
    "a metric less": (
        written("metrics.jsonl", '{"step": 2}\n'),
        "line 1 lacks train/loss, val/loss, val/accuracy",
    ),
    "no object": (written("meta.json", "[]"), "meta.json does not hold a JSON object"),
    "no command": (written("meta.json", '{"command": 7}'), "command must be a list, found 7"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_runs_that_are_refused(run: Path, release: Release, name: str) -> None:
    damage, says = DAMAGES[name]
    damage(run)
    code, text = release()
    assert code == 1, text
    assert says in text
    assert text.startswith("error: ")
    assert text.count("\n") == 1
    assert not run.with_name("packed").exists()


def test_weights_that_are_not_finite_are_refused(run: Path, release: Release) -> None:
    weights = dict(np.load(run / "policy" / "weights.npz"))
    np.savez(run / "policy" / "weights.npz", **{k: v * np.nan for k, v in weights.items()})
    code, text = release()
    assert (code, "differs from the hash" in text) == (1, True), text


def test_requests_that_are_refused(run: Path, release: Release) -> None:
    code, text = release("--env", "maze15")
    assert (code, "--env maze15, but the policy in" in text) == (2, True), text
    (run / "policy" / "config.json").unlink()
    code, text = release()
    assert (code, "no finished policy" in text) == (2, True), text


def test_the_cpu_time_of_a_training_is_that_of_its_steps() -> None:
    rows = [{"step": 60, "cpu_seconds_per_step": 0.5}, {"step": 120, "cpu_seconds_per_step": 1.0}]
    assert cpu_seconds_of_training(rows) == pytest.approx(90)
    assert cpu_seconds_of_training([*rows, {"step": 180}]) is None
