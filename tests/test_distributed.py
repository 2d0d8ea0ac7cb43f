"""``--distributed`` with two real processes on this machine: results, signals, crashes, disagreements.

Networks and data are tiny; nearly all of the time goes into starting and compiling.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import jax
import numpy as np
import pytest
from own_world import WORLD
from test_own_training import make_data

from mgpo_jax import save_dataset
from mgpo_jax.encoders import LINEAR  # noqa: F401 (its module is needed before a network is made)
from mgpo_jax.losses import initial_params
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy_files import save_policy
from mgpo_jax.settings import RECIPE_NETWORK

ROOT = Path(__file__).parents[1]
LIMIT = 120  # seconds, after which a process is killed
TRAIN = (
    "pretrain --data mine --embed-dim 8 --num-layers 1 --num-heads 2 --max-prompt-length 2 --batch-size 8 "
    "--part-size 4 --bucket 12 --warmup-steps 1 --eval-every 20 --save-every 1000 --optimizer adamw "
    "--holdout 4 --steps 100"
)
ADAPT = (
    "adapt --env own_world:WORLD --policy policy --method explore --seeds 2 --episodes 6 --eval-every 3 "
    "--no-figures"
)
COLLECT = "collect --env own_world:WORLD --trajectories 300"


def xla_flags(devices: int) -> str:
    """So many devices, and programs that are compiled fast rather than well."""
    return f"--xla_force_host_platform_device_count={devices} --xla_backend_optimization_level=0"


class Pair:
    """Two processes of one command."""

    def __init__(self, words: str, folders: Sequence[Path]) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        self.port = port
        ways = os.pathsep.join([str(ROOT), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")])
        environment = {
            **os.environ,
            "PYTHONPATH": ways,
            "JAX_PLATFORMS": "cpu",
            "XLA_FLAGS": xla_flags(1),
        }
        command, *flags = words.split()
        self.running = [
            subprocess.Popen(
                [
                    sys.executable, "-m", f"experiments.{command}", *flags, "--distributed",
                    "--coordinator", f"127.0.0.1:{port}", "--processes", "2", "--process", str(number),
                ],
                cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            )
            for number, folder in enumerate(folders)
        ]  # fmt: skip

    def ended(self) -> list[tuple[int, str, str]]:
        """Exit codes, stdout and stderr of both; whoever takes too long is killed."""
        end, found = time.monotonic() + LIMIT, []
        for process in self.running:
            try:
                out, err = process.communicate(timeout=max(end - time.monotonic(), 1))
            except subprocess.TimeoutExpired:
                self.kill()
                out, err = process.communicate()
            found.append((process.returncode, out, err))
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.1", self.port), timeout=5)
        return found

    def kill(self) -> None:
        for process in self.running:
            with suppress(OSError):
                process.kill()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with a dataset and a policy, and programs that are compiled once for all tests here."""
    root = tmp_path_factory.mktemp("distributed")
    spec = {"name": "arm", "horizon": 12, "truncate_in_hindsight": False}
    save_dataset(root / "mine", make_data(40), {"spec": spec}, mapped=True)
    sizes = {
        **RECIPE_NETWORK,
        "embed_dim": 8,
        "num_layers": 1,
        "num_heads": 1,
        "max_prompt_length": 3,
    }
    network = network_config(WORLD.make().spec, **sizes)
    save_policy(root / "policy", network, initial_params(jax.random.key(1), network), {})
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MGPO_CACHE", str(root / "cache"))
        patch.setenv("MGPO_DATA", str(root / "data"))
        yield root


ALONE = """
import sys
from experiments import joining
joining.ARRIVING = 1
flags = {"coordinator": sys.argv[1], "processes": 2, "process": int(sys.argv[2])}
joining.join(joining.Joined(distributed=True, **flags))
"""


def test_a_process_whose_others_never_come_says_so() -> None:
    """Whichever of the processes is the only one that was started."""
    started, places = [], []
    for number in ("0", "1"):
        with socket.create_server(("127.0.0.1", 0)) as free:
            places.append(f"127.0.0.1:{free.getsockname()[1]}")
        started.append(
            subprocess.Popen(
                [sys.executable, "-c", ALONE, places[-1], number],
                cwd=ROOT, env={**os.environ, "JAX_PLATFORMS": "cpu"},
                stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            )
        )  # fmt: skip
    for process, where in zip(started, places, strict=True):
        out, err = process.communicate(timeout=LIMIT)
        assert (process.returncode, out) == (1, "")
        assert err == (
            f"error: not all processes have met at {where} within 1 s; start all of them with the same "
            "--coordinator and --processes, and a --process each\n"
        )


def both(words: str, place: Path) -> list[tuple[int, str, str]]:
    pair = Pair(words, [place, place])
    try:
        return pair.ended()
    finally:
        pair.kill()


def alone(words: str, place: Path, devices: int) -> None:
    """The same command in one process."""
    ways = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    command, *flags = words.split()
    subprocess.run(
        [sys.executable, "-m", f"experiments.{command}", *flags],
        cwd=place, check=True, timeout=LIMIT, capture_output=True,
        env={
            **os.environ, "PYTHONPATH": ways, "JAX_PLATFORMS": "cpu",
            "XLA_FLAGS": xla_flags(devices),
        },
    )  # fmt: skip


def weights(folder: Path) -> np.ndarray:
    with np.load(folder / "policy" / "weights.npz") as file:
        return np.concatenate([file[name].ravel() for name in sorted(file)])


def assert_near(found: np.ndarray, wanted: np.ndarray) -> None:
    """Nearly the same weights, but for those that do not matter.

    The biases of keys have no gradient but rounding errors, which AdamW makes as large as any other.
    """
    far = np.abs(found - wanted) > 1e-4
    assert far.mean() < 0.01, np.flatnonzero(far)


def when(condition: Callable[[], bool], pair: Pair) -> None:
    end = time.monotonic() + LIMIT
    while not condition() and time.monotonic() < end:
        assert all(process.poll() is None for process in pair.running), pair.ended()
        time.sleep(0.02)


def measured(folder: Path) -> bool:
    path = folder / "metrics.jsonl"
    return path.is_file() and b"\n" in path.read_bytes()


@pytest.fixture(scope="module")
def trained(place: Path) -> Path:
    """A training of two processes from the first step to the last."""
    (code, out, err), second = both(f"{TRAIN} --out whole", place)
    assert (code, out) == (0, ""), err
    assert "2 processes, 2 devices" in err
    assert second == (0, "", "")  # only process 0 says anything
    return place / "whole"


def test_a_training_is_like_that_of_one_process(place: Path, trained: Path) -> None:
    alone(f"{TRAIN} --out alone", place, devices=2)
    assert_near(weights(trained), weights(place / "alone"))
    rows = [
        [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
        for folder in (trained, place / "alone")
    ]
    assert [row["step"] for row in rows[0]] == [row["step"] for row in rows[1]]
    assert rows[0][-1]["val/loss"] == pytest.approx(rows[1][-1]["val/loss"], abs=1e-4)
    assert rows[0][-1]["train/num_steps"] == rows[1][-1]["train/num_steps"]


def test_a_signal_to_one_stops_both_at_the_same_step(place: Path, trained: Path) -> None:
    """And the run goes on, with two processes to the same bits and with one to nearly the same."""
    pair = Pair(f"{TRAIN} --out stopped", [place, place])
    try:
        when(lambda: measured(place / "stopped"), pair)
        pair.running[1].send_signal(signal.SIGTERM)
        (first, _, err), (second, _, nothing) = pair.ended()
    finally:
        pair.kill()
    assert (first, second, nothing) == (128 + signal.SIGTERM,) * 2 + ("",), err
    step = int(err.rpartition("stopped at step ")[2].split()[0])
    saved = [path.name for path in (place / "stopped/checkpoints").iterdir()]
    assert saved == [str(step)]
    assert 20 <= step < 100
    shutil.copytree(place / "stopped", place / "other")
    (code, _, err), _ = both(f"{TRAIN} --out stopped --resume", place)
    assert code == 0, err
    assert f"resuming stopped at step {step}" in err
    np.testing.assert_array_equal(weights(place / "stopped"), weights(trained))
    alone(f"{TRAIN} --out other --resume", place, devices=1)
    assert_near(weights(place / "other"), weights(trained))


def test_a_process_that_is_killed_ends_the_other(place: Path, trained: Path) -> None:
    pair = Pair(f"{TRAIN} --out killed", [place, place])
    try:
        when(lambda: measured(place / "killed"), pair)
        pair.running[1].kill()
        since = time.monotonic()
        (code, _, err), _ = pair.ended()
    finally:
        pair.kill()
    assert time.monotonic() - since < 60
    assert code == 1
    line = err.splitlines()[-1]
    number = pair.running[1].pid
    host = socket.gethostname()
    assert (
        line
        == f"error: process 1 on {host} (pid {number}) has ended unexpectedly; continue with --resume"
    )


def test_processes_with_other_data_do_not_begin(place: Path, trained: Path, tmp_path: Path) -> None:
    spec = {"name": "arm", "horizon": 12, "truncate_in_hindsight": False}
    save_dataset(tmp_path / "mine", make_data(40, seed=1), {"spec": spec}, mapped=True)
    pair = Pair(f"{TRAIN} --out {place}/never", [place, tmp_path])
    try:
        (first, _, err), (second, _, nothing) = pair.ended()
    finally:
        pair.kill()
    assert (first, second, nothing) == (1, 1, "")
    line = err.splitlines()[-1]
    assert line.startswith(f"error: process 1 on {socket.gethostname()} has the dataset's hash '")
    assert not (place / "never").exists()


def test_an_adaptation_has_the_bits_of_one_process(place: Path) -> None:
    """Even if only process 0 wants to divide segments into parts of one round."""
    words = ADAPT.replace("own_world", "short_parts")
    (code, out, err), second = both(f"{words} --out two", place)
    assert code == 0, err
    assert "explore" in out
    assert second == (0, "", "")
    alone(f"{ADAPT} --out one", place, devices=2)
    for name in ("results.npz", "tasks.npz"):
        with np.load(place / "one" / name) as one, np.load(place / "two" / name) as two:
            assert sorted(one) == sorted(two)
            for part in one:
                np.testing.assert_array_equal(one[part], two[part], err_msg=part)
    summaries = [json.loads((place / n / "summary.json").read_text()) for n in ("one", "two")]
    for summary in summaries:
        assert summary.pop("cpu_seconds") > 0
        summary.pop("episodes_per_cpu_second", None)
        summary.pop("env")  # the same world under two names
    assert summaries[0] == summaries[1]


def test_a_dataset_does_not_depend_on_the_number_of_processes(place: Path) -> None:
    (code, _, err), second = both(f"{COLLECT} --out shared", place)
    assert code == 0, err
    assert second == (0, "", "")
    alone(f"{COLLECT} --out own", place, devices=1)
    one, two = (json.loads((place / n / "manifest.json").read_text()) for n in ("own", "shared"))
    assert one == two  # which holds the hash
