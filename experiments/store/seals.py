"""Seals of output files, so that commands only replace files that they wrote and nobody has changed.

A seal is a comment in the file with the hash of everything else in it. A file without a seal, or with a
seal that does not match its content, belongs to the user and is never overwritten.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

from envs.errors import UsageError
from experiments.runtime import require_parent
from mgpo_jax.claims import check_place
from mgpo_jax.files import written

_LABEL = "mgpo_jax, sha256 of the rest: "


def _note(content: bytes) -> bytes:
    return (_LABEL + hashlib.sha256(content).hexdigest()).encode()


def _comment(content: bytes) -> tuple[bytes, bytes]:
    return b"\n<!-- " + _note(content) + b" -->\n", b""


def _png(content: bytes) -> tuple[bytes, bytes]:
    """A text chunk, to insert before the last chunk, which always has 12 bytes."""
    chunk = b"tEXt" + b"Comment\0" + _note(content)
    size, check = struct.pack(">I", len(chunk) - 4), struct.pack(">I", zlib.crc32(chunk))
    return size + chunk + check, content[-12:]


def _gif(content: bytes) -> tuple[bytes, bytes]:
    """A comment, to insert before the last byte, which ends a GIF."""
    note = _note(content)
    return b"\x21\xfe" + bytes([len(note)]) + note + b"\0", content[-1:]


_SEALS: dict[str, Callable[[bytes], tuple[bytes, bytes]]] = {
    ".md": _comment,
    ".html": _comment,
    ".png": _png,
    ".gif": _gif,
}
"""By suffix: a function that returns the seal of a content, and the part of the content that must follow
it."""


def sealed(content: bytes, suffix: str) -> bytes:
    """The content of a file with its seal inserted."""
    seal, end = _SEALS[suffix](content)
    return content[: len(content) - len(end)] + seal + end


def is_sealed(content: bytes, suffix: str) -> bool:
    """Whether the content of a file has a valid seal, and so is unchanged since a command wrote it."""
    seal, end = _SEALS[suffix](content)
    at = len(content) - len(end) - len(seal)  # all seals of a suffix have the same length
    return at >= 0 and sealed(content[:at] + end, suffix) == content


def is_foreign(path: Path) -> bool:
    """Whether a path exists and is not a file with a valid seal."""
    return os.path.lexists(path) and not _is_ours(path)


def check_replaceable(paths: Iterable[Path], *ways_out: str) -> None:
    """Raise ``UsageError``, with the ways out in the message, if writing would replace foreign files."""
    foreign = [str(path) for path in paths if is_foreign(path)]
    if foreign:
        more = f" and {len(foreign) - 3} more" if len(foreign) > 3 else ""
        raise UsageError(
            f"{', '.join(foreign[:3])}{more} would be overwritten, but was not written by this command or "
            f"was changed since; {', or '.join(('move it away', *ways_out))}"
        )


def check_page(out: Path) -> None:
    """Raise ``UsageError`` if a page cannot be written to a file, or would overwrite a foreign file."""
    require_parent(out, "--out")
    if not os.path.lexists(out):
        check_place(out)
    if out.suffix != ".html":
        raise UsageError(f"--out {out} must end in .html")
    check_replaceable([out], "choose another file with --out")


def _is_ours(path: Path) -> bool:
    return path.is_file() and not path.is_symlink() and is_sealed(path.read_bytes(), path.suffix)


def write_sealed(path: Path, save: Callable[[Path], object]) -> None:
    """Write a file with ``save`` and seal it; the file is replaced atomically."""
    with written(path) as partial:
        save(partial)
        partial.write_bytes(sealed(partial.read_bytes(), path.suffix))
