"""Damage to JSON files: entries missing, null, of another type, huge or nested; malformed documents.

The grammar walks through the sound document, so new entries are covered automatically. ``JsonTraits`` says
which damage to which entries a command must refuse.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from .cases import Damage, Expected, pick, written
from .grammar_files import file_damage

Place = tuple[str | int, ...]

ESCAPED = "/tmp/fuzz-escaped"
"""A path outside of all folders that a case may write to."""

NAMES = (
    "", "../../x", ESCAPED, "..", ".", "\x1b[31mred", "a\nb", "maze15\n", "a|b", r"$\frac{$", "x" * 300,
    "trap:WORLD", "antigravity:x", "os:system", "maze51", "\u202egnp", "\x00", "%s%n", "{0.__class__}",
)  # fmt: skip
"""Texts that do not name anything valid; ``trap`` is a module in the current folder."""

WRONG: dict[type, tuple[Any, ...]] = {
    bool: (None, "true", 1, [], {}, 0.5),
    int: (None, "1", "x", [], [1], {}, True, 2.5, float("nan"), float("inf")),
    float: (None, "1.0", [], [1.0], {}, True, float("nan"), float("inf"), float("-inf")),
    str: (None, 1, 2.5, [], ["maze15"], {}, True),
    list: (None, "x", 1, {}, True, [None], [[]], ["x"], [{}]),
    dict: (None, "x", 1, [], True, [[]]),
    type(None): ([], {}, [[]]),
}
"""Values of the wrong type, by the type of the sound one."""

OUT_OF_RANGE = (0, -1, 10**400, 10**12, 2**63)


@dataclass(frozen=True)
class JsonTraits:
    """What a command must refuse in one file, as patterns of dotted names, such as ``network.*``."""

    checked: Sequence[str] = ("*",)
    """Entries whose type must be right; others may have a wrong type."""
    required: Sequence[str] = ()
    """Entries that must not be missing."""
    positive: Sequence[str] = ()
    """Numbers that must be at least 1 and small."""
    shares: Sequence[str] = ()
    """Numbers that must be from 0 to 1."""
    names: Sequence[str] = ()
    """Texts that must be a known name."""
    closed: Sequence[str] = ()
    """Objects that must not have further entries; the document itself is ``.``."""
    nullable: Sequence[str] = ()
    """Entries that may be null or absent."""
    texts: Sequence[str] = ()
    """Entries that may be any text."""
    document: Expected = "refused"
    """How a command must treat a document that is damaged as a whole."""


def dotted(place: Place) -> str:
    return ".".join(map(str, place)) or "."


def _fits(place: Place, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(dotted(place), pattern) for pattern in patterns)


def _preferred(rng: np.random.Generator, found: Sequence[Place], patterns: Sequence[str]) -> Place:
    """Draw one of some places, preferably one that matches the patterns."""
    fitting = [place for place in found if _fits(place, patterns)]
    return pick(rng, fitting if fitting and rng.random() < 0.85 else found)


def places(document: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """All entries of a document, with their places."""
    inside: Any = ()
    if isinstance(document, dict):
        inside = document.items()
    elif isinstance(document, list):
        inside = list(enumerate(document))[:2]
    for name, value in inside:
        yield (*place, name), value
        yield from places(value, (*place, name))


def changed(document: Any, place: Place, value: Any) -> Any:
    """A copy of the document with another value at a place."""
    document = copy.deepcopy(document)
    inner = document
    for name in place[:-1]:
        inner = inner[name]
    inner[place[-1]] = value
    return document


def without(document: Any, place: Place) -> Any:
    """A copy of the document without the entry at a place."""
    document = copy.deepcopy(document)
    inner = document
    for name in place[:-1]:
        inner = inner[name]
    del inner[place[-1]]
    return document


def short(value: Any) -> str:
    """A value as short text for the report."""
    if isinstance(value, int) and abs(value) > 10**30:
        return "10**400"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:50]}.. ({len(text)} letters)"


def _put(document: Any, place: Place, value: Any, expected: Expected) -> Damage:
    data = json.dumps(changed(document, place, value)).encode()
    return Damage(f"{dotted(place)} is {short(value)}", expected, written(data))


def _wrong_type(rng: np.random.Generator, document: Any, traits: JsonTraits) -> Damage:
    found = list(places(document))
    place = _preferred(rng, [place for place, _ in found], traits.checked)
    value = next(value for other, value in found if other == place)
    wrong = pick(rng, WRONG[type(value)])
    refused = _fits(place, traits.checked)
    refused &= not (wrong is None and _fits(place, traits.nullable))
    refused &= not (isinstance(wrong, str) and _fits(place, traits.texts))
    return _put(document, place, wrong, "refused" if refused else "either")


def _missing(rng: np.random.Generator, document: Any, traits: JsonTraits) -> Damage:
    inner = [place for place, _ in places(document) if isinstance(place[-1], str)]
    place = _preferred(rng, inner, traits.required)
    expected: Expected = "refused" if _fits(place, traits.required) else "either"
    data = json.dumps(without(document, place)).encode()
    return Damage(f"{dotted(place)} is missing", expected, written(data))


def _number(rng: np.random.Generator, document: Any, traits: JsonTraits) -> Damage:
    numbers = [p for p, v in places(document) if type(v) in (int, float)]
    ranged = (*traits.positive, *traits.shares)
    if not numbers:
        return _wrong_type(rng, document, traits)
    place = _preferred(rng, numbers, ranged)
    value = pick(rng, OUT_OF_RANGE)
    fine = value == 0 and _fits(place, traits.shares)
    expected: Expected = "refused" if _fits(place, ranged) and not fine else "either"
    return _put(document, place, value, expected)


def _name(rng: np.random.Generator, document: Any, traits: JsonTraits) -> Damage:
    texts = [p for p, v in places(document) if isinstance(v, str) or v is None]
    if not texts:
        return _wrong_type(rng, document, traits)
    place = _preferred(rng, texts, traits.names)
    expected: Expected = "refused" if _fits(place, traits.names) else "either"
    return _put(document, place, pick(rng, NAMES), expected)


def _unknown(rng: np.random.Generator, document: Any, traits: JsonTraits) -> Damage:
    objects: list[Place] = [p for p, v in places(document) if isinstance(v, dict)]
    place = _preferred(rng, [(), *objects], traits.closed)
    expected: Expected = "refused" if _fits(place, traits.closed) else "either"
    name = pick(rng, ("surplus", "", "../x", "\x1b[31m", "__class__"))
    damage = _put(document, (*place, name), 1, expected)
    return Damage(f"{dotted(place)} has the unknown entry {name!r}", expected, damage.do)


def _document(rng: np.random.Generator, document: Any, traits: JsonTraits) -> Damage:
    text = json.dumps(document)
    some = next(iter(document))
    deep = "[" * 5_000 + "]" * 5_000
    documents = {
        "a list": json.dumps([document]),
        "null": "null",
        "a number": "1",
        "a text": json.dumps("x"),
        "an empty object": "{}",
        "nested 5,000 deep": deep,
        "an entry nested 5,000 deep": json.dumps(changed(document, (some,), 0)).replace(
            "0", deep, 1
        ),
        "with a byte that is no UTF-8": text[:-1] + "\udcff" + text[-1],
        "in UTF-16": None,
        "followed by more": text + text,
        "with a comma at its end": text[:-1] + ",}",
        "in single quotes": str(document),
        "lacking its end": text[:-1],
    }
    what = pick(rng, list(documents))
    body = documents[what]
    data = text.encode("utf-16") if body is None else body.encode("utf-8", "surrogateescape")
    return Damage(what, traits.document, written(data))


def _odd(rng: np.random.Generator, document: Any, traits: JsonTraits) -> Damage:
    """Documents that a reader may accept or refuse, but must survive."""
    text = json.dumps(document)
    some = next(iter(document))
    odd = {
        f"{some} twice": text[:-1] + f", {json.dumps(some)}: {json.dumps(document[some])}}}",
        "with a byte order mark": "\ufeff" + text,
        "after 17 MB of blanks": " " * (17 << 20) + text,
    }
    what = pick(rng, list(odd))
    return Damage(what, "either", written(odd[what].encode()))


def _whole(rng: np.random.Generator, document: Any, traits: JsonTraits) -> Damage:
    damage = file_damage(rng, json.dumps(document, indent=2).encode())
    expected = damage.expected if traits.document == "refused" else traits.document
    return Damage(damage.text, expected, damage.do, damage.codes)


WAYS = (
    (_wrong_type, 6),
    (_missing, 3),
    (_number, 3),
    (_name, 3),
    (_unknown, 1),
    (_document, 2),
    (_odd, 1),
    (_whole, 2),
)


def json_damage(rng: np.random.Generator, document: Any, traits: JsonTraits) -> Damage:
    """Random damage to the file of a JSON object."""
    ways = [way for way, weight in WAYS for _ in range(weight)]
    return pick(rng, ways)(rng, document, traits)


def json_variant(rng: np.random.Generator, document: Any) -> Damage:
    """Another spelling of the same document."""

    def backwards(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: backwards(value[name]) for name in reversed(value)}
        return value

    spellings = {
        "its entries in another order": json.dumps(backwards(document)),
        "on one line without blanks": json.dumps(document, separators=(",", ":")),
        "indented by tabs, lines ended as on Windows": json.dumps(document, indent="\t").replace(
            "\n", "\r\n"
        ),
        "all letters escaped": "".join(json.dumps(document, ensure_ascii=True)),
    }
    what = pick(rng, list(spellings))
    return Damage(what, "accepted", written(spellings[what].encode()))
