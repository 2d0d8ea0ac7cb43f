"""Damage to npz files: arrays missing, of another kind, shape or size; odd or lying zip files.

The grammar walks through the arrays of the sound file, so new arrays are covered automatically.
``NpzTraits`` says which damage to which arrays a command must refuse.
"""

from __future__ import annotations

import io
import lzma
import pickle
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from .cases import Damage, Expected, pick, written
from .grammar_files import file_damage

Arrays = Mapping[str, np.ndarray]
BOMB = 2_000_000_000  # bytes that a small file unpacks to
LOCAL, CENTRAL = b"PK\x03\x04", b"PK\x01\x02"  # signatures of the two records of a zip member


class Trap:
    """An object that creates a file when it is unpickled."""

    def __reduce__(self) -> Any:
        return (open, ("trap_was_here", "w"))


@dataclass(frozen=True)
class NpzTraits:
    """What a command must refuse in one file, as patterns of names of arrays."""

    checked: Sequence[str] = ("*",)
    """Arrays that must be valid; others may be anything that nothing breaks on."""
    required: Sequence[str] = ()
    """Arrays that must not be missing."""
    bounded: Sequence[str] = ()
    """Arrays whose range excludes -1 and the largest number of their dtype."""
    free: Sequence[str] = ()
    """Arrays with numbers that are never read, so that these may be anything."""
    hash_in: tuple[str, str] | None = None
    """The JSON file beside this file, and its entry with the hash of this file."""


def npy(array: np.ndarray, **header: Any) -> bytes:
    """The bytes of an npy file; ``header`` replaces entries of its header."""
    body = io.BytesIO()
    if not header:
        np.save(body, array, allow_pickle=array.dtype.hasobject)
        return body.getvalue()
    described = {"descr": np.lib.format.dtype_to_descr(array.dtype), "fortran_order": False}
    described |= {"shape": array.shape, **header}
    np.lib.format.write_array_header_1_0(body, described)
    return body.getvalue() + array.tobytes()


def npz(members: Mapping[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """The bytes of a zip file, without timestamps."""
    body = io.BytesIO()
    with zipfile.ZipFile(body, "w", method) as file:
        for name, data in members.items():
            info = zipfile.ZipInfo(name)
            info.compress_type = method
            file.writestr(info, data)
    return body.getvalue()


def saved(arrays: Arrays, **others: bytes) -> bytes:
    """The bytes of an npz file; ``others`` replaces the content of some members."""
    members = {name: others.get(name) or npy(array) for name, array in arrays.items()}
    return npz({f"{name}.npy": data for name, data in members.items()})


def _fits(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def _checked(name: str, traits: NpzTraits) -> Expected:
    return "refused" if _fits(name, traits.checked) else "either"


def _some(rng: np.random.Generator, arrays: Arrays, traits: NpzTraits) -> str:
    """Draw the name of an array, preferably one that must be valid."""
    checked = [name for name in arrays if _fits(name, traits.checked)]
    return pick(rng, checked if checked and rng.random() < 0.8 else list(arrays))


def _with(arrays: Arrays, name: str, array: np.ndarray) -> bytes:
    return saved({**arrays, name: array})


def _missing(rng: np.random.Generator, arrays: Arrays, traits: NpzTraits) -> Damage:
    required = [name for name in arrays if _fits(name, traits.required)]
    name = pick(rng, required or list(arrays))
    rest = {other: array for other, array in arrays.items() if other != name}
    expected: Expected = "refused" if required else "either"
    return Damage(f"{name} is missing", expected, written(saved(rest)))


KINDS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "complex": lambda array: array.astype(np.complex64),
    "timedelta": lambda array: array.astype(np.int64).astype("timedelta64[s]"),
    "datetime": lambda array: array.astype(np.int64).astype("datetime64[s]"),
    "text": lambda array: array.astype("U8"),
    "bytes": lambda array: np.full(array.shape, b"x"),
    "void": lambda array: np.zeros(array.shape, "V4"),
    "records": lambda array: np.zeros(array.shape, [("a", "i4"), ("b", "f4")]),
    "objects": lambda array: np.full(array.shape, Trap(), object),
}


def _kind(rng: np.random.Generator, arrays: Arrays, traits: NpzTraits) -> Damage:
    name, kind = _some(rng, arrays, traits), pick(rng, list(KINDS))
    data = _with(arrays, name, KINDS[kind](arrays[name]))
    return Damage(f"{name} holds {kind}", _checked(name, traits), written(data))


SHAPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "one axis more at its end": lambda array: np.stack([array, array], axis=-1),
    "one axis more at its start": lambda array: np.stack([array, array, array]),
    "no axis": lambda array: array.ravel()[0],
    "no rows": lambda array: array[:0],
    "an extra row": lambda array: np.concatenate([array, array[:1]]),
    "one axis": lambda array: array.ravel()[: len(array) + 2],
}


def _shape(rng: np.random.Generator, arrays: Arrays, traits: NpzTraits) -> Damage:
    sizable = {name: array for name, array in arrays.items() if array.ndim and array.size}
    name, shape = _some(rng, sizable, traits), pick(rng, list(SHAPES))
    before = sizable[name]
    after = np.asarray(SHAPES[shape](before))
    expected = _checked(name, traits) if after.shape != before.shape else "accepted"
    return Damage(f"{name} has {shape}", expected, written(_with(arrays, name, after)))


def _number(rng: np.random.Generator, arrays: Arrays, traits: NpzTraits) -> Damage:
    """A number that is not finite, huge, or out of range."""
    name = _some(rng, {n: a for n, a in arrays.items() if a.size and a.dtype != bool}, traits)
    array = np.array(arrays[name])
    bounded = _fits(name, traits.bounded)
    if array.dtype.kind == "f":
        value = pick(rng, (np.nan, np.inf, -np.inf, 1e38, -3e38))
        expected = _checked(name, traits) if bounded or abs(value) != 1e38 else "either"
        expected = expected if bounded or not np.isfinite(value) else "either"
        expected = "either" if _fits(name, traits.free) else expected
    else:
        limits = np.iinfo(array.dtype)
        value = pick(rng, (limits.min, limits.max, max(limits.min, -1)))
        expected = "refused" if bounded and value not in (0,) else "either"
    array.ravel()[int(rng.integers(array.size))] = value
    return Damage(f"{name} holds {value}", expected, written(_with(arrays, name, array)))


def _header(rng: np.random.Generator, arrays: Arrays, traits: NpzTraits) -> Damage:
    name = _some(rng, arrays, traits)
    array = arrays[name]
    sound = npy(array)
    headers = {
        "claims 10**12 rows": npy(array, shape=(10**12, *array.shape[1:])),
        "claims 10**30 rows": npy(array, shape=(10**30,)),
        "claims 20,000,000,000 numbers": npy(array, descr="<f8", shape=(20_000_000_000,)),
        "claims a negative size": npy(array, shape=(-1, *array.shape[1:])),
        "claims fewer rows than there are": npy(array, shape=(1,)),
        "has a dtype of nonsense": npy(array, descr="nonsense"),
        "has a nested dtype": npy(array, descr=[("a", [("b", "<f4", (3,))])]),
        "has 40 axes": npy(array, shape=(1,) * 40),
        "runs code": sound[:10]
        + b"__import__('os').mknod('trap_was_here')".ljust(118)
        + sound[128:],
        "is nested 3,000 deep": sound[:8] + struct.pack("<H", 6_000) + b"[" * 3_000 + b"]" * 3_000,
        "is no UTF-8": sound[:10] + b"\xff" * 118 + sound[128:],
        "is cut": sound[:9],
        "is of version 9": sound[:6] + b"\x09" + sound[7:],
        "claims to be 4 GB long": b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + sound[10:],
        "is no npy header": b"this is no npy file" * 9,
        "is followed by nothing": sound[:128],
        "is that of a pickle": pickle.dumps(Trap()),
    }
    what = pick(rng, list(headers))
    data = saved(arrays, **{name: headers[what]})
    expected = _checked(name, traits)
    return Damage(f"the header of {name} {what}", expected, written(data))


def _patched(data: bytes, offset: int, value: bytes) -> bytes:
    """The zip file with some bytes replaced in both records of its first member."""
    made = bytearray(data)
    for mark, shift in ((LOCAL, 0), (CENTRAL, 2)):
        start = made.index(mark) + offset + shift
        made[start : start + len(value)] = value
    return bytes(made)


def bomb(name: str, array: np.ndarray) -> bytes:
    """A small zip file whose one member is an array of ``BOMB`` bytes."""
    rows = BOMB // max(1, array[:1].nbytes)
    header = npy(array[:0], shape=(rows, *array.shape[1:]))
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    start = packer.compress(header) + packer.flush(zlib.Z_FULL_FLUSH)
    zeros = packer.compress(bytes(1_000_000)) + packer.flush(zlib.Z_FULL_FLUSH)
    packed = start + zeros * (BOMB // 1_000_000) + packer.flush()
    title, size = f"{name}.npy".encode(), BOMB + len(header)
    # version, flags, method, time, date, checksum, packed size, size, lengths of name and extra
    fields = struct.pack("<HHHHHIIIHH", 20, 0, 8, 0, 33, 0, len(packed), size, len(title), 0)
    local = LOCAL + fields + title + packed
    central = (
        CENTRAL + struct.pack("<H", 20) + fields + struct.pack("<HHHII", 0, 0, 0, 0, 0) + title
    )
    end = struct.pack("<IHHHHIIH", 0x06054B50, 0, 0, 1, 1, len(central), len(local), 0)
    return local + central + end


def _zip(rng: np.random.Generator, arrays: Arrays, traits: NpzTraits) -> Damage:
    """A zip file that is odd as a whole, or in its first array."""
    name = _some(rng, {n: a for n, a in arrays.items() if a.ndim}, traits)
    arrays = {name: arrays[name], **arrays}
    sound = saved(arrays)
    damaged_lzma = bytearray(npz({f"{n}.npy": npy(a) for n, a in arrays.items()}, zipfile.ZIP_LZMA))
    start = damaged_lzma.index(name.encode()) + len(name) + 4 + 9
    damaged_lzma[start : start + 8] = bytes(8)
    lone = io.BytesIO()
    np.save(lone, arrays[name])
    zips: dict[str, tuple[Callable[[], bytes], Expected]] = {
        "a damaged LZMA stream": (lambda: bytes(damaged_lzma), "refused"),
        "compression method 9": (lambda: _patched(sound, 8, b"\x09\x00"), "refused"),
        "compression method 99": (lambda: _patched(sound, 8, b"\x63\x00"), "refused"),
        "an encrypted member": (lambda: _patched(sound, 6, b"\x01\x00"), "refused"),
        "zip version 99": (lambda: _patched(sound, 4, b"\x63\x00"), "refused"),
        "a wrong checksum": (lambda: _patched(sound, 14, b"\x00\x00\x00\x00"), "refused"),
        "a member that claims 0 bytes": (lambda: _patched(sound, 22, bytes(4)), "refused"),
        "a member that claims 4 GB": (lambda: _patched(sound, 22, b"\xff\xff\xff\xfe"), "refused"),
        "2 GB of zeros in 2 MB": (lambda: bomb(name, arrays[name]), "refused"),
        "a lone npy file": (lone.getvalue, "refused"),
        "no members": (lambda: npz({}), "refused"),
        "text": (lambda: b"maze goal\n0 0\n", "refused"),
        "an LZMA file": (lambda: lzma.compress(sound), "refused"),
    }
    what = pick(rng, list(zips))
    make, expected = zips[what]
    if not _fits(name, traits.checked):
        expected = "either"
    return Damage(f"{what} ({name} first)", expected, written(make()))


def _member(rng: np.random.Generator, arrays: Arrays, traits: NpzTraits) -> Damage:
    """Surplus members that a reader may ignore or refuse, but must neither unpack nor run."""
    members = {f"{name}.npy": npy(array) for name, array in arrays.items()}
    first = next(iter(members))
    surplus = pick(
        rng,
        (
            "surplus.npy",
            "../escaped.npy",
            "/tmp/escaped.npy",
            "\x1b[31m.npy",
            "a\nb.npy",
            "x" * 300,
        ),
    )
    contents = {
        "an array": npy(np.zeros(3)),
        "objects": npy(np.full(1, Trap(), object)),
        "no npy file": b"hello",
    }
    what = pick(rng, list(contents))
    if rng.random() < 0.2:
        body = io.BytesIO(npz(members))
        with warnings.catch_warnings(), zipfile.ZipFile(body, "a") as file:
            warnings.simplefilter("ignore")  # of the duplicate, which is meant
            file.writestr(zipfile.ZipInfo(first), members[first])
        return Damage(f"{first} twice", "either", written(body.getvalue()))
    data = npz({**members, surplus: contents[what]})
    return Damage(f"the member {surplus!r} more: {what}", "either", written(data))


def _whole(rng: np.random.Generator, arrays: Arrays, traits: NpzTraits) -> Damage:
    damage = file_damage(rng, saved(arrays))
    expected = damage.expected if traits.checked else "either"
    return Damage(damage.text, expected, damage.do, damage.codes)


WAYS = (
    (_missing, 2),
    (_kind, 4),
    (_shape, 4),
    (_number, 4),
    (_header, 3),
    (_zip, 3),
    (_member, 1),
    (_whole, 2),
)


def npz_damage(rng: np.random.Generator, arrays: Arrays, traits: NpzTraits) -> Damage:
    """Random damage to an npz file."""
    ways = [way for way, weight in WAYS for _ in range(weight)]
    return pick(rng, ways)(rng, arrays, traits)


def _swapped(array: np.ndarray) -> np.ndarray:
    return array.astype(array.dtype.newbyteorder(">"))


def _wider(array: np.ndarray) -> np.ndarray:
    """The same numbers in the widest type of their kind."""
    widest = {"f": np.float64, "i": np.int64, "u": np.uint64}
    return array.astype(widest.get(array.dtype.kind, array.dtype))


def _unsigned(array: np.ndarray) -> np.ndarray:
    """Non-negative integers in an unsigned dtype."""
    small = array.dtype.kind == "i" and array.size and array.min() >= 0
    return array.astype(np.uint64) if small else array


VARIANTS: dict[str, Callable[[Arrays], bytes]] = {
    "big-endian numbers": lambda arrays: saved({n: _swapped(a) for n, a in arrays.items()}),
    "float64 and int64": lambda arrays: saved({n: _wider(a) for n, a in arrays.items()}),
    "unsigned integers": lambda arrays: saved({n: _unsigned(a) for n, a in arrays.items()}),
    "Fortran order": lambda arrays: saved({n: np.asfortranarray(a) for n, a in arrays.items()}),
    "arrays in another order": lambda arrays: saved(dict(reversed(list(arrays.items())))),
    "no compression": lambda arrays: npz(
        {f"{n}.npy": npy(a) for n, a in arrays.items()}, zipfile.ZIP_STORED
    ),
}


def npz_variant(rng: np.random.Generator, arrays: Arrays) -> Damage:
    """The same arrays, as other programs would write them."""
    what = pick(rng, list(VARIANTS))
    return Damage(what, "accepted", written(VARIANTS[what](arrays)))


def read(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a sound file."""
    with np.load(path, allow_pickle=False) as file:
        return dict(file)
