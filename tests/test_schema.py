"""Files against their schemas: what is refused before memory is allocated, and what is converted."""

from __future__ import annotations

import struct
import time
import tracemalloc
import warnings
import zipfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
from annotated_types import Ge
from pydantic import BaseModel

from envs.errors import DataError
from envs.registry import WORLDS
from mgpo_jax.archives import array_names, read_arrays
from mgpo_jax.array_fields import ArrayField
from mgpo_jax.files import write_arrays
from mgpo_jax.mapped import fitted_arrays
from mgpo_jax.schema import STRICT, Json, checked_entry, read_document, read_json_lines

FIELDS = {
    "maze": ArrayField(("task", 3, 3), "int32"),
    "goal": ArrayField(("task", 2), "float32"),
}
MAZE, GOAL = np.arange(18).reshape(2, 3, 3), np.arange(4.0).reshape(2, 2)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    np.savez(tmp_path / "T.npz", maze=MAZE, goal=GOAL)
    return tmp_path / "T.npz"


def header(text: str) -> bytes:
    """The start of an npy file."""
    line = text.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(line)) + line


def npy(descr: str = "'<i8'", shape: str = "(2, 3, 3)", data: bytes = bytes(144)) -> bytes:
    return header(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}") + data


def packed(path: Path, maze: bytes, method: int = zipfile.ZIP_STORED, times: int = 1) -> None:
    """An npz file whose member ``maze`` holds any bytes."""
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", method) as archive:
        warnings.simplefilter("ignore")  # of names that are there twice
        for _ in range(times):
            archive.writestr("maze.npy", maze)
        archive.writestr("goal.npy", npy("'<f8'", "(2, 2)", bytes(32)))


def refused(path: Path, **options: Any) -> str:
    """The message of a file that cannot be read, which is one line and comes at once, without warnings."""
    began = time.monotonic()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(DataError) as caught:
            read_arrays(path, FIELDS, mend="make it again", **options)
    assert time.monotonic() - began < 1
    text = str(caught.value)
    assert text.startswith(str(path))
    assert text.endswith("; make it again")
    assert "\n" not in text
    return text


def test_arrays_come_back(path: Path) -> None:
    found = read_arrays(path, FIELDS)
    np.testing.assert_array_equal(found["maze"], MAZE)
    assert [found[name].dtype for name in FIELDS] == [np.int32, np.float32]
    assert array_names(path) == ["maze", "goal"]


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["<i8", ">i4", ">u8", "u1"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_foreign_variants_are_converted(path: Path, order: Any, dtype: str, save: Any) -> None:
    save(path, maze=np.asarray(MAZE.astype(dtype), order=order), goal=GOAL.astype(">f8"))
    found = read_arrays(path, FIELDS)
    np.testing.assert_array_equal(found["maze"], MAZE)
    np.testing.assert_array_equal(found["goal"], GOAL)
    assert [found[name].dtype for name in FIELDS] == [np.int32, np.float32]


def test_long_arrays_are_converted_piece_by_piece(path: Path) -> None:
    """In little more memory than the result takes, though the file holds twice as many bytes."""
    rows = np.random.default_rng(0).normal(size=(300_000, 7))
    for saved in (rows, np.asfortranarray(rows)):
        np.savez(path, rows=saved)
        tracemalloc.start()
        found = read_arrays(path, {"rows": ArrayField(("step", 7), "float32")})["rows"]
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        np.testing.assert_array_equal(found, rows.astype(np.float32))
        assert peak < 1.5 * found.nbytes


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"maze": MAZE.astype(complex)}, "maze must hold integers, found complex128"),
        ({"maze": MAZE.astype("m8[s]")}, "maze must hold integers, found timedelta64[s]"),
        ({"maze": MAZE.astype("U3")}, "maze must hold integers, found <U3"),
        ({"maze": MAZE / 2}, "maze must hold integers, found float64"),
        ({"maze": np.array([None])}, "maze must hold integers, found object"),
        ({"maze": MAZE * 10**12}, "maze holds 1e+12 at task 0, must be from -2147483648 to "),
        ({"goal": GOAL * np.nan}, "goal holds NaN at task 0, must be from -1e+18 to 1e+18"),
        ({"goal": [[0, 0], [np.inf, 0]]}, "goal holds infinity at task 1"),
        ({"goal": [[0, 0], [0, 1e38]]}, "goal holds 1e+38 at task 1"),
        ({"goal": GOAL[:1]}, "goal has shape [1, 2], wanted [task 2, 2]"),
        ({"goal": 1.0}, "goal has shape [], wanted [task 2, 2]"),
        ({"maze": MAZE[:, :2]}, "maze has shape [2, 2, 3], wanted [task 2, 3, 3]"),
    ],
)
def test_numbers_and_shapes_that_do_not_fit(path: Path, changes: Any, says: str) -> None:
    np.savez(path, **{"maze": MAZE, "goal": GOAL, **changes})
    assert f"{path}: {says}" in refused(path)


CLAIMS = {
    "terabytes": npy(shape="(1000000000000, 3, 3)"),
    "more than there is": npy(shape="(3, 3, 3)"),
    "less than there is": npy(shape="(1, 3, 3)"),
    "cut": npy(data=bytes(100)),
}
DAMAGED = {
    "no array": b"hello",
    "nothing": b"",
    "nested": header("(" * 500 + ")" * 500),
    "nested further": header("{'descr': " + "[" * 3000),
    "a program": header("__import__('os').system('exit')"),
    "negative": npy(shape="(-1, 3, 3)"),
    "true": npy(shape="(True, 3, 3)"),
    "astronomic": npy(shape=f"({'9' * 3000}, 3, 3)"),
    "no dtype": npy("'x9'"),
    "records": npy("[('a', '<i8')]"),
    "no list": header("{'descr': '<i8', 'fortran_order': 0, 'shape': 3}"),
}


@pytest.mark.parametrize("name", CLAIMS)
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_claims_are_compared_with_the_file(path: Path, name: str, method: int) -> None:
    packed(path, CLAIMS[name], method)
    assert f"{path}: maze declares shape [" in refused(path)


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_members_are_named(path: Path, name: str) -> None:
    packed(path, DAMAGED[name])
    assert "T.npz is not a readable npz file: maze " in refused(path)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compression(path: Path, method: int) -> None:
    packed(path, npy(), method)
    assert "maze has the unknown compression method" in refused(path)


def test_two_members_of_one_name(path: Path) -> None:
    packed(path, npy(), times=2)
    assert "maze occurs twice" in refused(path)


def test_encrypted_members(path: Path) -> None:
    packed(path, npy())
    content = bytearray(path.read_bytes())
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(mark) + offset] |= 1
    path.write_bytes(content)
    assert "maze is encrypted" in refused(path)


def test_bombs_are_not_unpacked(path: Path) -> None:
    np.savez_compressed(path, rows=np.zeros(1 << 30, np.uint8))
    with pytest.raises(DataError, match="declares 1024 MB of arrays in a file of 0 MB"):
        read_arrays(path, {"rows": ArrayField(("step",), "integers")})


def test_an_array_of_an_expected_size_is_no_bomb(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames in which nearly nothing happens deflate to less than a hundredth."""
    monkeypatch.setattr("mgpo_jax.archives.FREE", 1 << 20)
    frames = np.zeros((800, 84, 84), np.uint8)
    frames[:, 5, 5] = 7
    write_arrays(path, {"obs": frames})
    assert path.stat().st_size * 100 < frames.nbytes
    fields = {"obs": ArrayField(("step", 84, 84), "uint8")}
    for sizes in (None, {"step": range(1, 2**31)}):
        with pytest.raises(DataError, match="declares 5 MB of arrays in a file of"):
            read_arrays(path, fields, sizes)
    with pytest.raises(DataError, match=r"wanted \[step 799, 84, 84\]"):
        read_arrays(path, fields, {"step": 799})
    found = read_arrays(path, fields, {"step": 800})["obs"]
    assert np.array_equal(found, frames)


def test_any_value(path: Path) -> None:
    """Also one that does not fit into the dtype of the field."""
    np.savez(path, goal=[[np.nan, -np.inf], [0, 1e300]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        field = ArrayField(("task", 2), "float32", any_value=True)
        found = read_arrays(path, {"goal": field})["goal"]
    np.testing.assert_array_equal(found, np.float32([[np.nan, -np.inf], [0, np.inf]]))


@pytest.mark.parametrize("content", [b"", b"no", b"\x93NUMPY", b"PK\x03\x04" + bytes(40)])
def test_what_is_no_npz(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    assert refused(path) == f"{path} is not a readable npz file; make it again"


def test_any_flipped_bit_is_seen_or_harmless(path: Path) -> None:
    np.savez_compressed(path, maze=MAZE, goal=GOAL)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for index, bit in zip(
        rng.integers(len(whole), size=400), rng.integers(8, size=400), strict=True
    ):
        content = bytearray(whole)
        content[index] ^= 1 << bit
        path.write_bytes(content)
        with suppress(DataError):
            found = read_arrays(path, FIELDS)
            np.testing.assert_array_equal(found["maze"], MAZE)
            np.testing.assert_array_equal(found["goal"], GOAL)


def test_missing_and_foreign_arrays(path: Path) -> None:
    assert refused(path.with_name("none.npz")).startswith(
        f"{path.with_name('none.npz')} is missing"
    )
    np.savez(path, maze=MAZE, more=np.array([{}]))
    assert f"{path} lacks goal" in refused(path)
    np.savez(path, maze=MAZE, goal=GOAL, more=np.array([{}]))
    assert "more" not in read_arrays(path, FIELDS)
    assert " has the unexpected array more" in refused(path, only=True)


def test_sizes_that_are_known(path: Path) -> None:
    assert "wanted [task 5, 3, 3]" in refused(path, sizes={"task": 5})
    assert "wanted [task 3 to 9, 3, 3]" in refused(path, sizes={"task": range(3, 10)})
    assert read_arrays(path, FIELDS, {"task": range(1, 3)}).keys() == FIELDS.keys()


def test_arrays_in_memory_are_checked_alike() -> None:
    found = fitted_arrays({"maze": MAZE, "goal": GOAL, "more": GOAL}, FIELDS, "here")
    assert [found[name].dtype for name in FIELDS] == [np.int32, np.float32]
    with pytest.raises(DataError, match=r"^here: goal holds NaN at task 0, .*; again$"):
        fitted_arrays({"maze": MAZE, "goal": GOAL * np.nan}, FIELDS, "here", mend="again")


@dataclass(frozen=True)
class Sizes:
    __pydantic_config__ = STRICT

    width: Annotated[int, Ge(1)] = 1
    rest: tuple[float, ...] = ()


class Document(BaseModel):
    model_config = STRICT

    name: str
    sizes: Sizes
    notes: dict[str, Json] = {}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[" * 5000, " is not readable JSON"),
        ('{"name": "x", "sizes": ' + "[" * 5000, " is not readable JSON"),
        ("", " is not readable JSON"),
        ("\0", " is not readable JSON"),
        ("[]", " does not hold a JSON object"),
        ("null", " does not hold a JSON object"),
        ("3", " does not hold a JSON object"),
        ("{}", " lacks name"),
        ('{"name": "x", "sizes": {}, "more": 1}', " has the unknown entry more"),
        ('{"name": null, "sizes": {}}', ": name must be text, found None"),
        ('{"name": "x", "sizes": 7}', ": sizes must be an object, found 7"),
        ('{"name": "x", "sizes": {"width": true}}', ": sizes.width must be an integer, found True"),
        ('{"name": "x", "sizes": {"width": 1.0}}', ": sizes.width must be an integer, found 1.0"),
        ('{"name": "x", "sizes": {"width": 0}}', ": sizes.width must be at least 1, found 0"),
        ('{"name": "x", "sizes": {"rest": [NaN]}}', ": sizes.rest.0 must be a finite number"),
        ('{"name": "x", "sizes": {"rest": [1e400]}}', ": sizes.rest.0 must be a finite number"),
        ('{"name": "x", "sizes": {}, "notes": {"a": [NaN]}}', ": notes.a must be a finite number"),
        ('{"name": "x", "sizes": {"width": 1' + "0" * 400 + "x}}", " is not readable JSON"),
    ],
)
def test_documents_that_differ_from_their_schema(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "D.json"
    path.write_text(text)
    with pytest.raises(DataError) as caught:
        read_document(path, Document, "make it again")
    message = str(caught.value)
    assert message.startswith(f"{path}{says}")
    assert message.endswith("; make it again")
    assert "\n" not in message


def test_documents_come_back(tmp_path: Path) -> None:
    path = tmp_path / "D.json"
    path.write_text('{"name": "x", "sizes": {"width": 10, "rest": [1, 2.5]}}')
    assert read_document(path, Document).sizes == Sizes(10, (1.0, 2.5))
    assert checked_entry({"width": 3}, Sizes, path, "network") == Sizes(3)
    with pytest.raises(DataError, match=r"D\.json: network\.width must be at least 1, found -3$"):
        checked_entry({"width": -3}, Sizes, path, "network")
    path.write_text('{"width": 3}\n{"width": 0}\n')
    with pytest.raises(DataError, match=r"D\.json, line 2: width must be at least 1, found 0; x"):
        read_json_lines(path, Sizes, "x")


def test_names_in_files_import_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A place is accepted once a user has named it, under its place and under the record's name."""
    (tmp_path / "mine_only.py").write_text(
        "from envs.registry import World\nWORLD = World(name='mine_only_world', make=lambda: None)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(WORLDS, "_loaded", dict(WORLDS._loaded))
    with pytest.raises(
        DataError, match=r"^F names the world 'mine_only:WORLD'.* --env mine_only:W"
    ):
        WORLDS.known("mine_only:WORLD", "F", "--env")
    unknown = r"^F: unknown world 'mine_only_world' .*; give its place with --env"
    with pytest.raises(DataError, match=unknown):
        WORLDS.known("mine_only_world", "F", "--env")
    world = WORLDS.find("mine_only:WORLD")
    assert WORLDS.known("mine_only:WORLD", "F", "--env") is world
    assert WORLDS.known("mine_only_world", "F", "--env") is world
    assert WORLDS.known("maze15", "F", "--env").name == "maze15"
