"""The part of a network that is fine-tuned: all of it, its last layers, or low-rank matrices (LoRA)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

LAST = ("norm_out", "head")
"""The layers of ``GoalTransformer`` that turn features into a distribution."""


class Subset(NamedTuple):
    """The trained part of a network; all functions are pure."""

    start: Callable[[PRNGKeyArray], Any]
    """``(key) -> part``: the initial value, which leaves the network's outputs unchanged."""
    merge: Callable[[Any], Any]
    """``(part) -> params``: the parameters of the whole network."""


def subset(name: str, params: Any, rank: int) -> Subset:
    """The part of a network with a given name.

    Args:
      name: ``all``, ``head`` or ``lora``.
      params: the parameters of the whole network.
      rank: the rank of the matrices of ``lora``.
    """
    layers = params["params"]
    if name == "all":
        return Subset(lambda key: params, lambda part: part)
    if name == "head":
        last = {layer: layers[layer] for layer in LAST}
        return Subset(lambda key: last, lambda part: {"params": {**layers, **part}})
    return _low_rank(layers, rank)


def _low_rank(layers: Any, rank: int) -> Subset:
    """W + A B for every kernel W of the blocks, where A starts random and B zero (Hu et al., 2021)."""
    paths, tree = jax.tree_util.tree_flatten_with_path(layers)
    where = [i for i, (path, _) in enumerate(paths) if _is_block_kernel(path)]
    kernels = {i: paths[i][1] for i in where}

    def start(key: PRNGKeyArray) -> Any:
        part = {}
        for index, kernel in kernels.items():
            rows, columns = kernel.shape
            left = jax.random.normal(jax.random.fold_in(key, index), (rows, rank)) * rows**-0.5
            part[str(index)] = (left, jnp.zeros((rank, columns)))
        return part

    def merge(part: Any) -> Any:
        leaves = [leaf for _, leaf in paths]
        for index, kernel in kernels.items():
            left, right = part[str(index)]
            leaves[index] = kernel + left @ right
        return {"params": jax.tree.unflatten(tree, leaves)}

    return Subset(start, merge)


def _is_block_kernel(path: Any) -> bool:
    names = [getattr(entry, "key", "") for entry in path]
    return names[0].startswith("blocks") and names[-1] == "kernel"
