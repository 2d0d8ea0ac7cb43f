"""Long work that produces a new folder, and that ``--resume`` continues after an interruption.

While ``NAME`` is being made, finished pieces are kept in a folder ``NAME.partial``, in which only one
process may work at a time.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel

from envs.errors import UsageError
from experiments.signals import farewell
from experiments.store.runs import changes, say_what_differs
from mgpo_jax import processes
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
    """Provenance of the process that began the work."""
    resumed: list[Json] = []
    """Provenance of the processes that resumed it."""


class Work(NamedTuple):
    """What a piece of long work needs."""

    place: Path
    """Folder to write the result to."""
    journal: Journal
    """The finished pieces."""
    meta: dict[str, Any]
    """Provenance of the result, for its ``meta.json``."""


@contextmanager
def long_work(
    folder: Path,
    settings: Mapping[str, Any],
    meta: Mapping[str, Any],
    resume: bool,
    wait: bool = False,
    go_on: str = "continue with --resume",
) -> Iterator[Work]:
    """Provide a place to write the result to, and a journal of finished pieces.

    If several processes work together, only process 0 gets the place, and it writes the result.

    Args:
      folder: what the place becomes when the block ends.
      settings: everything that determines the result.
      meta: ``provenance`` of this process.
      resume: whether to continue unfinished work.
      wait: whether to wait for another process that makes the same folder.
      go_on: how to continue after an interruption, for messages.

    Raises:
      DataError: if ``folder`` exists, or another process makes it.
      UsageError: if there is unfinished work, and ``resume`` is not set or the settings differ.
    """
    if not processes.is_first():
        yield Work(Path(), Journal(), {})
        return
    pieces = partial_name(folder) / PIECES
    with new_folder(folder, keep=PIECES, wait=wait) as place:
        if has_work(pieces) and not resume:
            raise UsageError(
                f"{pieces.parent} holds unfinished work; continue it with --resume, or remove it"
            )
        journal, made = open_journal(pieces, settings, meta)
        with farewell(lambda: _farewell(pieces, go_on)):
            yield Work(place, journal, made)


def open_journal(
    pieces: Path, settings: Mapping[str, Any], meta: Mapping[str, Any]
) -> tuple[Journal, dict[str, Any]]:
    """Open the journal of new or unfinished work.

    Args:
      pieces: folder of the journal.
      settings: everything that determines the result.
      meta: ``provenance`` of this process.

    Returns:
      The journal, and the provenance of the whole work for its ``meta.json``.

    Raises:
      UsageError: if unfinished work was begun with other settings.
    """
    begun = _Begun(settings=to_json(settings), meta=to_json(meta))
    if has_work(pieces):
        mend = f"remove {pieces} and start again"
        saved: _Begun = read_document(pieces / SETTINGS, _Begun, mend)
        if changed := changes(saved.settings, begun.settings):
            raise UsageError(
                f"{pieces} was begun with other settings: {changed}; give the same ones, or remove it"
            )
        say_what_differs(saved.meta, begun.meta, str(pieces))
        print(f"continuing the unfinished work in {pieces}", file=sys.stderr)
        begun = saved.model_copy(update={"resumed": [*saved.resumed, begun.meta]})
    journal = Journal(pieces)
    write_json(pieces / SETTINGS, begun.model_dump())
    made = {**begun.meta, "settings": begun.settings}
    return journal, {**made, "resumed": begun.resumed} if begun.resumed else made


def _farewell(pieces: Path, go_on: str) -> str:
    if has_work(pieces):
        return f"stopped; finished work is kept in {pieces.parent}; {go_on}"
    return "stopped before anything was finished; nothing was written"
