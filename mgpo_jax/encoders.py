"""Encoders: how the network turns an observation of any shape and dtype into a token."""

from __future__ import annotations

import math
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped


class Linear(nn.Module):
    """A linear map of all numbers of an observation (paper, appendix D). Integers count as they are.

    Attributes:
      width: size of a token.
      obs_ndim: number of axes of an observation.
    """

    width: int
    obs_ndim: int

    @nn.compact
    def __call__(self, obs: Shaped[Array, "..."]) -> Float[Array, "..."]:
        """Tokens ``[*batch, E]`` of observations ``[*batch, ...]``."""
        lead = obs.shape[: obs.ndim - self.obs_ndim]
        size = math.prod(obs.shape[obs.ndim - self.obs_ndim :])
        flat = obs.reshape(*lead, size).astype(jnp.float32)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (size, self.width))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.width,))
        product = jax.lax.dot_general(flat, kernel, (((flat.ndim - 1,), (0,)), ((), ())))
        return product + bias


ENCODERS: dict[str, Callable[[tuple[int, ...], int], nn.Module]] = {
    "linear": lambda obs_shape, width: Linear(width, len(obs_shape)),
}
"""By the name in a network's config: ``(shape of an observation, width of a token) -> module``."""
