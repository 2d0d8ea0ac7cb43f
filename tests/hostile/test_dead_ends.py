"""States that a kill, a power cut or a mistake leaves behind: one command continues from each of them.

If a command is refused, its message names a way out, which the test then takes.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from .commands import ADAPT, COLLECT, LONG, PRETRAIN, WORLD, Reference
from .processes import Server, Trap

METRICS = "run/metrics.jsonl"


@pytest.fixture
def half(reference: Reference, here: Path) -> Path:
    """The current folder, with a training that was killed on the way."""
    shutil.copytree(reference.folder / "half_run", here / "run")
    return here


def newest_checkpoint(here: Path) -> Path:
    return max((p for p in (here / "run/checkpoints").iterdir() if p.name.isdigit()), key=_step)


def _step(path: Path) -> int:
    return int(path.name)


def cut_last_row(here: Path) -> None:
    path = here / METRICS
    path.write_text(path.read_text()[:-40])


def zeros_at_the_end(here: Path) -> None:
    with open(here / METRICS, "ab") as file:
        file.write(bytes(300))


def damage(place: str, change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """A change of the files of the newest checkpoint that a pattern names."""

    def do(here: Path) -> None:
        paths = [p for p in newest_checkpoint(here).glob(place) if p.is_file()]
        assert paths
        for path in paths:
            path.write_bytes(change(path.read_bytes()))

    return do


def flipped(data: bytes) -> bytes:
    """The bytes with one bit of the middle one flipped."""
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


TORN = {
    "last row of metrics cut": (cut_last_row, ""),
    "zeros after the metrics": (zeros_at_the_end, ""),
    "metrics lost": (lambda here: (here / METRICS).unlink(), ""),
    "newest checkpoint empty": (damage("**/*", lambda data: b""), "checkpoints"),
    "newest checkpoint cut": (damage("default/ocdbt.process_0/d/*", cut), "checkpoints"),
    "a bit of it flipped": (damage("default/ocdbt.process_0/d/*", flipped), "checkpoints"),
    "its description flipped": (damage("default/_METADATA", flipped), "checkpoints"),
    "no meta.json": (lambda here: (here / "run/meta.json").unlink(), ""),
    "half a policy": (lambda here: shutil.copytree(here / "policy", here / "run/policy"), ""),
    "a policy of nothing": (lambda here: (here / "run/policy.partial").mkdir(), ""),
    "a file that was being written": (lambda here: (here / "run/.writing-0a.json").touch(), ""),
}


def some(cases: Iterable[Any], *quick: Any) -> list[Any]:
    """Cases for ``parametrize``, of which all but a few are slow."""
    return [case if case in quick else pytest.param(case, marks=pytest.mark.slow) for case in cases]


@pytest.mark.parametrize(
    "state",
    some(TORN, "last row of metrics cut", "newest checkpoint cut", "no meta.json", "half a policy"),
)
def test_a_torn_run_goes_on_by_itself(
    server: Server, reference: Reference, half: Path, state: str
) -> None:
    tear, says = TORN[state]
    tear(half)
    done = server.again(PRETRAIN.resumed, half)
    assert done.code == 0, done.err
    assert "rror" not in done.err
    assert says in done.err
    assert len(done.lines) <= 2 + bool(says), done.err
    assert (half / "run/checkpoints-damaged").exists() == (says == "checkpoints")
    reference.check(half, PRETRAIN)


def half_a_copy(run: Path) -> None:
    (run / "meta.json").write_text("{}")
    (run / "init").mkdir()
    for name in ("weights.npz", ".writing-0a.json"):
        (run / "init" / name).write_text("half")


UNBEGUN = {
    "an empty folder": lambda run: None,
    "half a config": lambda run: (run / "config.json.partial").write_text("{"),
    "a file that was being written": lambda run: (run / ".writing-0a.json").write_text("{"),
    "no config": lambda run: (run / "meta.json").write_text("{}"),
    "half a copy of a policy": half_a_copy,
    "a lock of a dead process": lambda run: (run / ".lock").write_text("1 on nowhere\n"),
}


@pytest.mark.parametrize("resume", some([False, True], True), ids=["plain", "resume"])
@pytest.mark.parametrize("state", some(UNBEGUN, "an empty folder"))
def test_a_run_that_did_not_begin_is_none(
    server: Server, reference: Reference, here: Path, state: str, resume: bool
) -> None:
    (here / "run").mkdir()
    UNBEGUN[state](here / "run")
    done = server.again(PRETRAIN.resumed if resume else PRETRAIN.line, here)
    assert done.code == 0, done.err
    reference.check(here, PRETRAIN)


@pytest.mark.parametrize("content", ["", '{"env": "own_wo', "null"])
def test_a_config_that_was_cut_names_the_way_out(server: Server, half: Path, content: str) -> None:
    """A power cut under an older version could do that."""
    (half / "run/config.json").write_text(content)
    for line in (PRETRAIN.resumed, PRETRAIN.line):
        done = server.again(line, half)
        assert done.code in (1, 2)
        assert len(done.lines) == 1
        assert done.err.startswith("error: ")
    done = server.again(PRETRAIN.resumed, half)
    assert "run/config.json" in done.err
    assert re.search(r"remove|--out", done.err), done.err


@pytest.mark.parametrize("name", ["adapt", "collect"])
@pytest.mark.parametrize("litter", [".partial", ".partial-1", ".partial-12345"])
def test_litter_of_a_dead_process_is_in_nobodys_way(
    server: Server, reference: Reference, here: Path, name: str, litter: str
) -> None:
    long = LONG[name]
    folder = here / f"{long.out}{litter}"
    (folder / "result").mkdir(parents=True)
    (folder / "result" / "results.npz").write_bytes(b"half")
    done = server.again(long.line, here)
    assert done.code == 0, done.err
    if folder.exists():  # it may be the user's own, but for the name that the command uses
        assert litter != ".partial"
        shutil.rmtree(folder)
    reference.check(here, long)


@pytest.mark.parametrize("name", some(["adapt", "collect"], "collect"))
def test_unfinished_work_is_not_started_again_unasked(
    server: Server, reference: Reference, here: Path, name: str
) -> None:
    """Without --resume it is refused; with it, it goes on."""
    long = LONG[name]
    server.run(long.line, here, Trap(reference.operations(name) // 2))
    done = server.again(long.line, here)
    assert (done.code, len(done.lines)) == (2, 1)
    assert f"{long.out}.partial holds unfinished work" in done.err
    assert "--resume" in done.err
    other = {"adapt": "--episodes 14", "collect": "--seed 7"}[name]
    done = server.again(f"{long.resumed} {other}".replace("--episodes 12 ", ""), here)
    assert (done.code, len(done.lines)) == (2, 1), done.err
    assert "other settings" in done.err
    assert server.again(long.resumed, here).code == 0
    reference.check(here, long)


FAILED_STARTS = [
    ("--num-heads 2", "--num-heads 3"),
    ("--embed-dim 8", "--embed-dim 0"),
    ("--steps 20", "--steps 20 --seed 100000000000000000000"),
    ("--steps 20", "--steps 20 --tb"),
    ("--steps 20", "--steps 20 --init nowhere"),
    ("--embed-dim 8", "--embed-dim 16 --init policy"),
]


@pytest.mark.parametrize(("right", "wrong"), FAILED_STARTS)
def test_a_start_that_failed_leaves_nothing(
    server: Server, here: Path, right: str, wrong: str
) -> None:
    try:
        import tensorboardX  # noqa: F401

        if "--tb" in wrong:
            pytest.skip("tensorboardX is installed")
    except ImportError:
        pass
    before = sorted(here.rglob("*"))
    done = server.again(PRETRAIN.line.replace(right, wrong), here)
    assert (done.code, len(done.lines)) == (2, 1), done.err
    assert sorted(here.rglob("*")) == before


def moved(here: Path) -> str:
    (here / "elsewhere").mkdir()
    (here / "run").rename(here / "elsewhere/run")
    return "elsewhere/run"


NAMES: dict[str, Callable[[Path], str]] = {
    "absolute": lambda here: str(here / "run"),
    "with a dot": lambda here: "./run",
    "by a detour": lambda here: "data/../run",
    "moved": moved,
}


@pytest.mark.parametrize("name", some(NAMES, "moved"))
def test_a_run_goes_on_by_any_name(
    server: Server, reference: Reference, half: Path, name: str
) -> None:
    place = NAMES[name](half)
    done = server.again(PRETRAIN.resumed.replace("--out run", f"--out {place}"), half)
    assert done.code == 0, done.err
    if name == "moved":
        (half / place).rename(half / "run")
    reference.check(half, PRETRAIN)


@pytest.mark.slow
def test_loggers_and_cadence_are_no_settings_of_a_training(
    server: Server, reference: Reference, half: Path
) -> None:
    line = PRETRAIN.resumed.replace(
        "--save-every 3 --eval-every 4", "--save-every 5 --eval-every 10"
    )
    done = server.again(line, half)
    assert done.code == 0, done.err
    found, wanted = (p / "run/policy/weights.npz" for p in (half, reference.folder))
    assert found.read_bytes() == wanted.read_bytes()


@pytest.mark.slow
def test_checkpoints_that_are_no_folder(server: Server, half: Path, reference: Reference) -> None:
    shutil.rmtree(half / "run/checkpoints")
    (half / "run/checkpoints").write_text("no")
    done = server.again(PRETRAIN.resumed, half)
    assert (done.code, len(done.lines)) == (1, 1), done.err
    assert "remove it" in done.err
    (half / "run/checkpoints").unlink()
    assert server.again(PRETRAIN.resumed, half).code == 0
    reference.check(half, PRETRAIN)


def test_a_finished_run_is_resumed_without_work(
    server: Server, reference: Reference, here: Path
) -> None:
    """What a scheduler does that starts the same command again and again."""
    reference.furnish(here / "all", "run", "result", "dataset")
    for long in (PRETRAIN, ADAPT, COLLECT):
        done = server.again(long.resumed, here / "all")
        assert done.code == 0, done.err
        reference.check(here / "all", long)


@pytest.mark.slow
def test_release_that_was_killed_leaves_no_half_policy(
    server: Server, reference: Reference, here: Path
) -> None:
    reference.furnish(here / "all", "run")
    at, code = 1, -9
    while code == -9 and at < 60:
        done = server.run(f"release run {WORLD} --out packed", here / "all", Trap(at))
        code = done.code
        assert (here / "all/packed").exists() in (False, code == 0) or complete(here / "all/packed")
        if (here / "all/packed").exists():
            shutil.rmtree(here / "all/packed")
        at += 4
    assert code == 0, done.err
    done = server.again(f"release run {WORLD} --out packed", here / "all")
    assert done.code == 0, done.err
    assert not list((here / "all").glob("packed.*"))


def complete(folder: Path) -> bool:
    names = {path.name for path in folder.iterdir()}
    return {"config.json", "weights.npz", "README.md", "tasks.npz"} <= names


def test_release_of_a_run_without_meta(server: Server, reference: Reference, here: Path) -> None:
    reference.furnish(here / "all", "run")
    (here / "all/run/meta.json").unlink()
    done = server.again(f"release run {WORLD} --out packed", here / "all")
    assert done.code == 0, done.err


REPRODUCE = f"reproduce figure8 {WORLD} --only 5 --steps 4 --trajectories 40 --seeds 1 --out tables"


@pytest.mark.slow
def test_reproduce_goes_on_from_any_state(server: Server, reference: Reference, here: Path) -> None:
    """Killed at moments all over its way, and with a policy that is half there."""
    count = here / "count"
    done = server.run(REPRODUCE, here, count=str(count))
    assert done.code == 0, done.err
    table = (here / "tables").rglob("figure8.md")
    wanted = next(table).read_text()
    (here / "tables").rename(here / "before")
    for at in range(1, int(count.read_text()), int(count.read_text()) // 12):
        done = server.run(REPRODUCE, here, Trap(at))
        assert done.code in (0, -9), done.err
    done = server.run(REPRODUCE, here)
    assert done.code == 0, done.err
    assert next((here / "tables").rglob("figure8.md")).read_text() == wanted


def test_results_are_found_from_anywhere(server: Server, reference: Reference, here: Path) -> None:
    """A moved result finds its policy beside it, or where --policy says."""
    reference.furnish(here / "all")
    assert server.again(ADAPT.line, here / "all").code == 0
    (here / "other").mkdir()
    done = server.again("evaluate ../all/result --episodes 1", here / "other")
    assert done.code == 0, done.err
    (here / "all/policy").rename(here / "other/weights")
    done = server.again("evaluate ../all/result --episodes 1", here / "other")
    assert done.code in (1, 2)
    assert "--policy" in done.err
    done = server.again("evaluate ../all/result --episodes 1 --policy weights", here / "other")
    assert done.code == 0, done.err
    assert json.loads((here / "all/result/config.json").read_text())
