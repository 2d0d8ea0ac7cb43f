"""How a gradient changes the weights: the learning rate over a training, AdamW and Muon."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from mgpo_jax.settings import TrainConfig

# Root mean square of a typical AdamW update, before it is scaled by the learning rate.
ADAMW_RMS = 0.2


def learning_rate_schedule(config: TrainConfig) -> optax.Schedule:
    rate, warmup = config.learning_rate, min(config.warmup_steps, config.steps - 1)
    if config.schedule == "cosine":
        return optax.warmup_cosine_decay_schedule(0.0, rate, warmup, config.steps, 0.02 * rate)
    return optax.linear_schedule(0.0, rate, warmup) if warmup else optax.constant_schedule(rate)


def make_optimizer(
    config: TrainConfig, unravel: Callable[[Any], Any]
) -> optax.GradientTransformation:
    """The optimizer of a training run, for weights that are raveled into one vector.

    Muon (Jordan 2024) orthogonalizes the update of each matrix. Its updates are scaled to AdamW's root mean
    square (Liu et al. 2025), so that both optimizers use the same learning rate. With ``muon``, the weights
    that are not matrices of the blocks are updated by AdamW with Nesterov momentum, as optax has it.

    Args:
      config: the training config.
      unravel: restores the pytree of parameters from the vector; Muon needs their shapes and names.
    """
    rate, decay = learning_rate_schedule(config), config.weight_decay
    clip = optax.clip_by_global_norm(config.clip_norm)
    if config.optimizer == "adamw":
        return optax.chain(clip, optax.adamw(rate, weight_decay=decay))
    muon = optax.contrib.muon(
        rate,
        weight_decay=decay,
        adam_weight_decay=decay,
        consistent_rms=ADAMW_RMS,
        muon_weight_dimension_numbers=_block_matrices,
    )

    def init(weights: Array) -> Any:
        return muon.init(unravel(weights))

    def update(grads: Array, state: Any, weights: Array | None = None) -> tuple[Array, Any]:
        updates, state = muon.update(unravel(grads), state, unravel(weights))
        return ravel_pytree(updates)[0], state

    return optax.chain(clip, optax.GradientTransformation(init, update))


def _block_matrices(params: Any) -> Any:
    """Mark the matrices of the Transformer blocks for Muon; AdamW updates embeddings, head and the rest."""

    def kind(path: Any, leaf: Array) -> Any:
        in_block = any(str(part.key).startswith("blocks") for part in path)
        return optax.contrib.MuonDimensionNumbers() if in_block and leaf.ndim == 2 else None

    return jax.tree_util.tree_map_with_path(kind, params)
