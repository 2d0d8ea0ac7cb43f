"""Full disks, unwritable places, closed streams, and other odd environments."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from .commands import ADAPT, COLLECT, LONG, WORLD, Reference
from .processes import Ended, Server, Trap

SIZE = 48 << 20  # bytes of a small disk


@contextmanager
def small_disk(place: Path, options: str = f"size={SIZE}") -> Iterator[Path]:
    """A small file system in memory, or a skip where none may be mounted."""
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("mounting a file system is not permitted")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def assert_refused(done: Ended, code: int, *words: str) -> None:
    """One line on stderr that says why."""
    assert done.code == code, done.err
    assert len(done.lines) == 1, done.err
    assert done.err.startswith("error: ")
    for word in words:
        assert word in done.err
    assert "Errno" not in done.err
    assert "--debug" not in done.err


def assert_full(done: Ended, out: str) -> None:
    assert done.code == 1, done.err
    assert "Traceback" not in done.err
    errors = [line for line in done.lines if "rror" in line]
    assert len(errors) == 1, done.err
    assert errors[0].startswith("error: ")
    assert "space" in errors[0]
    assert out in errors[0]
    assert "--resume" in errors[0]


ALL = [(name, share) for name in LONG for share in (0.2, 0.4, 0.6, 0.8, 0.95)]


@pytest.mark.parametrize(
    ("name", "share"),
    [("collect", 0.5), *(pytest.param(*c, marks=pytest.mark.slow) for c in ALL)],
)
def test_a_disk_that_seems_full(
    server: Server, reference: Reference, here: Path, name: str, share: float
) -> None:
    """From one operation on, nothing can be made; with room the command goes on."""
    long = LONG[name]
    done = server.run(long.line, here, Trap(round(share * reference.operations(name)), 0))
    if done.code != 0 or share <= 0.5:  # it may have had all the room that it needed
        assert_full(done, long.out)
        done = server.again(long.resumed, here)
    assert done.code == 0, done.err
    reference.check(here, long)


@pytest.mark.parametrize(
    ("name", "share"),
    [("collect", 0.5), *(pytest.param(*case, marks=pytest.mark.slow) for case in ALL)],
)
def test_a_disk_that_is_full(
    server: Server, reference: Reference, here: Path, name: str, share: float
) -> None:
    """The same on a file system that another file fills meanwhile."""
    long = LONG[name]
    with small_disk(here / "disk") as disk:
        reference.furnish(disk)
        trap = Trap(round(share * reference.operations(name)), signal.SIGSTOP)
        child = server.start(long.line, disk, trap)
        child.wait_for(lambda: child.is_held)
        fill(disk / "filler")
        child.send(signal.SIGCONT)
        done = child.wait()
        (disk / "filler").unlink()
        if done.code != 0 or share <= 0.5:  # it may have had all the room that it needed
            assert_full(done, long.out)
            done = server.again(long.resumed, disk)
        assert done.code == 0, done.err
        reference.check(disk, long)


def fill(path: Path) -> None:
    """Fill a disk with a file."""
    with open(path, "wb", buffering=0) as file:
        for size in (1 << 20, 1 << 12, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                pass


PLACES = {
    "below a file": ("file.txt/x", "file.txt"),
    "below a device": ("/dev/null/x", "/dev/null"),
    "too long a name": ("x" * 250, "too long"),
    "a longer one": ("x" * 300, "too long"),
    "a file": ("file.txt", "file.txt"),
}
MAKERS = {
    **{name: long.line.partition(" --out ")[0] + " --out {}" for name, long in LONG.items()},
    "bench": "bench --json {}",
    "evaluate": "evaluate result --json {}",
    "check": "check result --out {}",
    "plot": "plot result --out {}",
    "report": f"report result {WORLD} --out {{}}",
    "playground": "playground --out {}",
    "export": "export --out {}",
    "release": f"release run {WORLD} --out {{}}",
    "reproduce": f"reproduce figure8 {WORLD} --only 5 --out {{}}",
}


@pytest.mark.parametrize("where", list(PLACES))
@pytest.mark.parametrize("name", list(MAKERS))
def test_places_where_nothing_can_be_made(
    server: Server, reference: Reference, here: Path, name: str, where: str
) -> None:
    """They are found out before the work."""
    place, says = PLACES[where]
    reference.furnish(here / "all", "run", "result")
    here = here / "all"
    (here / "file.txt").write_text("mine")
    before = files(here)
    child = server.again(MAKERS[name].format(place), here)
    assert_refused(child, 2, says)
    assert files(here) == before


def files(folder: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() if p.is_file() else b"" for p in folder.rglob("*")}


@pytest.mark.parametrize("name", list(MAKERS))
def test_a_disk_that_cannot_be_written(
    server: Server, reference: Reference, here: Path, name: str
) -> None:
    reference.furnish(here / "all", "run", "result")
    with small_disk(here / "disk", "ro"):
        done = server.again(MAKERS[name].format(here / "disk/x"), here / "all")
        assert_refused(done, 2, str(here / "disk"))


@pytest.mark.parametrize("name", list(LONG))
def test_a_disk_that_is_too_small(server: Server, here: Path, name: str) -> None:
    with small_disk(here / "disk", "size=200k") as disk:
        done = server.again(MAKERS[name].format(disk / "x"), here)
        assert_refused(done, 2, str(disk), "MB")
        assert list(disk.iterdir()) == []


@pytest.mark.parametrize(
    ("stdout", "code", "says"),
    [
        ("closed", 0, ""),
        pytest.param("broken", 141, "", marks=pytest.mark.slow),
        pytest.param("ascii", 0, "final return   0.000 +- 0.000", marks=pytest.mark.slow),
    ],
)
def test_results_stand_where_they_cannot_be_printed(
    server: Server, reference: Reference, here: Path, stdout: str, code: int, says: str
) -> None:
    line = ADAPT.line.replace("--no-figures", "--figures")
    if says:  # with two seeds there is a ``±`` to print
        line = line.replace("--seeds 1", "--seeds 2")
    done = server.run(line, here, stdout=stdout)
    assert done.code in (0, code), done.err
    assert "rror" not in done.err
    assert says in done.out
    assert {"results.npz", "summary.json", "learning_curve.png"} <= {
        path.name for path in (here / "result").iterdir()
    }
    assert server.again(f"{line} --resume", here).code == 0


@pytest.mark.parametrize(
    ("shell", "code"),
    [
        ("{} >&-", 0),
        ("{} >&- 2>&-", 0),
        ("{} > /dev/full", 0),
        ("set -o pipefail; ({}) | true", 141),
    ],
)
def test_streams_of_a_shell(server: Server, here: Path, shell: str, code: int) -> None:
    done = server.from_scratch("list", here, shell=shell.replace("{}", "{}")).wait()
    assert done.code in (0, code), done.err
    assert "Traceback" not in done.err
    assert len(done.lines) <= 1


def as_nobody() -> None:
    os.setgroups([])
    os.setgid(54321)
    os.setuid(54321)


def nobody_can_start() -> bool:
    """Whether an unknown user may run Python and read this project."""
    import sys

    try:
        done = subprocess.run(
            [sys.executable, "-c", "import numpy, experiments.runtime"],
            check=False,
            preexec_fn=as_nobody,
            capture_output=True,
            cwd="/",
        )
    except (OSError, subprocess.SubprocessError):
        return False
    return done.returncode == 0


FEW = f"collect {WORLD} --trajectories 20 --out dataset"


@pytest.mark.parametrize(
    "changes",
    [
        {"HOME": None, "MGPO_CACHE": None},
        pytest.param({"JAX_ENABLE_X64": "1"}, marks=pytest.mark.slow),
        pytest.param({"HOME": "/nowhere", "MGPO_CACHE": None}, marks=pytest.mark.slow),
        pytest.param({"MGPO_CACHE": "/dev/null/x"}, marks=pytest.mark.slow),
        pytest.param({"PYTHONIOENCODING": "ascii"}, marks=pytest.mark.slow),
        pytest.param({"TERM": None, "LANG": None, "LC_ALL": "C"}, marks=pytest.mark.slow),
    ],
    ids=" ".join,
)
def test_odd_surroundings(server: Server, here: Path, changes: dict[str, str | None]) -> None:
    environment = {k: v for k, v in {**server.environment, **changes}.items() if v is not None}
    if (
        changes.get("MGPO_CACHE", "") is None
    ):  # compiled programs are kept where the test can see them
        environment["TMPDIR"] = str(here)
    done = server.from_scratch(FEW, here, env=environment).wait()
    assert done.code == 0, done.err
    assert (here / "dataset/manifest.json").is_file()
    assert "rror" not in done.err
    assert "arning" not in done.err


def test_an_unknown_user(server: Server, here: Path) -> None:
    if os.getuid() != 0 or not nobody_can_start():
        pytest.skip("no process can be started as another user")
    here.chmod(0o777)
    environment = {k: v for k, v in server.environment.items() if k not in ("HOME", "MGPO_CACHE")}
    done = server.from_scratch(FEW, here, env=environment, preexec_fn=as_nobody).wait()
    assert done.code == 0, done.err
    assert "rror" not in done.err


def test_a_device_that_is_not_there(server: Server, here: Path) -> None:
    environment = {**server.environment, "JAX_PLATFORMS": "nonsense"}
    done = server.from_scratch(FEW, here, env=environment).wait()
    assert_refused(done, done.code, "JAX_PLATFORMS", "nonsense")
    assert done.code in (1, 2)
    assert not list(here.glob("dataset*"))


def test_without_a_terminal_there_is_no_bar(server: Server, here: Path) -> None:
    done = server.again(COLLECT.line, here)
    assert done.code == 0
    assert "\r" not in done.err
    assert "%|" not in done.err
