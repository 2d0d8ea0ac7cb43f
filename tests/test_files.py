"""Files and folders are written atomically, and only one process may write to a folder."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from envs.errors import DataError, UsageError
from mgpo_jax.claims import InUseError, check_place, claimed, clean_up
from mgpo_jax.files import (
    TEMPORARY,
    has_work,
    hash_arrays,
    new_folder,
    remove_leftovers,
    remove_unfinished,
    write_arrays,
    write_json,
    write_text,
    written,
)
from mgpo_jax.journal import Journal


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def fail_in(folder: Path, keep: str = "") -> None:
    """Write a file and a finished piece of work, and then fail."""
    with new_folder(folder, keep) as place:
        (place / "file").write_text("content")
        if keep:
            (place.parent / keep).mkdir()
            write_arrays(place.parent / keep / "piece.npz", {"a": np.ones(2)})
        raise ZeroDivisionError


def test_a_folder_appears_when_it_is_complete(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "folder"
    with new_folder(folder) as partial:
        (partial / "file").write_text("content")
        assert not folder.exists()
    assert names(folder.parent) == ["folder"]
    assert names(folder) == ["file"]
    assert (folder / "file").read_text() == "content"


def test_a_failure_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        fail_in(tmp_path / "folder")
    assert names(tmp_path) == []


def test_an_existing_folder_is_kept(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="already exists; remove it"), new_folder(tmp_path):
        raise AssertionError("not reached")
    assert tmp_path.is_dir()


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    left = tmp_path / "folder.partial" / "result"
    left.mkdir(parents=True)
    (left / "old").write_text("")
    with new_folder(tmp_path / "folder") as place:
        (place / "new").write_text("")
    assert names(tmp_path) == ["folder"]
    assert names(tmp_path / "folder") == ["new"]


def test_what_is_not_ours_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "folder.partial").mkdir()
    (tmp_path / "folder.partial" / "thesis.txt").write_text("mine")
    with (
        pytest.raises(
            UsageError, match=r"thesis\.txt is in the way and was not written by this command"
        ),
        new_folder(tmp_path / "folder"),
    ):
        pass
    assert (tmp_path / "folder.partial" / "thesis.txt").read_text() == "mine"


def test_leftovers_beside_a_finished_folder(tmp_path: Path) -> None:
    """A process was killed right after it had made the folder."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder.partial" / "work").mkdir(parents=True)
    write_arrays(tmp_path / "folder.partial" / "work" / "piece.npz", {"a": np.ones(2)})
    remove_leftovers(tmp_path / "folder", keep="work")
    assert names(tmp_path) == ["folder"]


RACE = """
import sys
from pathlib import Path
from mgpo_jax.claims import InUseError, claimed
held = 0
while held < 500:
    try:
        with claimed(Path(sys.argv[1])):
            held += 1
    except InUseError:
        pass
"""


def test_processes_that_make_and_remove_one_folder(tmp_path: Path) -> None:
    words = [sys.executable, "-c", RACE, str(tmp_path / "deep" / "folder")]
    racers = [subprocess.Popen(words, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    for racer in racers:
        _, err = racer.communicate(timeout=120)
        assert (racer.returncode, err) == (0, "")
    assert not (tmp_path / "deep" / "folder").exists()


def test_finished_work_stays_after_a_failure(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        fail_in(tmp_path / "folder", keep="work")
    assert names(tmp_path / "folder.partial") == ["work"]
    assert has_work(tmp_path / "folder.partial" / "work")
    with new_folder(tmp_path / "folder", keep="work") as place:
        assert has_work(place.parent / "work")
    assert names(tmp_path) == ["folder"]


HOLDER = """
import sys, time
from pathlib import Path
from mgpo_jax.claims import claimed
with claimed(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(float(sys.argv[2]))
"""


def holder(folder: Path, seconds: float) -> subprocess.Popen:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(folder), str(seconds)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_a_second_process_is_told_who_has_the_folder(tmp_path: Path) -> None:
    """The claim of a process that was killed holds nobody up."""
    folder = tmp_path / "run"
    process = holder(folder, 60)
    in_use = rf"run is in use by process {process.pid} on "
    with pytest.raises(InUseError, match=in_use), claimed(folder):
        pass
    process.kill()
    process.wait()
    with claimed(folder):
        assert names(folder) == [".lock"]
    assert not folder.exists()  # it was empty


def test_waiting_for_the_other_process(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    process = holder(tmp_path / "run", 1)
    with claimed(tmp_path / "run", wait=True):
        assert process.wait(10) == 0
    assert "waiting for process" in capsys.readouterr().err


def test_a_claim_within_one_process(tmp_path: Path) -> None:
    with claimed(tmp_path / "run"):
        with pytest.raises(InUseError), claimed(tmp_path / "run"):
            pass
        (tmp_path / "run" / "file").write_text("")
    assert names(tmp_path / "run") == ["file"]


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("file/below", "file is not a folder"),
        ("file/deep/below", "file is not a folder"),
        ("x" * 250, "name is too long"),
        ("deep/" + "x" * 300 + "/below", "name is too long"),
    ],
)
def test_places_that_cannot_be_written(tmp_path: Path, place: str, says: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match=says):
        check_place(tmp_path / place)
    with pytest.raises((UsageError, DataError)), new_folder(tmp_path / place):
        pass
    assert names(tmp_path) == ["file"]


def test_a_place_without_room(tmp_path: Path) -> None:
    check_place(tmp_path / "x", num_bytes=1)
    with pytest.raises(UsageError, match=r"--out .*x: .* MB free, 1000000000000 MB are needed"):
        check_place(tmp_path / "x", num_bytes=10**18)


def test_a_file_keeps_its_content_until_the_new_one_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"a": float("nan")})

    def full(*args: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(OSError, match="No space left"):
            write_text(path, "other")
    assert path.read_text() == '{\n  "a": 1\n}\n'
    assert names(tmp_path) == ["file.json"]


def test_a_temporary_file_has_the_suffix_of_its_place(tmp_path: Path) -> None:
    with written(tmp_path / "picture.png") as partial:
        assert partial.suffix == ".png"
        partial.write_bytes(b"x")
    assert names(tmp_path) == ["picture.png"]


def leave_in(folder: Path) -> None:
    """Clean up as a process does that is asked to leave at once, in the middle of its work."""
    with new_folder(folder) as place, written(folder.parent / "other") as partial:
        (place / "file").write_text("")
        partial.write_text("")
        clean_up()
        assert names(folder.parent) == []


def test_leaving_at_once_cleans_up(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        leave_in(tmp_path / "folder")
    (tmp_path / f"{TEMPORARY}x").write_text("")
    remove_unfinished(tmp_path)
    assert names(tmp_path) == []


def test_the_hash_of_arrays_knows_names_dtypes_shapes_and_contents() -> None:
    base = {"a": np.arange(6, dtype=np.int32), "b": np.zeros((), bool)}
    others = [
        {"c": base["a"], "b": base["b"]},
        {**base, "a": base["a"].astype(np.int64)},
        {**base, "a": base["a"].reshape(2, 3)},
        {**base, "a": base["a"] + 1},
    ]
    hashes = {hash_arrays(arrays) for arrays in (base, *others)}
    assert len(hashes) == 5
    assert hash_arrays(dict(reversed(base.items()))) == hash_arrays(base)


def test_a_journal_gives_back_what_it_keeps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = {"x": np.arange(3), "flag": np.array(True), "empty": np.zeros((0, 2), np.float32)}
    journal = Journal(tmp_path / "pieces")
    assert journal.read("one") is None
    journal.write("one", record)
    found = Journal(tmp_path / "pieces").read("one")
    assert found is not None
    assert hash_arrays(found) == hash_arrays(record)
    path = tmp_path / "pieces" / "one.npz"
    content = path.read_bytes()
    for damaged in (
        content[:-30],
        content.replace(np.arange(3).tobytes(), np.arange(1, 4).tobytes()),
        b"",
        b"no zip",
    ):
        path.write_bytes(damaged)
        assert journal.read("one") is None
        assert "is damaged; that piece of the work is done again" in capsys.readouterr().err


def test_a_journal_without_a_folder_keeps_nothing() -> None:
    journal = Journal()
    journal.write("one", {"x": np.ones(1)})
    assert journal.read("one") is None
