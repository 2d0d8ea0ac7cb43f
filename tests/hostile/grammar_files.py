"""Damage to any file, whatever its content: cut, empty, with flipped bits, or not a regular file."""

from __future__ import annotations

import gzip
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .cases import BOTH, DATA, Damage, pick, written

PNG = b"\x89PNG\r\n\x1a\n" + bytes(64)


def _replaced(make: Callable[[Path], None]) -> Callable[[Path], None]:
    def do(path: Path) -> None:
        path.unlink()
        make(path)

    return do


def _nothing(path: Path) -> None:
    """Leave the file missing."""


PLACES: dict[str, Callable[[Path], None]] = {
    "missing": _nothing,
    "a folder": Path.mkdir,
    "a named pipe": os.mkfifo,
    "a dangling link": lambda path: path.symlink_to("nowhere"),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "a link to /dev/null": lambda path: path.symlink_to("/dev/null"),
}
"""What to put in the place of a file."""


def file_damage(rng: np.random.Generator, data: bytes) -> Damage:
    """Damage that every reader of this file must refuse, or at least survive."""
    cut = int(rng.integers(1, len(data))) if len(data) > 1 else 0
    contents = {
        "empty": b"",
        f"cut to {cut} of {len(data)} bytes": data[:cut],
        "of zero bytes only": bytes(len(data)),
        "a picture": PNG,
        "compressed by gzip": gzip.compress(data, mtime=0),
        "random bytes": rng.bytes(200),
    }
    names = [*contents, *PLACES, "flipped"]
    what = pick(rng, names)
    if what == "flipped":
        flipped = bytearray(data)
        where = int(rng.integers(len(data)))
        flipped[where] ^= 1 << int(rng.integers(8))
        return Damage(f"one bit flipped in byte {where}", "either", written(bytes(flipped)))
    if what in PLACES:
        return Damage(what, "refused", _replaced(PLACES[what]), BOTH)
    return Damage(what, "refused", written(contents[what]), DATA)
