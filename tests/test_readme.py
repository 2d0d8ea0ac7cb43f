"""The README's Python example runs as printed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = Path(__file__).parent.parent / "README.md"


@pytest.mark.slow
def test_python_blocks_run() -> None:
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, str(README), "exec"), {})


def test_the_versions_of_jax_are_those_that_were_tried() -> None:
    """CONTRIBUTING.md has what ``.ci/versions`` found last."""
    tried = re.findall(
        r"[Ww]ith jax (\d+\.\d+\.\d+)", (README.parent / "CONTRIBUTING.md").read_text()
    )
    assert len(tried) == 2
    install = " ".join((README.parent / "docs/install.md").read_text().split())
    assert "versions that were tried are {} and {} (on".format(*tried) in " ".join(
        README.read_text().split()
    )
    for version in tried:
        assert f"jax {version}," in install


def test_every_linked_file_exists() -> None:
    links = re.findall(r"\]\(([^)#]+)\)|src=\"([^\"]+)\"", README.read_text())
    for link in {a or b for a, b in links}:
        if not link.startswith("http"):
            assert (README.parent / link).exists(), link
