"""``--distributed`` with real processes on this machine: results, signals, crashes, disagreements.

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
import jax.numpy as jnp
import numpy as np
import pytest
from own_world import WORLD
from test_own_training import make_data

from mgpo_jax import save_dataset
from mgpo_jax.checkpoint import checkpoints, restore_state
from mgpo_jax.encoders import LINEAR  # noqa: F401 (its module is needed before a network is made)
from mgpo_jax.losses import initial_params
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy_files import save_policy
from mgpo_jax.settings import RECIPE_NETWORK
from mgpo_jax.training import TrainState

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


def scripts(script: str, count: int, *words: str, devices: int = 1) -> list[subprocess.Popen[str]]:
    """Processes that run a script with the place where they meet, their number, and other words."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        place = f"127.0.0.1:{free.getsockname()[1]}"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": xla_flags(devices)}
    return [
        subprocess.Popen(
            [sys.executable, "-c", script, place, str(number), *words],
            cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for number in range(count)
    ]  # fmt: skip


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


THREE = """
import sys
from pathlib import Path
import jax, jax.numpy as jnp
from jax.experimental import multihost_utils
from experiments import joining
from mgpo_jax import processes
from mgpo_jax.checkpoint import Snapshot, checkpoints, save_state
from mgpo_jax.sharding import fetch, mesh_of_all, split
from mgpo_jax.training import TrainState

index, place = int(sys.argv[2]), Path(sys.argv[3])
flags = {"coordinator": sys.argv[1], "processes": 3, "process": index}
joining.join(joining.Joined(distributed=True, **flags))
multihost_utils.sync_global_devices = None  # a collective over all devices of all processes

def save(folder, steps):
    with checkpoints(folder) as manager:
        for step in steps:
            state = TrainState({"a": jnp.full(5, step, jnp.float32)}, (), step)
            save_state(manager, Snapshot(state, [{"step": step, "from": index}], []))

save(place / ("none" if index == 2 else "shared"), (3, 6, 9))
with processes.apart():
    save(place / f"own{index}", (1,))
assert processes.from_first(lambda: index) == 0
assert processes.total(index) == 3
assert fetch(split(mesh_of_all(), jnp.arange(12))).tolist() == list(range(12))
processes.team().leave(wait=True)
"""


def test_three_processes_save_together(tmp_path: Path) -> None:
    """Each has two devices, and one sees another folder; any number of processes can go on."""
    started = scripts(THREE, 3, str(tmp_path), devices=2)
    for process in started:
        out, err = process.communicate(timeout=LIMIT)
        assert (process.returncode, out) == (0, ""), err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["own0", "own1", "own2", "shared"]
    blank = TrainState({"a": jnp.zeros(5)}, (), 0)
    with checkpoints(tmp_path / "shared") as manager:
        found = restore_state(manager, blank)
        assert sorted(manager.all_steps()) == [6, 9]
    assert found is not None
    assert found.state.params["a"].tolist() == [9] * 5
    assert (found.state.step, found.measured) == (9, [{"step": 9, "from": 0}])


RAISING = """
import socket, sys, time
from envs.errors import DataError
from experiments import joining, runtime
from mgpo_jax import doors

place, number, raising = sys.argv.pop(1), int(sys.argv.pop(1)), int(sys.argv.pop(1))
ports = []

class Door(doors.Door):
    def __init__(self, *args):
        super().__init__(*args)
        ports.append(self.port)

doors.Door = Door

def main(config):
    joining.join(joining.Joined(distributed=True, coordinator=place, processes=2, process=number))
    for port in ports:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=5)
        except ConnectionRefusedError:
            print("closed", flush=True)
    if number == raising:
        raise DataError("no room is left; make some")
    time.sleep(60)

runtime.run(joining.Joined, main)
"""


@pytest.mark.parametrize("raising", [0, 1])
def test_a_process_that_fails_ends_the_other(raising: int) -> None:
    """Both say why, each in one line; and nobody can connect to process 0 any more."""
    since = time.monotonic()
    started = scripts(RAISING, 2, str(raising))
    said = [process.communicate(timeout=LIMIT) for process in started]
    assert time.monotonic() - since < 50
    assert [process.returncode for process in started] == [1, 1], said
    assert [out for out, _ in said] == ["closed\n", ""]
    own = "error: no room is left; make some"
    news = f"error: process {raising} on {socket.gethostname()} failed: no room is left; make some"
    wanted = [own if number == raising else news for number in (0, 1)]
    assert [err.splitlines()[-1] for _, err in said] == wanted


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


@pytest.fixture(scope="module")
def adapted(place: Path) -> Path:
    """An adaptation of one process with two devices."""
    alone(f"{ADAPT} --out one", place, devices=2)
    return place / "one"


@pytest.mark.slow
def test_an_evaluation_has_the_bits_of_one_process(place: Path, adapted: Path) -> None:
    words = "evaluate one --env own_world:WORLD --episodes 2 --action-noise 0 0.2"
    (code, out, err), second = both(f"{words} --json both.json", place)
    assert code == 0, err
    assert "0.2" in out
    assert second == (0, "", "")
    alone(f"{words} --json alone.json", place, devices=2)
    rows = [json.loads((place / name).read_text())["rows"] for name in ("both.json", "alone.json")]
    assert len(rows[0]) == 2
    assert rows[0] == rows[1]


REPRODUCING = """
import sys
from experiments import comparisons, reproduce

comparisons.SMOKE_TASKS = comparisons.SMOKE_EPISODES = 2
adapt_and_save = comparisons.adapt_and_save

def adapt(folder, *args):
    print("makes", folder.name, file=sys.__stderr__)
    adapt_and_save(folder, *args)

comparisons.adapt_and_save = adapt
place, number = sys.argv[1:3]
reproduce.command([
    "table1", "--env", "maze15", "--scale", "smoke", "--only", "gcbc", "ucb", "--out", sys.argv[3],
    "--distributed", "--coordinator", place, "--processes", "2", "--process", number,
])
"""


@pytest.mark.slow
def test_a_table_is_made_by_two_processes(tmp_path: Path, place: Path) -> None:
    """Each adapts with one of the methods, and process 0 prints the table."""
    started = scripts(REPRODUCING, 2, str(tmp_path))
    (out, first), (nothing, second) = [process.communicate(timeout=300) for process in started]
    assert [process.returncode for process in started] == [0, 0], first + second
    assert [line for line in first.splitlines() if line.startswith("makes")] == [
        "makes gcbc-smoke-1seeds"
    ]
    assert (nothing, second) == ("", "makes ucb-smoke-1seeds\n")
    rows = [line.split("|")[2].strip() for line in out.splitlines() if line.startswith("| maze15")]
    assert rows == ["GC-BC", "MGPO-UCB"]


def test_an_adaptation_has_the_bits_of_one_process(place: Path, adapted: Path) -> None:
    """Even if only process 0 wants to divide segments into parts of one round."""
    words = ADAPT.replace("own_world", "short_parts")
    (code, out, err), second = both(f"{words} --out two", place)
    assert code == 0, err
    assert "explore" in out
    assert second == (0, "", "")
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
