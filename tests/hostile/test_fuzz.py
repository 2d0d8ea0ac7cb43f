"""Whatever the command line and the files are, a command refuses them in one clear line or does its work.

200 cases always run, 5,000 with ``--all``; ``PYTHONPATH=tests python -m hostile.fuzz --help`` explains how
to run others. The oracle itself is tested on commands that misbehave on purpose.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from . import grammar, oracle, sound
from .cases import Case
from .fuzz import Ended, report
from .grammar_flags import BASE, COMMANDS, all_flags
from .grammar_npz import bomb, npy
from .processes import XLA_FLAGS
from .work import WorkBegan

ROOT = Path(__file__).parents[2]
SEED = 18
SHARES, CASES = 2, 100
MANY_SHARES, MANY_CASES = 10, 500


@pytest.fixture(scope="session")
def material(shared_folder: Path) -> Path:
    """Where the sound material lies; the first process that needs it makes it."""
    return shared_folder / "sound"


def _fuzz(material: Path, tmp_path: Path, first: int, cases: int) -> None:
    """Cases in a process of their own, which is like that of a command."""
    where = tmp_path / "ended.json"
    words = ["--cases", cases, "--first", first, "--fuzz-seed", SEED, "--sound", material]
    command = [sys.executable, "-m", "hostile.fuzz", *map(str, words), "--json", str(where)]
    cache = str(material.parent / "cache")  # of compiled programs
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    environment = {
        **os.environ,
        "PYTHONPATH": path,
        "MGPO_CACHE": cache,
        "XLA_FLAGS": XLA_FLAGS,
    }
    done = subprocess.run(
        [*command, "--report", str(tmp_path / "report.md")],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert where.is_file(), done.stderr[-3_000:]
    bad = [one for one in json.loads(where.read_text()) if one["bad"]]
    told = (tmp_path / "report.md").read_text()
    assert not bad, f"{len(bad)} of {cases} cases ended badly, seed {SEED}\n{told[:20_000]}"


@pytest.mark.parametrize("share", range(SHARES))
def test_bad_input_is_refused_and_sound_input_is_not(
    material: Path, tmp_path: Path, share: int
) -> None:
    _fuzz(material, tmp_path, share * CASES, CASES)


@pytest.mark.slow
@pytest.mark.parametrize("share", range(MANY_SHARES))
def test_5000_cases(material: Path, tmp_path: Path, share: int) -> None:
    _fuzz(material, tmp_path, share * MANY_CASES, MANY_CASES)


def test_every_command_has_a_place_in_the_grammar() -> None:
    assert BASE.keys() == COMMANDS.keys()
    assert all(all_flags(command) for command in COMMANDS)


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """Material that is enough for commands that read nothing."""
    folder = tmp_path / "sound"
    folder.mkdir()
    for name in sound.ALWAYS:
        (folder / name).write_text("a file\n")
    return folder


def a_case(**changes: Any) -> Case:
    """A case with a flag that has to be refused."""
    made: dict[str, Any] = {"command": "fake", "words": ("--steps", "x"), "kind": "flags"}
    made |= {"change": "", "expected": "refused", "names": ("--steps",), "found": ("x",)}
    return Case(**{**made, **changes})


def outcome(
    tiny: Path, tmp_path: Path, command: Callable[[str, Sequence[str]], int | None], **changes: Any
) -> tuple[str, str]:
    case = a_case(**changes)
    return oracle.judge(case, oracle.run(case, tiny, tmp_path / "root", command))


def says(*lines: str, code: int | None = 2) -> Callable[[str, Sequence[str]], int | None]:
    """A command that prints lines to stderr."""

    def command(name: str, words: Sequence[str]) -> int | None:
        for line in lines:
            print(line, file=sys.stderr)
        return code

    return command


CLEAR = "error: --steps must be a number, found 'x'"


def test_a_clear_line_is_a_clear_refusal(tiny: Path, tmp_path: Path) -> None:
    assert outcome(tiny, tmp_path, says(CLEAR))[0] == "refused clearly"
    assert outcome(tiny, tmp_path, says(CLEAR), expected="either")[0] == "either"
    assert outcome(tiny, tmp_path, says(CLEAR), expected="accepted")[0] == "refused though valid"


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        ((), "without a line"),
        (("note", CLEAR), "2 lines"),
        ((CLEAR, "bye"), "without a line"),
        (("error: --steps must be another, found '\x1b[31mx'",), "stderr holds"),
        (("error: ValueError: --steps must be another, found x",), "'ValueError'"),
        (("error: --steps must not be x (run with --debug for the traceback)",), "--debug"),
        (("error: it must be another, found x",), "names none"),
        (("error: --steps must be another",), "does not show"),
        (("error: --steps is x",), "no way out"),
    ],
)
def test_what_makes_a_refusal_unclear(
    tiny: Path, tmp_path: Path, lines: tuple[str, ...], reason: str
) -> None:
    what, why = outcome(tiny, tmp_path, says(*lines))
    assert (what, reason in why) == ("unclear", True), why


def test_a_wrong_exit_code_is_unclear(tiny: Path, tmp_path: Path) -> None:
    assert outcome(tiny, tmp_path, says(CLEAR, code=1))[0] == "unclear"


@pytest.mark.parametrize("code", [0, None])
def test_nonsense_that_is_accepted(tiny: Path, tmp_path: Path, code: int | None) -> None:
    assert outcome(tiny, tmp_path, says(code=code))[0] == "accepted nonsense"
    assert outcome(tiny, tmp_path, says(code=code), expected="accepted")[0] == "accepted"


def writes(path: str, code: int | None = 2) -> Callable[[str, Sequence[str]], int | None]:
    def command(name: str, words: Sequence[str]) -> int | None:
        Path(path).write_text("something new")
        return says(CLEAR, code=code)(name, words)

    return command


@pytest.mark.parametrize("path", ["litter", "../litter", "file.txt", "new"])
def test_files_that_nobody_asked_for(tiny: Path, tmp_path: Path, path: str) -> None:
    assert outcome(tiny, tmp_path, writes(path), outputs=("new",))[0] == "outside"
    accepted = outcome(tiny, tmp_path, writes(path, 0), outputs=("new",), expected="accepted")[0]
    assert accepted == ("accepted" if path == "new" else "outside")


def test_a_removed_input(tiny: Path, tmp_path: Path) -> None:
    def command(name: str, words: Sequence[str]) -> int:
        Path("file.txt").unlink()
        return 0

    assert outcome(tiny, tmp_path, command, expected="accepted")[0] == "outside"


def test_what_the_check_of_a_case_finds(tiny: Path, tmp_path: Path) -> None:
    found = outcome(
        tiny, tmp_path, says(code=0), expected="accepted", check=lambda here: f"{here.name} is odd"
    )
    assert found == ("accepted nonsense", "case is odd")
    refused = outcome(tiny, tmp_path, says(CLEAR), check=lambda here: "is odd")
    assert refused[0] == "refused clearly"


def test_tracebacks_are_found(tiny: Path, tmp_path: Path) -> None:
    def raises(name: str, words: Sequence[str]) -> int:
        raise ValueError("unforeseen")

    assert outcome(tiny, tmp_path, raises)[0] == "traceback"
    traced = says("Traceback (most recent call last):", CLEAR)
    assert outcome(tiny, tmp_path, traced)[0] == "traceback"


def test_commands_that_do_not_end(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(oracle, "MAX_SECONDS", 0.2)
    monkeypatch.setattr(oracle, "MAX_WAIT", 0.5)

    def works(name: str, words: Sequence[str]) -> int:
        while True:
            pass

    def waits(name: str, words: Sequence[str]) -> int:
        time.sleep(60)
        return 0

    assert outcome(tiny, tmp_path, works)[0] == "hang"
    assert outcome(tiny, tmp_path, waits)[0] == "hang"


def test_memory_is_measured(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oracle, "MAX_BYTES", 100 << 20)

    def command(name: str, words: Sequence[str]) -> int:
        np.ones(200 << 20, np.uint8).sum()
        return says(CLEAR)(name, words)

    assert outcome(tiny, tmp_path, command)[0] == "memory"
    assert outcome(tiny, tmp_path, says(CLEAR))[0] == "refused clearly"


def test_an_import_of_what_a_file_names_is_found(tiny: Path, tmp_path: Path) -> None:
    (tiny / "trap.py").write_text("WORLD = 1\n")

    def command(name: str, words: Sequence[str]) -> int:
        import trap  # type: ignore[import-not-found] # noqa: F401

        return says(CLEAR)(name, words)

    assert outcome(tiny, tmp_path, command)[0] == "outside"
    assert outcome(tiny, tmp_path, command)[0] == "outside", "the second time, too"


def test_where_the_work_begins_is_an_acceptance(tiny: Path, tmp_path: Path) -> None:
    def module(name: str, words: Sequence[str]) -> None:
        raise WorkBegan

    def command(name: str, words: Sequence[str]) -> int | None:
        try:
            module(name, words)
        except WorkBegan:
            return None
        return 0

    assert outcome(tiny, tmp_path, command, expected="accepted")[0] == "accepted"


def test_a_case_is_a_function_of_seed_and_index(tmp_path: Path) -> None:
    folder = tmp_path / "sound"
    for kind in grammar.FILES:
        path = folder / kind.path
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".json":
            path.write_text('{"env": "maze15", "format": 2, "sha256": "ab", "network": {"a": 1}}')
        elif path.suffix == ".npz":
            np.savez(path, maze=np.zeros((2, 7, 7), int), goal=np.ones((2, 2), int))
        elif path.suffix:
            path.write_text('{"step": 1, "val/loss": 1.0, "cpu_seconds_per_step": 1.0}\n' * 9)
        else:
            path.mkdir()
    for index in range(100):
        first, second = (grammar.case(3, index, folder) for _ in range(2))
        assert (first.words, first.change) == (second.words, second.change)
    assert len({grammar.case(3, index, folder).change for index in range(100)}) > 30


def test_the_bomb_is_a_sound_zip_file_but_for_its_checksum(tmp_path: Path) -> None:
    data = bomb("maze", np.zeros((2, 3), np.float32))
    assert len(data) < 4_000_000
    (tmp_path / "bomb.npz").write_bytes(data)
    with np.load(tmp_path / "bomb.npz") as file:
        assert file.files == ["maze"]
        header = file.zip.open("maze.npy").read(128)
    assert header.startswith(npy(np.zeros(0))[:8])


def test_the_report_counts_and_shows_the_smallest_example() -> None:
    def ended(index: int, outcome: str, line: str) -> Ended:
        return Ended(
            index=index, command="adapt", kind="flags", line=line, change="", expected="refused",
            outcome=outcome, reason="", code=2, err="", seconds=0.5,
        )  # fmt: skip

    text = report([ended(0, "unclear", "adapt --steps x"), ended(1, "unclear", "adapt"),
                   ended(2, "refused clearly", "adapt --c x")], 7)  # fmt: skip
    assert "3 cases, seed 7" in text
    assert "2 ended badly" in text
    assert "| adapt | 1 | 2 | 3 |" in text
    assert "#1 `adapt` -> unclear" in text
