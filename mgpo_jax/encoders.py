"""Encoders, which embed an observation of any shape and dtype as a token.

``settings.ENCODERS`` finds them by name, together with those of worlds and of other packages.
"""

from __future__ import annotations

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from envs.registry import Encoder
from envs.specs import ObsLayout


class Linear(nn.Module):
    """A linear map of the flattened observation (paper, appendix D). Integers are used as numbers.

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


class Cells(nn.Module):
    """An embedding for each digit of each cell's code and for each count, and a linear map of the rest.

    This equals a linear layer on the observation with codes and counts expanded to one-hots, but is
    computed by looking up rows of its kernel. Codes and counts are rounded and clipped to their range.

    Attributes:
      width: size of a token.
      layout: the meaning of the numbers in a flat observation.
    """

    width: int
    layout: ObsLayout

    @nn.compact
    def __call__(self, obs: Shaped[Array, "... D"]) -> Float[Array, "..."]:
        """Tokens ``[*batch, E]`` of observations ``[*batch, D]``."""
        layout = self.layout
        num_coded = layout.num_cells + layout.num_counts
        num_rest = obs.shape[-1] - num_coded
        # The number of nonzero inputs of the equivalent linear layer (fan-in): one per digit, count and
        # number.
        active = layout.num_cells * len(layout.code_sizes) + layout.num_counts + num_rest
        init = nn.initializers.normal(active**-0.5)
        cells = (layout.num_cells, sum(layout.code_sizes), self.width)
        counts = (layout.num_counts, layout.max_count + 1, self.width)
        kernel = self.param("kernel", init, (num_rest, self.width))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.width,))
        numbers = obs.astype(jnp.float32)
        token = numbers[..., num_coded:] @ kernel + bias
        codes, amounts = jnp.split(numbers[..., :num_coded], [layout.num_cells], axis=-1)
        token = _looked_up(token, self.param("cells", init, cells), digit_rows(codes, layout))
        amounts = _rounded(amounts, layout.max_count + 1)[..., None]
        return _looked_up(token, self.param("counts", init, counts), amounts)


def _rounded(numbers: Float[Array, "..."], size: int) -> Int[Array, "..."]:
    """The nearest integers from 0 to ``size`` - 1."""
    return jnp.clip(jnp.round(numbers), 0, size - 1).astype(jnp.int32)


def digit_rows(codes: Float[Array, "... C"], layout: ObsLayout) -> Int[Array, "... C digits"]:
    """The row of a cell's table for each digit of its code; the rows of one digit follow those of the
    last."""
    sizes = np.array(layout.code_sizes, np.int32)
    whole = _rounded(codes, math.prod(layout.code_sizes))[..., None]
    return whole // (np.cumprod(sizes) // sizes) % sizes + (np.cumsum(sizes) - sizes)


def _looked_up(
    token: Float[Array, "*batch E"],
    tables: Float[Array, "cells rows E"],
    rows: Int[Array, "*batch cells digits"],
) -> Float[Array, "*batch E"]:
    """The token plus the selected rows of each cell's table.

    On a CPU this is done cell by cell: a single gather would write all rows to memory and scatter their
    gradient over all tables. Accelerators are slow at scattering and fast at products, so they use
    ``_multiplied_out``.
    """
    if jax.default_backend() != "cpu":
        return _multiplied_out(token, tables, rows)

    def add(token: Array, cell: tuple[Array, Array]) -> tuple[Array, None]:
        table, rows = cell
        for digit in range(rows.shape[-1]):
            token = token + table[rows[..., digit]]
        return token, None

    return jax.lax.scan(add, token, (tables, jnp.moveaxis(rows, -2, 0)))[0]


def _multiplied_out(
    token: Float[Array, "*batch E"],
    tables: Float[Array, "cells rows E"],
    rows: Int[Array, "*batch cells digits"],
) -> Float[Array, "*batch E"]:
    """``_looked_up`` computed as one product with one-hots, whose gradient is a product, too."""
    hot = jax.nn.one_hot(rows, tables.shape[1], dtype=tables.dtype).sum(axis=-2)
    return token + jnp.einsum("...cr,cre->...e", hot, tables)


def layout_fault(layout: ObsLayout, shape: tuple[int, ...]) -> str | None:
    """What is wrong with a layout for observations of a shape, as the end of a sentence; None if nothing
    is."""
    sizes = layout.code_sizes
    if min(layout.num_cells, layout.num_counts, layout.max_count, *sizes) < 0 or not all(sizes):
        return "must hold no negative numbers and code sizes of at least 1"
    if not sizes or math.prod(sizes) > 1 << 20 or layout.max_count >= 1 << 20:
        return "must have 1 to 1048576 codes and counts"
    if len(shape) != 1 or layout.num_cells + layout.num_counts > shape[0]:
        return f"must describe a flat observation, found {layout} for one of shape {list(shape)}"
    return None


def _cells(obs_shape: tuple[int, ...], width: int, layout: ObsLayout | None) -> nn.Module:
    assert layout is not None  # checked by ``network_configs`` and ``policy_files``
    return Cells(width, layout)


LINEAR = Encoder(name="linear", make=lambda obs_shape, width, layout: Linear(width, len(obs_shape)))
CELLS = Encoder(name="cells", make=_cells, uses_layout=True, fault=layout_fault)
