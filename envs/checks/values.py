"""Comparing outputs of a world, and naming errors."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from envs.base import raw


def reason(error: BaseException) -> str:
    """The first line of an error."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def all_equal(a: Any, b: Any) -> Array:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    same = [jnp.all(jnp.equal(raw(x), raw(y))) for x, y in pairs]
    return jnp.all(jnp.stack(same)) if same else jnp.ones((), bool)


def as_numpy(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(raw(leaf)), tree)


def equal(a: Any, b: Any) -> bool:
    leaves = zip(jax.tree.leaves(as_numpy(a)), jax.tree.leaves(as_numpy(b)), strict=True)
    return all(np.array_equal(x, y) for x, y in leaves)


def first_of(mask: np.ndarray) -> tuple[int, ...]:
    """The index of the first true entry of a mask."""
    return tuple(int(i) for i in np.argwhere(mask)[0])
