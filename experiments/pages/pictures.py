"""Pictures and videos in a page, within it, as far as there is room for them."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict

from envs.errors import UsageError

PICTURES = {".gif": b"GIF8", ".png": b"\x89PNG"}
"""The pictures that a page can show: their suffixes, and the first bytes of their files."""


class Picture(TypedDict):
    """A picture or a video as data for a page."""

    name: str
    source: str
    """Its content, as an address of the scheme ``data``."""


def read_picture(path: Path, most_bytes: float = math.inf) -> Picture:
    """A picture or a video as data for a page.

    Args:
      path: its file.
      most_bytes: the size that a page may have.

    Raises:
      UsageError: if it is not a GIF or PNG, or larger than a page may be.
    """
    begins = PICTURES.get(path.suffix)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UsageError(f"the picture {path} cannot be read: {error.strerror}") from None
    if begins is None or not content.startswith(begins):
        raise UsageError(
            f"{path} is not a picture that a page can show; those are GIF and PNG files"
        )
    source = f"data:image/{path.suffix[1:]};base64,{base64.b64encode(content).decode()}"
    if len(source) > most_bytes:
        raise UsageError(
            f"{path} has {len(source) / 1e6:.1f} MB as text in a page, which has {most_bytes / 1e6:.0f} MB "
            "at most; draw fewer tasks or a shorter video"
        )
    return {"name": path.stem.replace("_", " "), "source": source}


def those_with_room(pictures: Sequence[Picture], room: int) -> tuple[list[Picture], list[str]]:
    """The pictures that fit into some bytes, the first ones first, and the names of the others.

    Each may need room for its name in a note instead.
    """
    kept, others = [], []
    room -= sum(len(json.dumps(picture["name"])) + 2 for picture in pictures)
    for picture in pictures:
        size = len(picture["source"]) + len(json.dumps(picture["name"])) + 64  # as JSON
        if size <= room:
            kept.append(picture)
            room -= size
        else:
            others.append(picture["name"])
    return kept, others
