"""Commands that are killed repeatedly end with the same bits when they are resumed.

A process is killed (SIGKILL) at one of its operations on files, for example between the two writes of a
save. Some kills come a random time later. ``--all`` adds some 200 kills.
"""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from .commands import LONG, PRETRAIN, Long, Reference, contents
from .processes import Server, Trap

KILLED = -signal.SIGKILL
NUM = {"pretrain": 2, "adapt": 2, "collect": 9}
"""Interrupted runs of each command; each is killed twice."""
NUM_ALL = {"pretrain": 38, "adapt": 38, "collect": 36}
LATEST = 0.03  # seconds, between an operation and a kill at random


def moments(name: str, index: int, num: int, operations: int) -> Iterator[Trap]:
    """Two moments at which to kill a command: spread over its operations, half of them delayed.

    Args:
      name: of the command.
      index: of the run.
      num: how many runs there are.
      operations: how many operations an undisturbed command has.
    """
    rng = np.random.default_rng([num, index, *name.encode()])
    first = int(operations * (index + rng.uniform()) / num) + 1
    # Less is left than before, and a kill that comes too late is none.
    second = int(rng.integers(1, max((operations - first) // 2, 8)))
    for at in (first, second):
        yield Trap(at, delay=float(rng.choice([0.0, rng.uniform(0, LATEST)])))


CASES = [(name, index, num) for name, num in NUM.items() for index in range(num)]
ALL_CASES = [(name, index, num) for name, num in NUM_ALL.items() for index in range(num)]


@pytest.mark.parametrize(
    ("name", "index", "num"),
    [*CASES, *(pytest.param(*case, marks=pytest.mark.slow) for case in ALL_CASES)],
)
def test_a_killed_command_ends_in_the_same_bits(
    server: Server,
    reference: Reference,
    here: Path,
    record_property: Callable[[str, int], None],
    name: str,
    index: int,
    num: int,
) -> None:
    long, kills = LONG[name], 0
    for trap in moments(name, index, num, reference.operations(name)):
        done = server.run(long.resumed, here, trap)
        assert done.code in (KILLED, 0), done.err
        assert "Traceback" not in done.err
        kills += done.code == KILLED
    record_property(name, kills)
    assert kills > 0
    done = server.again(long.resumed, here)
    assert done.code == 0, done.err
    assert "error:" not in done.err
    reference.check(here, long)


ON = Long(f"{PRETRAIN.line} --init policy", "run")


def test_a_killed_training_that_starts_from_a_policy_ends_in_the_same_bits(
    server: Server, reference: Reference, here: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """It is killed while it copies the policy and later on, and then the policy is replaced."""
    undisturbed, count = reference.furnish(tmp_path_factory.mktemp("undisturbed")), here / "count"
    assert server.run(ON.line, undisturbed, count=str(count)).code == 0
    operations, copying = int(count.read_text()), 0
    for at in (*range(2, 14, 3), operations // 2):
        assert server.run(ON.resumed, here, Trap(at)).code == KILLED
        copying += (here / "run/init").exists() and not (here / "run/config.json").exists()
    assert copying > 0
    shutil.rmtree(here / "policy")
    shutil.copytree(undisturbed / "run/policy", here / "policy")
    done = server.again(ON.resumed, here)
    assert done.code == 0, done.err
    assert contents(here / "run") == contents(undisturbed / "run")
    assert not list((here / "run").rglob(".writing*"))
