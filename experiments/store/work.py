"""Long work towards a new folder: what is finished is kept, and a killed command goes on with ``--resume``.

While ``NAME`` is being made there is a folder ``NAME.partial`` with the finished pieces, which only one
process may work in.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from envs.errors import UsageError
from experiments.signals import farewell
from experiments.store.runs import changes, say_what_differs
from mgpo_jax.files import has_work, new_folder, partial_name, to_json, write_json
from mgpo_jax.journal import Journal
from mgpo_jax.schema import STRICT, Json, read_document

PIECES = "progress"
SETTINGS = "settings.json"


class _Begun(BaseModel):
    """``settings.json`` of unfinished work."""

    model_config = STRICT

    settings: dict[str, Json]
    meta: dict[str, Json]


@contextmanager
def long_work(
    folder: Path,
    settings: Mapping[str, Any],
    meta: Mapping[str, Any],
    resume: bool,
    wait: bool = False,
    go_on: str = "continue with --resume",
) -> Iterator[tuple[Path, Journal]]:
    """A place to write the result to, and a journal of finished pieces.

    Args:
      folder: what the place becomes when the block ends.
      settings: everything that decides about the result.
      meta: how and with what this process works, of ``provenance``.
      resume: whether to go on with what a stopped process has finished.
      wait: wait for another process that makes the same folder.
      go_on: what continues the work after a stop, for messages.

    Raises:
      DataError: if ``folder`` exists, or another process makes it.
      UsageError: if there is unfinished work that ``resume`` does not ask for, or it is of other settings.
    """
    pieces = partial_name(folder) / PIECES
    with new_folder(folder, keep=PIECES, wait=wait) as place:
        if has_work(pieces):
            if not resume:
                raise UsageError(
                    f"{pieces.parent} holds unfinished work; continue it with --resume, or remove it"
                )
            _check_same(pieces, settings, meta)
            print(f"going on with the unfinished work in {pieces.parent}", file=sys.stderr)
        journal = Journal(pieces)
        write_json(pieces / SETTINGS, {"settings": settings, "meta": meta})
        with farewell(lambda: _farewell(pieces, go_on)):
            yield place, journal


def _check_same(pieces: Path, settings: Mapping[str, Any], meta: Mapping[str, Any]) -> None:
    """Raise ``UsageError`` if unfinished work was begun with other settings."""
    mend = f"remove {pieces.parent} and start again"
    saved: _Begun = read_document(pieces / SETTINGS, _Begun, mend)
    if changed := changes(saved.settings, to_json(settings)):
        raise UsageError(
            f"{pieces.parent} was begun with other settings: {changed}; give the same ones, or remove it"
        )
    say_what_differs(saved.meta, dict(meta), str(pieces.parent))


def _farewell(pieces: Path, go_on: str) -> str:
    if has_work(pieces):
        return f"stopped; what is finished is in {pieces.parent}, {go_on}"
    return "stopped before anything was finished; nothing was written"
