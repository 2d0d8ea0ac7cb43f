"""What is written appears whole or not at all."""

from __future__ import annotations

import pytest

from envs.errors import DataError
from mgpo_jax.files import new_folder


def test_a_folder_appears_when_it_is_complete(tmp_path):
    folder = tmp_path / "deep" / "folder"
    with new_folder(folder) as partial:
        (partial / "file").write_text("content")
        assert not folder.exists()
    assert [path.name for path in folder.parent.iterdir()] == ["folder"]
    assert (folder / "file").read_text() == "content"


def test_a_failure_leaves_no_folder(tmp_path):
    with pytest.raises(ZeroDivisionError), new_folder(tmp_path / "folder"):
        raise ZeroDivisionError
    assert not (tmp_path / "folder").exists()


def test_an_existing_folder_is_kept(tmp_path):
    with pytest.raises(DataError, match="exists already; remove it"), new_folder(tmp_path):
        raise AssertionError("not reached")
    assert tmp_path.is_dir()
