"""Arrays in files that grow row by row."""

from __future__ import annotations

from pathlib import Path

import numpy as np

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
