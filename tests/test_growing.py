"""Arrays in files that grow row by row."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mgpo_jax.growing import GrowingFiles


def test_rows_are_appended_to_files_that_numpy_reads(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pieces = [
        {
            "obs": rng.normal(size=(num, 2, 3)).astype(np.float32),
            "good": rng.integers(2, size=num) > 0,
        }
        for num in (1, 0, 1000, 7)
    ]
    files = GrowingFiles(tmp_path)
    for piece in pieces:
        files.append(piece)
    paths = files.finish()
    assert paths == {name: tmp_path / f"{name}.npy" for name in ("obs", "good")}
    for name, path in paths.items():
        whole = np.concatenate([piece[name] for piece in pieces])
        read = np.load(path)
        assert read.dtype == whole.dtype
        np.testing.assert_array_equal(read, whole)


def test_slices_and_other_memory_orders_are_written_by_rows(tmp_path: Path) -> None:
    table = np.arange(12.0).reshape(3, 4)
    files = GrowingFiles(tmp_path)
    files.append({"x": table.T[:, ::2]})
    files.finish()
    np.testing.assert_array_equal(np.load(tmp_path / "x.npy"), table.T[:, ::2])


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        (
            {"x": np.zeros((2, 3))},
            r"rows of float64\[3\] do not fit into .*x.npy, which has float32\[3\]",
        ),
        ({"x": np.zeros((2, 4), np.float32)}, r"rows of float32\[4\] do not fit"),
        ({"x": np.zeros((2, 3), np.float32), "y": np.zeros(2)}, r"arrays \['x', 'y'\] do not fit"),
        ({}, r"arrays \[\] do not fit the files \['x'\]"),
    ],
)
def test_other_rows_are_refused(tmp_path: Path, arrays: dict[str, np.ndarray], says: str) -> None:
    """Written as bytes, they would be read as other numbers."""
    with GrowingFiles(tmp_path) as files:
        files.append({"x": np.ones((1, 3), np.float32)})
        with pytest.raises(ValueError, match=says):
            files.append(arrays)


def test_files_are_closed_when_the_work_fails(tmp_path: Path) -> None:
    files = GrowingFiles(tmp_path)

    def work() -> None:
        with files:
            files.append({"x": np.ones(3)})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert all(file.file.closed for file in files.files.values())
