"""Long work towards a new folder: what is finished is kept, and a killed command goes on with ``--resume``.

While ``NAME`` is being made there is a folder ``NAME.partial`` with the finished pieces, which only one
process may work in.
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
    """Of the process that began it."""
    resumed: list[Json] = []
    """Of those that went on with it."""


class Work(NamedTuple):
    """What long work needs."""

    place: Path
    """Where to write the result."""
    journal: Journal
    """Where finished pieces are kept."""
    meta: dict[str, Any]
    """How and with what the result is made, for its ``meta.json``."""


@contextmanager
def long_work(
    folder: Path,
    settings: Mapping[str, Any],
    meta: Mapping[str, Any],
    resume: bool,
    wait: bool = False,
    go_on: str = "continue with --resume",
) -> Iterator[Work]:
    """A place to write the result to, and a journal of finished pieces.

    Of several processes that work together only process 0 has the place, where it writes the result.

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
    """The journal of work that is begun, or of unfinished work, and how and with what all of it is made.

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
        print(f"going on with the unfinished work in {pieces}", file=sys.stderr)
        begun = saved.model_copy(update={"resumed": [*saved.resumed, begun.meta]})
    journal = Journal(pieces)
    write_json(pieces / SETTINGS, begun.model_dump())
    made = {**begun.meta, "settings": begun.settings}
    return journal, {**made, "resumed": begun.resumed} if begun.resumed else made


def _farewell(pieces: Path, go_on: str) -> str:
    if has_work(pieces):
        return f"stopped; what is finished is in {pieces.parent}, {go_on}"
    return "stopped before anything was finished; nothing was written"
