"""Messages between processes on the host, and that no collective joins CPU devices of one process."""

from __future__ import annotations

import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax._src import distributed
from test_runner import Point, tasks_of, untrained
from test_training import CONFIG, DATASET, NETWORK, WHOLE, parts_of

from envs.errors import UsageError
from experiments import cards, joining, signals, training
from experiments.demonstrations import _as_one
from experiments.joining import Joined, check_flags
from mgpo_jax import doors, lanes, processes, programs, segments, sharding
from mgpo_jax.checkpoint import Snapshot
from mgpo_jax.doors import Door, connected
from mgpo_jax.methods import UCB
from mgpo_jax.processes import DisagreementError, Member, Team
from mgpo_jax.runner import sweep
from mgpo_jax.training import ASKED, Trainer, TrainState

COLLECTIVE = re.compile(r"all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter")


@contextmanager
def teams(num: int) -> Iterator[tuple[list[Team], list[list[tuple[str, int, str]]]]]:
    """Processes that are threads of this one, and what each of them hears."""
    members = [Member(number, f"host{number}", 100 + number) for number in range(num)]
    heard: list[list[tuple[str, int, str]]] = [[] for _ in range(num)]

    def hear(index: int) -> Callable[[str, Member, str], None]:
        return lambda event, member, text: heard[index].append((event, member.number, text))

    door = Door(only_here=True)
    links: list[dict[int, socket.socket]] = [{}]
    for number in range(1, num):
        links.append({0: connected(["127.0.0.1"], door.port, door.password, number)})
    links[0] = door.let_in(members)
    made = [Team(members, number, links[number], hear(number)) for number in range(num)]
    try:
        yield made, heard
    finally:
        for team in made:
            team.leave(wait=False)


def at_once(*works: Callable[[], Any]) -> list[Any]:
    """The results of several threads."""
    found: list[Any] = [None] * len(works)

    def run(place: int) -> None:
        try:
            found[place] = works[place]()
        except Exception as error:
            found[place] = error

    threads = [threading.Thread(target=run, args=(place,)) for place in range(len(works))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    return found


def soon(condition: Callable[[], Any]) -> None:
    end = time.monotonic() + 5
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    assert condition()


def test_all_get_the_pieces_of_all_in_their_order() -> None:
    large = bytes(range(256)) * 9000
    with teams(3) as (made, _):
        pieces = [b"", large, b"two"]
        works = [lambda i=i: made[i].combine(pieces[i], processes._packed) for i in range(3)]
        assert [list(processes._unpacked(told)) for told in at_once(*works)] == [pieces] * 3
        works = [
            lambda i=i: made[i].combine(b"%d" % i, lambda all_: all_[2] + b"!") for i in range(3)
        ]
        assert at_once(*works) == [b"2!"] * 3


def test_news_reaches_all_others() -> None:
    with teams(3) as (made, heard):
        made[1].tell(processes.SIGNAL, "15")
        made[0].tell(processes.FAILED, "no room")
        soon(lambda: heard[0] and len(heard[1]) == 1 and len(heard[2]) == 2)
        assert heard[0] == [("signal", 1, "15")]
        assert heard[1] == [("failed", 0, "no room")]
        assert sorted(heard[2]) == [("failed", 0, "no room"), ("signal", 1, "15")]


def test_a_process_that_is_gone_is_missed_by_all_others() -> None:
    with teams(3) as (made, heard):
        made[2].leave(wait=False)  # as the operating system does for a process that ends
        soon(lambda: heard[0] and heard[1])
        assert heard[0] == heard[1] == [("gone", 2, "")]
        assert heard[2] == []


def test_process_0_ends_after_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """jax would abort those that have not printed yet why they end."""
    ended: list[str] = []
    monkeypatch.setattr(joining, "clean_up", lambda: None)
    monkeypatch.setattr(joining, "_ending", threading.Event())
    monkeypatch.setattr(joining.os, "_exit", lambda code: ended.append("process 0"))

    monkeypatch.setattr(joining, "_first", threading.Lock())
    monkeypatch.setattr(joining, "_failed", threading.Event())
    monkeypatch.setattr(joining, "_faults", {})

    def hear(event: str, member: Member, text: str) -> None:
        joining._react(event, member, text, "")  # in the thread that receives from that process

    with teams(3) as (made, _):
        monkeypatch.setattr(made[0], "_heard", hear)
        monkeypatch.setattr(processes._present, "team", made[0])
        made[1].leave(wait=False)
        time.sleep(0.3)
        ended.append("process 2")
        made[2].leave(wait=False)
        soon(lambda: len(ended) > 1)
        monkeypatch.setattr(processes._present, "team", None)
    assert ended == ["process 2", "process 0"]
    assert joining._ending.is_set()


@pytest.mark.parametrize("fails", [False, True])
def test_process_0_names_the_process_that_was_first(
    fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others end because of it, and are not blamed for that."""
    printed: list[str] = []
    done = threading.Event()
    for name, value in (
        ("clean_up", lambda: None),
        ("_print", printed.append),
        ("_ending", threading.Event()),
        ("_first", threading.Lock()),
        ("_failed", threading.Event()),
        ("_faults", {}),
        ("SAME", 0.2),
    ):
        monkeypatch.setattr(joining, name, value)
    monkeypatch.setattr(joining.os, "_exit", lambda code: done.set())
    with teams(3) as (made, _):
        monkeypatch.setattr(made[0], "_heard", lambda *told: joining._react(*told, "resume"))
        monkeypatch.setattr(processes._present, "team", made[0])
        if fails:
            made[1].tell(processes.FAILED, "no room is left")
        made[1].leave(wait=False)
        time.sleep(0.05)
        made[2].leave(wait=False)
        assert done.wait(10)
        time.sleep(0.3)
        monkeypatch.setattr(processes._present, "team", None)
    (line,) = printed
    assert "process 1" in line
    assert ("failed: no room is left" in line) == fails


def test_who_has_come_to_the_end_is_not_missed() -> None:
    with teams(3) as (made, heard):
        at_once(*[lambda i=i: made[i].leave(wait=True) for i in range(3)])
        time.sleep(0.05)
        assert heard == [[], [], []]


def test_strangers_are_not_let_in() -> None:
    door = Door(only_here=True)
    members = [Member(0, "here", 1), Member(1, "there", 2)]
    stranger = connected(["127.0.0.1"], door.port, bytes(16), 1)
    own = connected(["127.0.0.1"], door.port, door.password, 1)
    links = door.let_in(members)
    links[1].sendall(b"x")
    assert own.recv(1) == b"x"
    assert stranger.recv(1) == b""
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", door.port), timeout=5)
    for link in (stranger, own, links[1]):
        link.close()


def test_a_stranger_that_says_nothing_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The others are let in all the same."""
    monkeypatch.setattr(doors, "GREETING", 0.1)
    door = Door(only_here=True)
    silent = socket.create_connection(("127.0.0.1", door.port))
    own = connected(["127.0.0.1"], door.port, door.password, 1)
    links = door.let_in([Member(0, "here", 1), Member(1, "there", 2)])
    assert list(links) == [1]
    silent.settimeout(5)
    assert silent.recv(1) == b""
    for link in (silent, own, links[1]):
        link.close()


def has_ipv6() -> bool:
    """Whether a process may connect to this host by an address of IPv6."""
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return socket.has_dualstack_ipv6()


@pytest.mark.skipif(not has_ipv6(), reason="needs IPv6")
def test_the_door_is_open_to_both_kinds_of_addresses() -> None:
    door = Door(only_here=False)
    own = [connected(["127.0.0.1"], door.port, door.password, 1)]
    own.append(connected(["::1"], door.port, door.password, 2))
    links = door.let_in([Member(number, "here", number) for number in range(3)])
    assert sorted(links) == [1, 2]
    for link in (*own, *links.values()):
        link.close()


def test_process_0_is_looked_for_where_jax_has_found_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own name for its host may be unknown elsewhere."""
    state = distributed.global_state
    for address, host in (("node0:123", ["node0"]), ("[fe80::1]:123", ["fe80::1"]), (None, [])):
        monkeypatch.setattr(state, "coordinator_address", address)
        assert joining._host_of_first() == host


def test_what_differs_is_named_with_its_host(monkeypatch: pytest.MonkeyPatch) -> None:
    own = threading.local()
    monkeypatch.setattr(processes, "_together", lambda: own.team)
    with teams(2) as (made, _):

        def check(index: int, value: str) -> None:
            own.team = made[index]
            processes.check_agreed({"--seed": 0, "the dataset's hash": value})

        first, second = at_once(lambda: check(0, "ab"), lambda: check(1, "cd"))
    assert isinstance(first, DisagreementError)
    assert str(first) == str(second)
    said = "process 1 on host1 has the dataset's hash 'cd', not 'ab' as process 0 on host0 has"
    assert str(first).startswith(said)


def test_nobody_ends_a_training_before_it_is_saved(monkeypatch: pytest.MonkeyPatch) -> None:
    """A signal ends a process that has left the steps at once, and jax then aborts the one that saves."""
    own = threading.local()
    monkeypatch.setattr(processes, "_together", lambda: own.team)
    monkeypatch.setattr(training, "_check_same_weights", lambda state: None)
    order: list[str] = []

    def save(*args: Any) -> None:
        if own.team.index == 0:
            time.sleep(0.3)
            order.append("saved")

    monkeypatch.setattr(training, "save_state", save)
    row = {"loss": np.float32(0.5), ASKED: np.float32(0)}
    config = SimpleNamespace(train=SimpleNamespace(steps=1), save_every=9, eval_every=9)
    run: Any = SimpleNamespace(
        config=config,
        identity="",
        batches=lambda first: iter([[]]),
        trainer=SimpleNamespace(step=lambda state, *_: (state._replace(step=1), row)),
        measure=lambda state: {"val/loss": 0.5},
    )
    metrics: Any = SimpleNamespace(rows=[], write=lambda *_: None)
    before = Snapshot(TrainState({}, (), 0), [], [])
    with teams(2) as (made, _):

        def take(index: int) -> None:
            own.team = made[index]
            training._take_steps(run, before, None if index else metrics, None, lambda: 0, "")
            order.append(f"process {index} ends")

        assert at_once(lambda: take(0), lambda: take(1)) == [None, None]
    assert order[0] == "saved"
    assert len(order) == 3


def test_one_process_needs_nobody() -> None:
    assert (processes.count(), processes.index(), processes.is_first()) == (1, 0, True)
    assert processes.total(2.5) == 2.5
    assert processes.from_first(lambda: {"a": 1}) == {"a": 1}
    assert processes.arrays_from_first(lambda: None) is None
    processes.check_agreed({"anything": 1})


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        ({"processes": 2}, "--processes 2 only works with --distributed; add --distributed"),
        ({"distributed": True, "coordinator": "a:1"}, "--coordinator needs --processes beside it"),
        (
            {"distributed": True, "coordinator": "a", "processes": 2, "process": 0},
            "--coordinator must be HOST:PORT, such as node0:12345, found 'a'",
        ),
        (
            {"distributed": True, "coordinator": "a:1", "processes": 2, "process": 2},
            "--process must be from 0 to 1, since there are 2 processes, found 2",
        ),
    ],
)
def test_flags_that_do_not_go_together(flags: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=re.escape(says)):
        check_flags(Joined(**flags))


def test_requests_of_a_scheduler_to_all_are_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A request to this process and the news of the same to another are no second request."""
    watch = signals._Watch()
    monkeypatch.setattr(signals, "_watch", watch)
    watch.patient = True
    watch.receive(15)
    signals.receive(15, 1)
    signals.receive(15, 2)
    assert (watch.leaving, len(watch.asked)) == (False, 3)
    left = threading.Event()
    monkeypatch.setattr(watch, "_leave", lambda number: left.set())
    signals.receive(15, 2)
    assert left.wait(5)
    assert signals.is_leaving()


def test_a_batch_is_put_together_from_its_parts() -> None:
    """Three kept of four, 2 + 1 + 3 steps; the numbers of those to try again stay in order."""
    first = {
        "obs": np.arange(3), "lengths": np.array([2, 1]), "returns": np.array([0.5, 1.0]),
        "again": np.array([7]), "num_failed": np.array(1), "num_test": np.array(0),
    }  # fmt: skip
    second = {
        "obs": np.arange(10, 15), "lengths": np.array([3, 2]), "returns": np.array([0.25, 0.0]),
        "again": np.array([8, 9]), "num_failed": np.array(0), "num_test": np.array(2),
    }  # fmt: skip
    whole = _as_one([first, second], room=3)
    np.testing.assert_array_equal(whole["obs"], [0, 1, 2, 10, 11, 12])
    np.testing.assert_array_equal(whole["lengths"], [2, 1, 3])
    np.testing.assert_array_equal(whole["returns"], [0.5, 1.0, 0.25])
    np.testing.assert_array_equal(whole["again"], [7, 8, 9])
    assert (whole["num_failed"], whole["num_test"]) == (1, 2)


@pytest.mark.skipif(jax.device_count() < 2, reason="needs two devices")
def test_no_collective_joins_devices_of_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is compiled for two CPU devices, in a gradient step and in an adaptation."""
    compiled = []

    def on_devices(*args: Any, **options: Any) -> Any:
        program = sharding.on_devices(*args, **options)

        def run(*inputs: Any) -> Any:
            compiled.append(program.lower(*inputs).compile().as_text())
            return program(*inputs)

        run.lower = lambda *inputs: _Noted(program.lower(*inputs), compiled)
        return run

    monkeypatch.setattr("mgpo_jax.training.on_devices", on_devices)
    for module in (lanes, segments):
        monkeypatch.setattr(module, "on_devices", on_devices)
    trainer = Trainer(CONFIG, NETWORK, DATASET, sharding.device_mesh(2))
    trainer.step(trainer.init(), parts_of(4))
    assert len(compiled) == 4  # to unpack, to add for each of two parts, to pack
    for function in (programs.programs_of, segments._breaking):
        function.cache_clear()
    env = Point()
    sweep(env, untrained(env), tasks_of(env), UCB, [UCB.hyper()], seeds=1, episodes=2, eval_every=2)
    for function in (programs.programs_of, segments._breaking):
        function.cache_clear()
    assert len(compiled) > 6
    assert [text for text in compiled if COLLECTIVE.search(text)] == []


class _Noted:
    """A lowered program whose text is noted when it is compiled."""

    def __init__(self, lowered: Any, texts: list[str]) -> None:
        self._lowered, self._texts = lowered, texts

    def compile(self) -> Any:
        done = self._lowered.compile()
        self._texts.append(done.as_text())
        return done


@pytest.mark.skipif(jax.device_count() < 2, reason="needs two devices")
def test_a_collective_between_them_is_refused() -> None:
    mesh = sharding.device_mesh(2)
    with pytest.raises(AssertionError):
        sharding.sum_by_collective(mesh, mesh, jnp.ones((2, 3)))
    sharding.check_collective(sharding.device_mesh(1))


def test_sums_of_accelerators_are_those_of_copies() -> None:
    """The form of accelerators, on the one device where a CPU may have it."""
    mesh = sharding.device_mesh(1)
    tree = {"a": jnp.arange(6.0).reshape(1, 2, 3), "b": jnp.full((1,), 7.0)}
    (row,) = sharding._splitting(tree)(sharding.sum_by_collective(mesh, mesh, tree)[None])
    (copied,) = sharding.gather_rows(mesh, tree)
    jax.tree.map(np.testing.assert_array_equal, row, copied)
    np.testing.assert_array_equal(WHOLE.indices, np.arange(8))


@dataclass(frozen=True)
class Chip:
    """A device of a process."""

    process_index: int
    id: int


def test_devices_are_in_the_order_of_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a slice of TPUs ``jax.devices()`` alternates between them."""
    placed = [Chip(0, 0), Chip(0, 1), Chip(1, 4), Chip(1, 5), Chip(0, 2), Chip(0, 3), Chip(1, 6)]
    monkeypatch.setattr(jax, "devices", lambda: placed)
    monkeypatch.setattr(jax, "local_devices", lambda: [Chip(0, 2), Chip(0, 0)])
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(processes, "count", lambda: 2)
    assert [chip.id for chip in sharding.mesh_of_all().devices.flat] == [0, 1, 2, 3, 4, 5, 6]
    heads = sharding._heads.__wrapped__()
    own = sharding.device_mesh(1)
    assert list(own.devices) == [Chip(0, 0)]
    assert (
        list(heads.devices) == list(sharding._with_others(own).devices) == [Chip(0, 0), Chip(1, 4)]
    )


@pytest.mark.parametrize(
    ("variables", "own"),
    [
        ({"CUDA_VISIBLE_DEVICES": "0,1,2,3", "SLURM_STEP_TASKS_PER_NODE": "1(x2)"}, [0, 1, 2, 3]),
        ({"CUDA_VISIBLE_DEVICES": "0,1,2,3", "SLURM_STEP_TASKS_PER_NODE": "4(x2)"}, None),
        ({"CUDA_VISIBLE_DEVICES": "2", "SLURM_STEP_TASKS_PER_NODE": "4(x2)"}, [0]),
        ({"CUDA_VISIBLE_DEVICES": "0,1", "SLURM_STEP_TASKS_PER_NODE": "4(x2)"}, [0, 1]),
        ({"SLURM_STEP_TASKS_PER_NODE": "2,1(x2)", "SLURM_NODEID": "1"}, []),
        ({"SLURM_STEP_TASKS_PER_NODE": "2,1(x2)", "SLURM_NODEID": "0"}, None),
        ({"CUDA_VISIBLE_DEVICES": "4,5", "OMPI_COMM_WORLD_LOCAL_SIZE": "1"}, [0, 1]),
        ({"CUDA_VISIBLE_DEVICES": "4,5", "OMPI_COMM_WORLD_LOCAL_SIZE": "2"}, None),
        ({"JAX_LOCAL_DEVICE_IDS": "1", "OMPI_COMM_WORLD_LOCAL_SIZE": "1"}, None),
        ({}, None),
    ],
)
def test_the_gpus_of_a_process(variables: dict[str, str], own: list[int] | None) -> None:
    assert cards.own_cards(variables) == own


@pytest.mark.parametrize(
    ("has", "platforms", "before", "after"),
    [
        (False, "", "--a=1", "--a=1"),
        (True, "cpu", "--a=1", "--a=1"),
        (True, "", "", "--xla_gpu_shard_autotuning=false --xla_gpu_autotune_level=0"),
        (
            True, "cuda,cpu", "--xla_gpu_autotune_level=2",
            "--xla_gpu_autotune_level=2 --xla_gpu_shard_autotuning=false",
        ),
    ],
)  # fmt: skip
def test_gpus_run_the_same_programs(
    has: bool, platforms: str, before: str, after: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert cards.has_plugin() in (True, False)  # whatever is installed here
    monkeypatch.setattr(cards, "has_plugin", lambda: has)
    variables = {"JAX_PLATFORMS": platforms, "XLA_FLAGS": before}
    cards.choose_same_programs(variables)
    assert variables["XLA_FLAGS"] == after


def test_a_process_alone_on_its_host_drives_all_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    """jax would give it the GPU of its local rank alone."""
    given: dict[str, Any] = {}
    monkeypatch.setattr(cards, "has_plugin", lambda: True)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    monkeypatch.setenv("XLA_FLAGS", "--a=1")
    monkeypatch.setattr(jax.distributed, "initialize", lambda **options: given.update(options))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1,2,3")
    monkeypatch.setenv("SLURM_STEP_TASKS_PER_NODE", "1(x2)")
    service = jax.config.jax_enable_preemption_service
    try:
        joining._start(Joined(distributed=True))
    finally:
        jax.config.update("jax_enable_preemption_service", service)
    assert given["local_device_ids"] == [0, 1, 2, 3]
    assert os.environ["XLA_FLAGS"].startswith("--a=1 --xla_gpu_shard_autotuning=false")


def test_accelerators_are_connected_before_the_first_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their first collective needs all processes within a time limit."""
    mesh = sharding.device_mesh(1)
    summed: list[Any] = []

    def note(own: Any, whole: Any, tree: Any) -> Any:
        summed.append((own, whole, tree.shape))
        return tree

    monkeypatch.setattr(sharding, "sum_by_collective", note)
    monkeypatch.setattr(sharding, "_is_cpu", lambda mesh: False)
    sharding.Adding(mesh)
    assert summed == []
    monkeypatch.setattr(processes, "count", lambda: 2)
    monkeypatch.setattr(sharding, "_with_others", lambda mesh: mesh)
    sharding.Adding(mesh)
    assert summed == [(mesh, mesh, (1, 1))]


def test_a_scheduler_that_jax_does_not_know(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes of Open MPI 5 have no variable that says where they meet."""

    def fail(**options: Any) -> None:
        raise ValueError("coordinator_address should be defined.")

    monkeypatch.setattr(jax.distributed, "initialize", fail)
    monkeypatch.setenv("OMPI_COMM_WORLD_SIZE", "2")
    service = jax.config.jax_enable_preemption_service
    try:
        with pytest.raises(UsageError, match=r"does not know those of Open MPI 5\); give --coord"):
            joining._start(Joined(distributed=True))
    finally:
        jax.config.update("jax_enable_preemption_service", service)


def test_the_precision_of_products_must_agree() -> None:
    """It changes results, and may be set in the environment of one host only."""
    name = "JAX_DEFAULT_MATMUL_PRECISION"
    assert joining._facts(Joined())[name] is None
    with jax.default_matmul_precision("highest"):
        assert joining._facts(Joined())[name] == "highest"


def test_names_of_the_flags() -> None:
    assert joining.OF_PROCESSES == ("distributed", "coordinator", "processes", "process")
