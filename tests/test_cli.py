"""The commands: helpful errors, no file overwritten, and interrupted runs that continue."""

from __future__ import annotations

import errno
import importlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.errors import MissingExtraError
from envs.registry import WORLDS
from experiments import adaptation, pretrain, runtime, training
from experiments.__main__ import COMMANDS
from experiments.parsing import parse
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.presets import pretrain_default, pretrain_preset
from experiments.store.settings import PretrainConfig
from mgpo_jax import methods
from mgpo_jax.dataset import load_dataset
from mgpo_jax.files import hash_file
from mgpo_jax.kinds import KINDS
from mgpo_jax.policy_files import load_policy, read_policy
from mgpo_jax.tasks import (
    benchmark_tasks,
    load_tasks,
    num_tasks,
    sample_tasks,
    save_tasks,
    task_hashes,
)
from mgpo_jax.tasks import (
    test_tasks as released_tasks,
)
from mgpo_jax.training import Trainer

ROOT = Path(__file__).parents[1]
Run = Callable[..., tuple[int, str]]


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runtime, "configure", lambda: None)
    monkeypatch.delenv("MGPO_DATA", raising=False)


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command in this process; returns its exit code and what it wrote to stderr."""

    def call(line: str) -> tuple[int, str]:
        name, *words = line.split()
        with pytest.raises(SystemExit) as stop:
            importlib.import_module(f"experiments.{name}").command(words)
        return int(stop.value.code or 0), capsys.readouterr().err

    return call


TINY = (
    "pretrain --preset smoke --episodes 40 --holdout 8 --embed-dim 8 --num-layers 1 --steps 6 "
    "--batch-size 8 --part-size 4 --bucket 64 --eval-tasks 2 --eval-every 3 --save-every 2"
)


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pre-training run of six steps, with its dataset."""
    root = tmp_path_factory.mktemp("tiny")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        pretrain.main(tyro_config(TINY))
    return root


def tyro_config(line: str) -> PretrainConfig:
    return parse(PretrainConfig, line.split()[1:], pretrain_default)


@pytest.fixture
def workspace(tiny_run: Path, tmp_path: Path) -> Path:
    """A copy of the tiny run as the current folder."""
    shutil.copytree(tiny_run, tmp_path, dirs_exist_ok=True)
    return tmp_path


RUN = Path("runs/pretrain/maze15/smoke-seed0")
POLICY = RUN / "policy"
RESULT = Path(__file__).parents[1] / "results/maze15/ucb"


@pytest.mark.parametrize(
    ("line", "code", "says"),
    [
        ("adapt --env maze51", 2, "did you mean 'maze15'"),
        ("adapt --bandit ubc", 2, "did you mean 'ucb'"),
        ("adapt --episodes 0", 2, "--episodes must be at least 1"),
        ("adapt --seeds 0", 2, "--seeds must be at least 1"),
        ("adapt --bandit bpe --c 2", 2, "--c is not a setting of bpe; it belongs to ucb"),
        ("adapt --bandit bbt --std-init 0", 2, "--std-init must be above 0"),
        ("adapt --bandit ucb --scale nan", 2, "--scale must be a finite number"),
        ("adapt --validation --tasks mine.npz", 2, "--validation draws the tasks"),
        ("adapt --validation-seed 1", 2, "add --validation"),
        ("adapt --policy nowhere", 2, "no policy in nowhere"),
        ("adapt --bandit gcbc --max-goals 3", 2, "not a setting of gcbc; it belongs to ucb, bpe"),
        ("adapt --method grips --no-keep-rewarded", 2, "--keep-rewarded is not a setting of grips"),
        (
            "adapt --method=bbt --num_edits=4",
            2,
            "--num-edits is not a setting of bbt; it belongs to gr",
        ),
        ("adapt --method bbt --population-size 1", 2, "--population-size must be at least 2"),
        ("adapt --method nowhere:METHOD", 2, "cannot load the method 'nowhere:METHOD'"),
        ("adapt --eval-episodes 0", 2, "--eval-episodes must be at least 1"),
        ("collect --demonstrator astr4", 2, "did you mean 'astar4'"),
        ("collect --trajectories 0", 2, "--trajectories must be at least 1"),
        ("collect --env envs.maze:MAZE51", 2, "cannot load the world 'envs.maze:MAZE51'"),
        ("pretrain --env gridwrld", 2, "unknown world 'gridwrld'; did you mean 'gridworld'?"),
        ("pretrain --preset papr", 2, "did you mean 'paper'"),
        ("pretrain --steps 0", 2, "--steps must be at least 1"),
        ("pretrain --resume --out nothing --preset smoke --episodes 0", 2, "--trajectories must"),
        ("pretrain --policy astar3 --preset smoke", 2, "did you mean 'astar"),
        ("pretrain --batch-size 10 --part-size 4", 2, "not a multiple"),
        ("collect --policy astr4", 2, "did you mean 'astar4'"),
        ("collect --episodes 0", 2, "--trajectories must be at least 1"),
        ("evaluate", 2, "no result folder given"),
        (f"evaluate {RESULT} --obs-noise -1", 2, "--obs-noise must be at least 0"),
        (f"evaluate {RESULT} --obs-noise nan", 2, "--obs-noise must be a finite number"),
        (f"evaluate {RESULT} --action-noise 0.1 -1", 2, "--action-noise must be at least 0"),
        ("evaluate nowhere", 1, "no result folder nowhere"),
        ("pretrain --obs-noise -1", 2, "--obs-noise must be at least 0"),
        ("pretrain --obs-noise nan", 2, "--obs-noise must be a finite number"),
    ],
)
def test_usage_errors_name_the_mend(command: Run, line: str, code: int, says: str) -> None:
    found, text = command(line)
    assert (found, says in text) == (code, True), text
    assert "Traceback" not in text
    assert len(text.strip().splitlines()) == 1


@pytest.mark.parametrize("line", ["adapt --nonsense 1", "adapt --episodes many"])
def test_unknown_flags_and_values_exit_with_2(command: Run, line: str) -> None:
    assert command(line)[0] == 2


def test_debug_shows_the_traceback(command: Run) -> None:
    code, text = command("adapt --env maze51 --debug")
    assert code == 2
    assert "Traceback" in text


def test_unexpected_errors_are_one_line(command: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(envs, "make", lambda name: 1 / 0)
    code, text = command("collect")
    assert code == 1
    assert text.startswith("error: unexpected error: division by zero; ")
    assert "--debug" in text
    assert "Traceback" not in text


def test_a_missing_package_is_an_error_of_usage(
    command: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> None:
        raise MissingExtraError("it needs a package; install it")

    monkeypatch.setattr(envs, "make", missing)
    assert command("collect") == (2, "error: it needs a package; install it\n")


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch, command: Run) -> Callable[[str], Any]:
    """What a command line is parsed into."""

    def parse(line: str) -> Any:
        found: list[Any] = []
        module = importlib.import_module(f"experiments.{line.split()[0]}")
        monkeypatch.setattr(module, "main", found.append)
        code, text = command(line)
        assert code == 0, text
        return found[0]

    return parse


def test_bandit_is_another_name_of_method(parsed: Callable[[str], Any]) -> None:
    wanted = parsed("adapt --method bpe --min-std 0.1")
    assert (wanted.method, wanted.hyper) == ("bpe", methods.BpeHyper(min_std=0.1))
    assert wanted.folder == Path("runs/adapt/maze15/bpe-seed0")
    for line in (
        "--bandit bpe --min-std 0.1",
        "--min-std=0.1 --bandit=bpe",
        "--min_std 0.1 --bandit bpe",
    ):
        assert parsed(f"adapt {line}") == wanted
    assert parsed("adapt").hyper == methods.UcbHyper()
    assert parsed("adapt --method grips --num-edits 3").hyper == methods.GripsHyper(num_edits=3)


@pytest.mark.parametrize(
    "line", ["collect", "pretrain --preset smoke", "bench", "reproduce table5"]
)
def test_older_names_of_flags_stay(parsed: Callable[[str], Any], line: str) -> None:
    new, old = "--trajectories 77", "--episodes 77"
    if not line.startswith("reproduce"):
        new, old = f"{new} --demonstrator astar2", f"{old} --policy astar2"
    found = parsed(f"{line} {new}")
    assert parsed(f"{line} {old}") == found
    data = getattr(found, "data", found)
    assert data.trajectories == 77
    assert getattr(data, "demonstrator", "astar2") == "astar2"


def run_python(words: str, here: Path) -> subprocess.CompletedProcess[str]:
    """A process of its own whose current folder is ``here``."""
    path = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *words.split()]
    return subprocess.run(command, check=False, cwd=here, env=path, capture_output=True, text=True)


def test_the_console_script_lists_its_commands(tmp_path: Path) -> None:
    for words in ("-m experiments", "-m experiments --help"):
        done = run_python(words, tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
        listed = [line.split()[0] for line in done.stdout.splitlines()[2:]]
        assert listed == list(COMMANDS)
    modules = {path.stem for path in (ROOT / "experiments").glob("*.py")}
    assert modules >= set(COMMANDS)


def test_the_console_script_runs_its_commands(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    entry = importlib.import_module("experiments.__main__").main
    for words, code, says in (
        (["adpt"], 2, "error: unknown command 'adpt'; did you mean 'adapt'?"),
        (["adapt", "--env", "maze51"], 2, "did you mean 'maze15'?"),
        (["evaluate"], 2, "no result folder given"),
        (["list"], 0, ""),
        (["--version"], 0, ""),
    ):
        monkeypatch.setattr(sys, "argv", ["mgpo", *words])
        with pytest.raises(SystemExit) as stop:
            entry()
        text = capsys.readouterr().err
        assert (stop.value.code, says in text) == (code, True), text
        assert len(text.strip().splitlines()) == (code > 0)


def test_list_names_worlds_and_methods(tmp_path: Path) -> None:
    done = run_python("-m experiments.list", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    first = {row.split()[0]: row for row in done.stdout.splitlines() if re.match(r"  \S", row)}
    assert set(first) == {*envs.names(), *methods.names(), *KINDS.names()}
    assert envs.find("maze15").summary in first["maze15"]
    assert methods.find("bbt").summary in first["bbt"]
    assert all(len(line.split()) > 3 for line in first.values())


def test_folders_in_the_current_folder_hide_nothing_of_ours(tmp_path: Path) -> None:
    for name in ("envs", "mgpo_jax"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('not ours')\n")
    done = run_python("-m experiments.list", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "maze15" in done.stdout
    done = run_python("-m experiments list", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    done = run_python("-m experiments.collect --env envs.maze:MAZE51", tmp_path)
    assert (done.returncode, "no attribute 'MAZE51'" in done.stderr) == (2, True), done.stderr


def test_existing_folders_are_never_overwritten(command: Run, workspace: Path) -> None:
    before = {path: path.read_bytes() for path in workspace.rglob("*") if path.is_file()}
    for line in (TINY, "collect --episodes 40"):
        code, text = command(line)
        assert code == 2
        assert "already exists" in text
    code, text = command(f"adapt --policy {POLICY} --out runs --episodes 1")
    assert (code, "already exists" in text) == (2, True)
    assert before == {path: path.read_bytes() for path in workspace.rglob("*") if path.is_file()}


def test_damaged_dataset_is_refused(command: Run, workspace: Path) -> None:
    arrays = workspace / "data/maze15/astar4-40-seed0/trajectories.npz"
    arrays.write_bytes(arrays.read_bytes()[:-100])
    code, text = command(TINY.replace("--steps 6", "--steps 6 --out other"))
    assert code == 1
    assert "differs from the hash" in text
    assert not Path("other").exists()


def test_dataset_is_made_by_its_seed_and_holds_no_test_task(command: Run, workspace: Path) -> None:
    assert command("collect --episodes 40 --out again")[0] == 0
    env = envs.make("maze15")
    first, facts = load_dataset(workspace / "data/maze15/astar4-40-seed0", env.spec)
    second, again = load_dataset(Path("again"), env.spec)
    for name, array in vars(first).items():
        np.testing.assert_array_equal(array, getattr(second, name))
    assert facts["length"] == again["length"]
    assert facts["num_trajectories"] == 40
    assert first.lengths.min() >= 20
    hashes = task_hashes(env, benchmark_tasks(env, 50))
    assert len(set(hashes)) == 50
    assert not np.isin(first.task_hashes, hashes).any()


def weights(folder: Path) -> Any:
    return read_policy(folder / "policy").params


def test_resumed_run_equals_an_uninterrupted_one(
    command: Run, workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C after step 4 saves and exits with 130; --resume then ends in the same bits."""

    @contextmanager
    def ctrl_c_after_four_steps() -> Iterator[Callable[[], int]]:
        asked = iter([0, 0, 0, signal.SIGINT])  # one question a step
        yield lambda: next(asked)

    line = f"{TINY} --out second"
    with monkeypatch.context() as patch:
        patch.setattr(training, "asked_to_stop", ctrl_c_after_four_steps)
        code, text = command(line)
    assert code == 130
    assert "stopped at step 4 of 6; continue with --resume" in text
    assert not Path("second/policy").exists()
    code, text = command(line.replace("--save-every 2", "--save-every 5") + " --resume")
    assert code == 0, text
    assert "resuming second at step 4" in text
    jax.tree.map(np.testing.assert_array_equal, weights(Path("second")), weights(RUN))
    rows = [
        [json.loads(row) for row in (run / "metrics.jsonl").read_text().splitlines()]
        for run in (RUN, Path("second"))
    ]
    for row in (*rows[0], *rows[1]):
        assert row.pop("cpu_seconds_per_step") > 0
    assert rows[0] == rows[1]
    assert [row["step"] for row in rows[0]] == [3, 6]


def test_a_moved_run_goes_on(command: Run, workspace: Path) -> None:
    """Its place, loggers and the cadence of evaluations are no settings of a training."""
    shutil.move(RUN, "elsewhere")
    shutil.rmtree("elsewhere/policy")
    line = TINY.replace("--eval-every 3", "--eval-every 2")
    code, text = command(f"{line} --resume --out {Path('elsewhere').absolute()}")
    assert code == 0, text
    assert (workspace / "elsewhere/policy/weights.npz").is_file()


def test_training_on_another_dataset_is_refused(command: Run, workspace: Path) -> None:
    data = workspace / "data/maze15/astar4-40-seed0"
    shutil.rmtree(data)
    (workspace / RUN / "training.png").unlink()  # the run is not quite finished
    assert command("collect --episodes 40 --seed 5")[0] == 0
    shutil.move(workspace / "data/maze15/astar4-40-seed5", data)
    manifest = json.loads((data / "manifest.json").read_text())
    (data / "manifest.json").write_text(json.dumps({**manifest, "seed": 0}))
    code, text = command(f"{TINY} --resume")
    assert code == 1
    assert "which now has" in text
    assert "collect it again as it was, or start a new run with --out" in text


@pytest.mark.parametrize("line", ["", "--resume"])
def test_a_folder_in_which_no_run_has_begun_is_started_in(
    command: Run, workspace: Path, line: str
) -> None:
    """What a kill at the very start leaves, in this version and in older ones."""
    fresh = Path("fresh")
    fresh.mkdir()
    for name in (".lock", "meta.json", "config.json.partial", ".writing-00ff.json"):
        (fresh / name).write_text("")
    code, text = command(f"{TINY} --out fresh {line}")
    assert code == 0, text
    assert {path.name for path in fresh.iterdir()} == {path.name for path in RUN.iterdir()}


def test_a_folder_with_other_files_is_left_alone(command: Run, workspace: Path) -> None:
    Path("mine").mkdir()
    Path("mine/thesis.tex").write_text("")
    code, text = command(f"{TINY} --out mine --resume")
    assert (code, "mine already exists and is not a training run" in text) == (2, True)
    assert [path.name for path in Path("mine").iterdir()] == ["thesis.tex"]


def test_a_run_without_meta_goes_on(command: Run, workspace: Path) -> None:
    (workspace / RUN / "meta.json").unlink()
    (workspace / RUN / "training.png").unlink()  # the last thing that a run writes
    assert command(f"{TINY} --resume")[0] == 0
    assert "dataset_sha256" in json.loads((workspace / RUN / "meta.json").read_text())


def test_a_torn_row_of_metrics_is_made_good(command: Run, workspace: Path) -> None:
    """The rows are in the checkpoint as well."""
    path = workspace / RUN / "metrics.jsonl"
    whole = path.read_text()
    path.write_text(whole[:-40] + "\0\0")
    (workspace / RUN / "training.png").unlink()  # the last thing that a run writes
    assert command(f"{TINY} --resume")[0] == 0
    assert path.read_text() == whole


def test_a_checkpoint_of_an_older_version_keeps_the_rows_of_the_file(
    command: Run, workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It does not hold them; the file is all that there is."""
    path = workspace / RUN / "metrics.jsonl"
    whole = path.read_text()
    path.write_text(whole + "{torn")
    (workspace / RUN / "training.png").unlink()
    restore = training.restore_state

    def without_rows(*args: Any) -> Any:
        return restore(*args)._replace(measured=None)

    monkeypatch.setattr(training, "restore_state", without_rows)
    code, text = command(f"{TINY} --resume")
    assert code == 0
    assert "1 rows are damaged and left out" in text
    assert path.read_text() == whole


def test_a_finished_run_has_nothing_left_to_do(command: Run, workspace: Path) -> None:
    """Neither its dataset nor its policy is touched."""
    shutil.rmtree("data")
    before = {path: path.read_bytes() for path in RUN.rglob("*") if path.is_file()}
    code, text = command(f"{TINY} --resume")
    assert (code, text) == (0, f"{RUN} is already finished\n")
    assert before == {path: path.read_bytes() for path in RUN.rglob("*") if path.is_file()}
    assert not Path("data").exists()
    code, text = command(f"{TINY} --resume --data-seed 7")
    assert (code, "data_seed 0 -> 7" in text) == (2, True)
    assert not Path("data").exists()


def test_a_loss_that_is_not_finite_stops_the_training(
    command: Run, workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last sound checkpoint stays, and there is no policy."""
    step = Trainer.step

    def broken(self: Trainer, state: Any, plans: Any) -> Any:
        state, metrics = step(self, state, plans)
        if state.step == 5:
            metrics = {**metrics, "loss": jnp.float32(jnp.nan)}
        return state, metrics

    monkeypatch.setattr(Trainer, "step", broken)
    code, text = command(f"{TINY} --out broken")
    assert code == 1
    assert "training stopped at step 5: train/loss became nan; start a new run with a lower" in text
    assert not Path("broken/policy").exists()
    assert {path.name for path in Path("broken/checkpoints").iterdir()} == {"2", "4"}
    rows = Path("broken/metrics.jsonl").read_text()
    assert [json.loads(row)["step"] for row in rows.splitlines()] == [3]


def test_weights_that_are_not_finite_stop_the_training(command: Run, workspace: Path) -> None:
    line = TINY.replace("--steps 6", "--steps 60").replace("--eval-every 3", "--eval-every 60")
    code, text = command(
        f"{line} --out broken --learning-rate 100 --warmup-steps 0 --weight-decay 1000 "
        "--optimizer adamw --schedule constant"
    )
    assert code == 1
    assert "training stopped at step" in text
    assert not Path("broken/policy").exists()


def test_resume_refuses_other_settings(command: Run, workspace: Path) -> None:
    code, text = command(f"{TINY} --resume --learning-rate 0.5")
    assert code == 2
    assert "started with other settings" in text
    assert "0.5" in text


def test_adapt_writes_what_it_prints(
    command: Run, workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = (
        f"adapt --policy {POLICY} --episodes 5 --eval-every 2 --seeds 2 --out result --no-figures"
    )
    small = sample_tasks(envs.make("maze15"), 5, 3)
    save_tasks(Path("mine.npz"), small)
    code, text = command(f"{line} --tasks mine.npz")
    assert code == 0, text
    summary = json.loads(Path("result/summary.json").read_text())
    raw = np.load("result/results.npz")
    assert raw["returns"].shape == raw["choice.greedy"].shape == (2, 3, 5)
    assert raw["choice.prompt.goals"].shape == raw["best.prompt.goals"].shape == (2, 3, 5, 5, 2)
    np.testing.assert_array_equal(raw["eval_episodes"], [1, 2, 4, 5])
    assert summary["num_tasks"] == 3
    assert summary["num_seeds"] == 2
    assert summary["num_episodes"] == 5
    assert summary["initial_return"] == pytest.approx(raw["returns"][:, :, 0].mean())
    assert summary["failed_episodes"] == 0
    assert summary["final_return"] == pytest.approx(raw["eval_returns"][:, :, -1].mean())
    assert summary["regret"] == pytest.approx(
        (raw["optimal_returns"] - raw["eval_returns"][:, :, -1]).mean()
    )
    # Mazes are deterministic: what the search saw is what the evaluation sees.
    greedy = np.where(raw["choice.greedy"], raw["returns"], -np.inf)
    np.testing.assert_allclose(
        np.maximum.accumulate(greedy, axis=-1)[:, :, [0, 1, 3, 4]], raw["eval_returns"], atol=1e-5
    )

    code, text = command(f"{line} --tasks mine.npz --resume")
    assert (code, "result is already finished" in text) == (0, True)
    save_tasks(Path("others.npz"), sample_tasks(envs.make("maze15"), 6, 3))
    code, text = command(f"{line} --tasks others.npz --resume")
    assert code == 2
    assert "result holds results of other settings: tasks_sha256" in text

    code, text = command(f"{line.replace('result', 'others')} --validation")
    assert code == 0, text
    env = envs.make("maze15")
    others, tests = load_tasks(Path("others/tasks.npz"), env), benchmark_tasks(env, 50)
    assert num_tasks(others) == num_tasks(tests)
    assert not np.isin(task_hashes(env, others), task_hashes(env, tests)).any()

    code, text = command("evaluate result --episodes 1 --json noise.json")
    assert code == 0, text
    (row,) = json.loads(Path("noise.json").read_text())["rows"]
    assert row["noise"] == "none"
    assert row["return"] == pytest.approx(summary["final_return"])
    assert row["change"] == pytest.approx(0, abs=1e-5)
    assert command("evaluate result --json noise.json")[0] == 2  # it is there already


def test_evaluate_under_noise(command: Run, workspace: Path) -> None:
    save_tasks(Path("mine.npz"), sample_tasks(envs.make("maze15"), 5, 3))
    code, text = command(
        f"adapt --policy {POLICY} --episodes 2 --tasks mine.npz --out result --no-figures"
    )
    assert code == 0, text
    summary = json.loads(Path("result/summary.json").read_text())
    code, text = command(
        "evaluate result --episodes 1 --obs-noise 0.5 0 --action-noise 1 --json noises.json"
    )
    assert code == 0, text
    rows = json.loads(Path("noises.json").read_text())["rows"]
    noises = ["observations 0.5", "none", "actions 1"]
    assert [row["noise"] for row in rows] == noises
    assert rows[1]["return"] == pytest.approx(summary["final_return"])


def test_results_know_the_weights_they_were_made_with(command: Run, workspace: Path) -> None:
    code, text = command(f"adapt --policy {POLICY} --seeds 1 --episodes 2 --out result")
    assert code == 0, text
    weights, config = POLICY / "weights.npz", POLICY / "config.json"
    assert json.loads(Path("result/summary.json").read_text())["policy_sha256"] == hash_file(
        weights
    )
    with np.load(weights) as file:
        other = {name: array + 1 for name, array in file.items()}
    np.savez(weights, allow_pickle=False, **other)
    config.write_text(json.dumps({**json.loads(config.read_text()), "sha256": hash_file(weights)}))
    for line in ("evaluate result --episodes 1", "plot result"):
        code, text = command(line)
        assert code == 1
        assert "not those that the results of maze15 ucb were found with" in text


def test_prompts_longer_than_trained(command: Run, workspace: Path) -> None:
    code, text = command(f"adapt --policy {POLICY} --max-goals 6 --out result")
    assert code == 2
    assert "longer than the policy's prompts (5 goals)" in text


def broken(tasks: Any, **changes: Any) -> dict[str, np.ndarray]:
    return {**{k: np.array(v) for k, v in tasks._asdict().items()}, **changes}


def walled_in(tasks: Any) -> np.ndarray:
    """Nothing is free but start and goal."""
    maze = np.ones_like(tasks.maze)
    maze[:, 13, 7] = 0
    maze[np.arange(len(maze)), tasks.goal[:, 0], tasks.goal[:, 1]] = 0
    return maze


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: {"goal": None}, "lacks goal"),
        (lambda t: {"maze": t.maze[:, :13]}, "maze has shape [2, 13, 15], wanted [task 2, 15, 15]"),
        (lambda t: {"maze": t.maze * 2}, "0 (free) and 1 (wall) only"),
        (lambda t: {"goal": t.goal * 0}, "is not a free cell"),
        (lambda t: {"goal": np.full_like(t.goal, 99)}, "is not a free cell"),
        (lambda t: {"goal": t.goal + 0.5}, "integers"),
        (lambda t: {"goal": t.goal[:1]}, "goal has shape [1, 2], wanted [task 2, 2]"),
        (lambda t: {"maze": walled_in(t)}, "no free path leads from the start"),
        (lambda t: {"maze": t.maze * np.nan}, "maze must hold integers, found float64"),
    ],
)
def test_bad_task_files(
    command: Run, workspace: Path, change: Callable[[Any], dict[str, Any]], says: str
) -> None:
    tasks = jax.tree.map(np.asarray, sample_tasks(envs.make("maze15"), 5, 2))
    arrays = {k: v for k, v in broken(tasks, **change(tasks)).items() if v is not None}
    np.savez("bad.npz", **arrays)
    code, text = command(f"adapt --policy {POLICY} --tasks bad.npz --out result")
    assert code == 1, text
    assert says in text
    assert not Path("result").exists()


def test_task_file_that_is_missing_or_no_npz(command: Run, workspace: Path) -> None:
    assert command(f"adapt --policy {POLICY} --tasks none.npz")[0] == 2
    for content in (b"no", b"", b"\x93NUMPY"):
        Path("text.npz").write_bytes(content)
        code, text = command(f"adapt --policy {POLICY} --tasks text.npz")
        assert code == 1
        assert "not a readable npz" in text


def test_task_file_of_single_numbers(command: Run, workspace: Path) -> None:
    np.savez("bad.npz", maze=1, goal=2)
    code, text = command(f"adapt --policy {POLICY} --tasks bad.npz")
    assert (code, "bad.npz: maze has shape [], wanted [task 1 to" in text) == (1, True), text


def test_tasks_survive_the_file(tmp_path: Path) -> None:
    env = envs.make("maze15")
    tasks = benchmark_tasks(env, 4)
    save_tasks(tmp_path / "tasks.npz", tasks)
    jax.tree.map(np.testing.assert_array_equal, load_tasks(tmp_path / "tasks.npz", env), tasks)


def test_presets_differ_as_they_say() -> None:
    paper = pretrain_preset("maze15", "paper")
    assert (paper.train.steps, paper.train.learning_rate, paper.dropout) == (50_000, 1e-4, 0.1)
    assert (paper.data.trajectories, paper.prompt_order) == (10_000, False)
    assert parse(PretrainConfig, [], pretrain_default) == pretrain_preset("maze15", "fast")


def test_release_packs_a_run_with_its_card(command: Run, workspace: Path) -> None:
    assert command(f"release {RUN} --out packed") == (0, "released in packed\n")
    packed = read_policy(Path("packed"))
    assert (packed.config.embed_dim, packed.made["steps"]) == (8, 6)
    env = envs.make("maze15")
    tasks = load_tasks(Path("packed/tasks.npz"), env)
    assert (task_hashes(env, tasks) == task_hashes(env, benchmark_tasks(env, 50))).all()
    card = Path("packed/README.md").read_text()
    assert "40 demonstrations of astar4, seed 0" in card
    assert "6 steps of 8 trajectories, muon" in card
    assert Path("packed/training.png").is_file()
    code, text = command(f"release {RUN} --out packed")
    assert (code, "packed already exists" in text) == (2, True)
    code, text = command("release nowhere")
    assert (code, "nowhere has no finished policy" in text) == (2, True)


def test_a_continuous_world_from_data_to_release(
    command: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Heads, standardized observations and noise, on single subtasks of a short kitchen."""
    pytest.importorskip("mujoco")
    from envs.kitchen import demonstrators
    from envs.kitchen.env import Kitchen

    kitchen = envs.find("kitchen")

    def of_single_subtasks(env: Any) -> Any:
        sample = lambda key, index: env.task(index % 5)  # noqa: E731
        known = kitchen.demonstrators(env)["expert-reduced"]
        return {"expert-reduced": known._replace(sample_task=sample)}

    short = replace(
        kitchen,
        make=lambda: Kitchen("kitchen", horizon=120),
        demonstrators=of_single_subtasks,
    )
    monkeypatch.setattr(WORLDS, "find", {"kitchen": short}.__getitem__)
    monkeypatch.setattr(WORLDS, "known", lambda name, where, flag="": {"kitchen": short}[name])
    line = (
        "pretrain --env kitchen --preset smoke --episodes 24 --holdout 8 --embed-dim 8 "
        "--num-layers 1 --steps 4 --batch-size 8 --part-size 4 --bucket 60 --eval-tasks 2 "
        "--eval-every 2 --save-every 2"
    )
    code, text = command(f"{line} --out run")
    assert code == 0, text
    network = read_policy(Path("run/policy")).config
    dataset, manifest = load_dataset(Path("data/kitchen/expert-reduced-24-seed0"))
    assert manifest["settings"] == {"noise": demonstrators.NOISE}
    assert network.head == "binned"
    np.testing.assert_allclose(network.obs_mean, dataset.obs.mean(axis=0), atol=1e-3)
    assert manifest["failed_episodes"] == 0
    code, text = command(
        "adapt --env kitchen --policy run/policy --seeds 1 --episodes 4 --eval-every 2 "
        "--no-figures --out result"
    )
    assert code == 0, text
    summary = json.loads(Path("result/summary.json").read_text())
    assert (summary["num_tasks"], summary["failed_episodes"]) == (25, 0)
    code, text = command("evaluate result --obs-noise 0.05 --episodes 1 --json rows.json")
    assert code == 0, text
    (row,) = json.loads(Path("rows.json").read_text())["rows"]
    assert row["change"] == pytest.approx(row["return"] - row["adapted"])
    assert row["failed_episodes"] == 0
    assert command("release run --out packed") == (0, "released in packed\n")
    assert (
        "share of actions within 0.1 in every dimension: " in Path("packed/README.md").read_text()
    )

    path = Path("data/kitchen/expert-reduced-24-seed0/manifest.json")
    path.write_text(json.dumps({**manifest, "settings": {"noise": 0.5}}))
    code, text = command(f"{line} --out other")
    assert code == 1
    assert "was collected by the demonstrator with {'noise': 0.5}" in text
    assert not Path("other").exists()


def test_work_that_was_not_done_before_says_that_it_compiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Other programs in the cache do not matter, nor does work that was interrupted while it compiled."""
    cache = tmp_path / "cache"
    monkeypatch.setenv("MGPO_CACHE", str(cache))
    work = runtime.Compiling("ucb in tiny", {"env": "tiny", "sizes": [1, 2]})
    work.done()  # without a folder nothing is remembered
    for others in (False, True):
        if others:
            cache.mkdir()
            (cache / "program").touch()
        work.announce()
        assert "ucb in tiny: compiling first" in capsys.readouterr().err
    work.done()
    runtime.Compiling("the same again", dict(work.deciding)).announce()
    assert capsys.readouterr().err == ""
    for changes in ({"env": "other"}, {"sizes": [2, 1]}):
        runtime.Compiling("bpe", {**work.deciding, **changes}).announce()
        assert "bpe: compiling first" in capsys.readouterr().err
    monkeypatch.setenv("XLA_FLAGS", "--another")
    work.announce()
    assert "compiling first" in capsys.readouterr().err


def test_a_command_announces_once_what_it_compiles(
    command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cache").mkdir()
    monkeypatch.setenv("MGPO_CACHE", str(tmp_path / "cache"))
    for number, announced in ((1, True), (2, False)):
        code, text = command(f"collect --trajectories 8 --out own{number}")
        assert code == 0, text
        assert ("demonstrations of astar4 in maze15: compiling first" in text) == announced


@pytest.mark.parametrize("fails", [False, True])
def test_an_adaptation_counts_as_compiled_once_it_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], fails: bool
) -> None:
    def searched(*args: Any, begin: Callable[[], object], **options: Any) -> list[Any]:
        begin()
        if fails:
            raise KeyboardInterrupt
        return []

    (tmp_path / "cache").mkdir()
    monkeypatch.setenv("MGPO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(adaptation, "sweep", searched)
    world, env = envs.find("maze15"), envs.make("maze15")
    policy = load_policy(world)
    told = []
    for seeds in (1, 1, 2):
        configs = [AdaptConfig(seeds=seeds)]
        with pytest.raises(KeyboardInterrupt) if fails else nullcontext():
            adaptation.adapt_all(world, env, policy, released_tasks(world), configs)
        told.append("ucb in maze15: compiling first" in capsys.readouterr().err)
    assert told == [True, fails, True]


@pytest.mark.parametrize(
    ("policy", "name", "flag"),
    [
        ("a", "a" * 300, "--out: "),
        ("a", "a" * 300 + ".partial", "--out: "),
        (".", "a" * 300, "--out: "),
        ("a", "a" * 300 + "/deep", "--out: "),
        ("b" * 300, "b" * 300 + "/config.json", "--policy: "),
        ("a", "ab", ""),
    ],
)
def test_a_name_that_is_too_long_is_of_the_right_flag(policy: str, name: str, flag: str) -> None:
    config = AdaptConfig(policy=Path(policy), out=Path("a" * 300))
    error = OSError(errno.ENAMETOOLONG, "File name too long", name)
    assert runtime.explained(error, config).startswith(f"{flag}the name '{name[:2]}")
