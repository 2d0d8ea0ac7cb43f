"""Small functions on pytrees."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int


def choose(condition: Bool[Array, ""], if_true: Any, if_false: Any) -> Any:
    """Select ``if_true`` or ``if_false``, two pytrees of the same structure and shapes."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)


def put_row(rows: Any, row: Any, index: Int[Array, ""]) -> Any:
    """The stacked pytrees ``rows`` with ``row`` at ``index``."""
    return jax.tree.map(
        lambda old, new: jax.lax.dynamic_update_index_in_dim(old, new, index, 0), rows, row
    )


def taken_over(fresh: Any, given: Any) -> Any:
    """The pytree ``fresh``, with the leaves of ``given`` wherever both have one of the same shape."""
    old = named_leaves(given, lone="")

    def pick(path: Any, new: Any) -> Any:
        found = old.get(jax.tree_util.keystr(path, simple=True, separator="."))
        return new if found is None or found.shape != new.shape else found

    return jax.tree_util.tree_map_with_path(pick, fresh)


def named_leaves(tree: Any, lone: str) -> dict[str, Any]:
    """The leaves of a pytree by path, such as ``prompt.goals``.

    If the tree is a single leaf, its name is ``lone``.
    """
    paths, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {
        jax.tree_util.keystr(path, simple=True, separator=".") or lone: leaf for path, leaf in paths
    }


def numbered_leaves(tree: Any) -> dict[str, np.ndarray]:
    """The leaves of a pytree by their index, to be written to a file."""
    return {f"leaf{i:05}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}


def with_leaves(like: Any, leaves: Mapping[str, np.ndarray]) -> Any:
    """Rebuild a pytree with the structure of ``like`` from its ``numbered_leaves``.

    Raises:
      ValueError: if there are more or fewer leaves.
    """
    return jax.tree.unflatten(jax.tree.structure(like), [leaves[name] for name in sorted(leaves)])
