"""Arrays as text in a page: their bytes are concatenated, deflated and encoded in base64."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

DTYPES = ("float32", "float16", "uint8", "uint16", "uint32")
"""The dtypes that a page can read (``js/arrays.js``)."""


def packed(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Encode arrays as JSON values. Their bytes are little-endian on every machine."""
    parts, entries = [], []
    for name, array in arrays.items():
        if str(array.dtype) not in DTYPES:
            raise ValueError(f"{name} is of {array.dtype}; pages read {', '.join(DTYPES)}")
        entries.append({"name": name, "type": str(array.dtype), "shape": list(array.shape)})
        parts.append(array.astype(array.dtype.newbyteorder("<")).tobytes())
    deflated = zlib.compress(b"".join(parts), 9)
    return {"arrays": entries, "bytes": base64.b64encode(deflated).decode()}


def unpacked(values: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Decode what ``packed`` returned."""
    content, at, arrays = zlib.decompress(base64.b64decode(values["bytes"])), 0, {}
    for entry in values["arrays"]:
        dtype = np.dtype(entry["type"]).newbyteorder("<")
        count = int(np.prod(entry["shape"], dtype=np.int64))
        flat = np.frombuffer(content, dtype, count, at)
        arrays[entry["name"]] = flat.reshape(entry["shape"]).astype(entry["type"])
        at += count * dtype.itemsize
    return arrays


def smallest(array: np.ndarray) -> np.ndarray:
    """Non-negative integers in the smallest unsigned dtype that holds them."""
    return array.astype(np.min_scalar_type(int(array.max(initial=0))))
