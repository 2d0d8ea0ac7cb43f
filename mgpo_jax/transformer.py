"""The multi-goal causal Transformer (paper, section 3.1, appendix D, Table 6).

The input sequence is ``(g_1 .. g_P, o_1, a_1, o_2, a_2, .., o_T)``. Goals, observations and actions are
embedded by three linear layers, the observation and the action of one step share a learned timestep
embedding, and the outputs at the observations parameterize the action distributions. With one token per
step (``tokens_per_step=1``) the sequence is ``(g_1 .. g_P, s_1, .., s_T)``, where s_t is the sum of the
embeddings of a_{t-1}, o_t and the timestep: half as many tokens carry the same information. The module is
written for one sequence and has three entry points that share their layers: the full pass (for training),
and ``prefill`` / ``decode`` with an explicit key-value cache (for acting).

The network deliberately differs from the authors' code in two points. Prompt slots have a learned position
embedding (``prompt_order=True``; theirs have none, so the order of goals shows only through the causal
mask), and all tokens pass through the input LayerNorm (theirs: all but the goals).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from mgpo_jax.distributions import HEADS, Distribution
from mgpo_jax.network_configs import TransformerConfig
from mgpo_jax.prompts import Prompt

# Attention is computed for blocks of this many queries, so the full score matrix is never in memory.
QUERY_BLOCK = 128


class KVCache(NamedTuple):
    """Keys and values of the tokens read so far, for each layer; ``step`` is the next timestep."""

    keys: tuple[Float[Array, "*batch H S E"], ...]
    values: tuple[Float[Array, "*batch H S E"], ...]
    prompt_mask: Bool[Array, "*batch P"]
    step: Int[Array, ""]


def grow_cache(cache: KVCache, num_tokens: int) -> KVCache:
    """The cache padded with room for ``num_tokens`` more. Attention pays for the unused room, too."""
    pad = ((0, 0), (0, num_tokens), (0, 0))
    keys, values = jax.tree.map(lambda rows: jnp.pad(rows, pad), (cache.keys, cache.values))
    return cache._replace(keys=keys, values=values)


Attend = Callable[[Array, Array, Array], Array]  # queries, keys, values of the new tokens -> mixed


class Block(nn.Module):
    """Pre-LayerNorm Transformer block with a ReLU feed-forward layer."""

    config: TransformerConfig

    def setup(self) -> None:
        width = self.config.embed_dim
        residual_init = nn.initializers.normal(0.02 / (2 * self.config.num_layers) ** 0.5)
        self.norm_attention = nn.LayerNorm()
        self.query = nn.Dense(width)
        self.key_value = nn.Dense(2 * width)
        self.mix = nn.Dense(width, kernel_init=residual_init)
        self.norm_mlp = nn.LayerNorm()
        self.expand = nn.Dense(4 * width)
        self.contract = nn.Dense(width, kernel_init=residual_init)
        self.dropout = nn.Dropout(self.config.dropout)

    def __call__(
        self, x: Float[Array, "S E"], rows: slice | np.ndarray, attend: Attend, deterministic: bool
    ) -> Float[Array, "R E"]:
        """Transform the R tokens ``x[rows]``, which attend to the keys and values of all of ``x``."""
        h = self.norm_attention(x)
        heads = (-1, self.config.num_heads, self.config.embed_dim // self.config.num_heads)
        query = self.query(h[rows]).reshape(heads)
        key, value = jnp.split(self.key_value(h), 2, axis=-1)
        mixed = attend(query, key.reshape(heads), value.reshape(heads))
        x = x[rows] + self.dropout(self.mix(mixed), deterministic=deterministic)
        h = self.contract(nn.relu(self.expand(self.norm_mlp(x))))
        return x + self.dropout(h, deterministic=deterministic)


def _attention(
    query: Float[Array, "R H E"],
    key: Float[Array, "S H E"],
    value: Float[Array, "S H E"],
    visible: Bool[Array, "R S"],
    drop: Callable[[Array], Array] = lambda weights: weights,
) -> Float[Array, "R HE"]:
    scores = jnp.einsum("rhe,she->hrs", query, key) * query.shape[-1] ** -0.5
    weights = jax.nn.softmax(jnp.where(visible, scores, -1e9), axis=-1)
    return jnp.einsum("hrs,she->rhe", drop(weights), value).reshape(query.shape[0], -1)


def _attention_by_row(
    query: Float[Array, "R H E"],
    key: Float[Array, "H S E"],
    value: Float[Array, "H S E"],
    visible: Bool[Array, "R S"],
) -> Float[Array, "R HE"]:
    """``_attention`` for a few queries, as matrix-vector products.

    XLA's CPU backend runs these several times faster than a product with a two-row matrix.
    """

    def of_head(query: Array, key: Array, value: Array, visible: Array) -> Array:
        scores = (key @ query) * query.shape[-1] ** -0.5
        return jax.nn.softmax(jnp.where(visible, scores, -1e9)) @ value

    heads = jax.vmap(of_head, in_axes=(0, 0, 0, None))
    if len(query) > 2:  # in prefill: a loop, compiled once for all rows
        return jax.lax.map(lambda row: heads(row[0], key, value, row[1]).ravel(), (query, visible))
    rows = [heads(q, key, value, v).ravel() for q, v in zip(query, visible, strict=True)]
    return jnp.stack(rows)


class GoalTransformer(nn.Module):
    """The policy network pi_theta(a_t | p, h_{t-1}, o_t)."""

    config: TransformerConfig

    def setup(self) -> None:
        config = self.config
        small = nn.initializers.normal(0.02)
        self.embed_goal = nn.Dense(config.embed_dim)
        self.embed_obs = config.make_encoder(config.embed_dim)
        self.embed_action = nn.Dense(config.embed_dim)
        self.embed_time = self.param("embed_time", small, (config.horizon, config.embed_dim))
        if config.prompt_order:
            shape = (config.max_prompt_length, config.embed_dim)
            self.embed_slot = self.param("embed_slot", small, shape)
        self.norm_in = nn.LayerNorm()
        self.blocks = [Block(config) for _ in range(config.num_layers)]
        self.norm_out = nn.LayerNorm()
        self.head = nn.Dense(HEADS[config.head].num_params(config.action_dim))
        self.dropout = nn.Dropout(config.dropout)

    def __call__(
        self,
        prompt: Prompt,
        obs: Shaped[Array, "T ..."],
        actions: Array,
        deterministic: bool = True,
    ) -> Distribution:
        """Action distributions at all T observations (T at most the horizon).

        With ``deterministic=False`` dropout is on and an rng named ``dropout`` is needed.
        """
        return self.read_out(self.features(prompt, obs, actions, deterministic))

    def features(
        self,
        prompt: Prompt,
        obs: Shaped[Array, "T ..."],
        actions: Array,
        deterministic: bool = True,
    ) -> Float[Array, "R E"]:
        """The input of the action head: R = T rows, one for each observation, if there are any blocks."""
        num_slots, stride = self.config.max_prompt_length, self.config.tokens_per_step
        steps = self._step_tokens(obs, actions, self.embed_time[: len(obs)])
        x = jnp.concatenate([self._prompt_tokens(prompt), steps])
        # Only the outputs at observations are used, so the last layer computes no others.
        reads = slice(num_slots, None, stride)
        return self._full_pass(
            x, self._seen(prompt, len(steps)), range(len(x)), reads, deterministic
        )

    def _seen(self, prompt: Prompt, num_tokens: int) -> Bool[Array, "S"]:
        """Which tokens may be attended to: all but the empty prompt slots."""
        return jnp.concatenate([prompt.mask, jnp.ones(num_tokens, bool)])

    def _full_pass(
        self,
        x: Float[Array, "N E"],
        seen: Bool[Array, "S"],
        at: Sequence[int] | np.ndarray,
        reads: slice | np.ndarray,
        deterministic: bool,
    ) -> Float[Array, "R E"]:
        """Run all tokens at once.

        Args:
          x: embeddings of N tokens. The first S of them can be attended to; the others only attend.
          seen: which of the first S tokens are real, rather than empty prompt slots.
          at: positions of all N tokens: each attends to those of the first S up to its own position.
          reads: the R tokens whose outputs are wanted.
          deterministic: whether to disable dropout.
        """
        x = self.dropout(self.norm_in(x), deterministic=deterministic)
        positions = jnp.arange(len(seen))
        drop = lambda weights: self.dropout(weights, deterministic=deterministic)  # noqa: E731
        for index, block in enumerate(self.blocks):
            last = index == self.config.num_layers - 1
            rows = reads if last else slice(None)
            row_positions = np.asarray(at)[rows]

            def attend(
                query: Array, key: Array, value: Array, at: np.ndarray = row_positions
            ) -> Array:
                mixed = []
                for start in range(0, len(at), QUERY_BLOCK):
                    block_at = at[start : start + QUERY_BLOCK]
                    end = max(block_at) + 1  # the causal mask hides all later keys
                    visible = seen[None, :end] & (
                        positions[None, :end] <= jnp.asarray(block_at)[:, None]
                    )
                    part = query[start : start + QUERY_BLOCK]
                    mixed.append(_attention(part, key[:end], value[:end], visible, drop))
                return jnp.concatenate(mixed)

            x = block(x, rows, attend, deterministic)
        return self.norm_out(x)

    def prefill(self, prompt: Prompt, obs: Shaped[Array, "..."]) -> tuple[Distribution, KVCache]:
        """Read the prompt and the first observation; returns pi(a_1) and the cache."""
        features, cache = self._first(prompt, obs)
        return self._distribution(features), cache

    def _first(
        self, prompt: Prompt, obs: Shaped[Array, "..."]
    ) -> tuple[Float[Array, "1 E"], KVCache]:
        """Read the prompt and the first observation; returns the features at it and the cache."""
        config = self.config
        first = self._obs_token(obs[None], self.embed_time[:1])
        x = self.norm_in(jnp.concatenate([self._prompt_tokens(prompt), first]))
        shape = (config.num_heads, 0, config.embed_dim // config.num_heads)
        empty = (jnp.zeros(shape, x.dtype),) * config.num_layers
        cache = KVCache(empty, empty, prompt.mask, jnp.zeros((), jnp.int32))
        return self._extend(x, grow_cache(cache, len(x)), at=0)

    def decode(
        self, cache: KVCache, action: Array, obs: Shaped[Array, "..."]
    ) -> tuple[Distribution, KVCache]:
        """Append (a_{t-1}, o_t); returns pi(a_t) and the longer cache.

        The cache must have room for the tokens of one more step (``grow_cache``).
        """
        features, cache = self._append(cache, self._new_tokens(cache.step, action, obs))
        return self._distribution(features), cache

    def _append(
        self, cache: KVCache, tokens: Float[Array, "R E"]
    ) -> tuple[Float[Array, "1 E"], KVCache]:
        """Append the tokens of (a_{t-1}, o_t); returns the features at o_t and the longer cache."""
        at = self.config.max_prompt_length + self.config.num_step_tokens(cache.step)
        return self._extend(self.norm_in(tokens), cache, at=at)

    def _new_tokens(
        self, step: Int[Array, ""], action: Array, obs: Shaped[Array, "..."]
    ) -> Float[Array, "R E"]:
        """The tokens that (a_{t-1}, o_t) adds to the sequence; o_t is in the last of them."""
        action = jnp.asarray(action)[None]
        if self.config.tokens_per_step == 1:
            time = jax.lax.dynamic_slice_in_dim(self.embed_time, step, 1)
            return self._obs_token(obs[None], time) + self._embedded(action)
        times = jax.lax.dynamic_slice_in_dim(self.embed_time, step - 1, 2)
        pair = self._action_token(action, times[:1]), self._obs_token(obs[None], times[1:])
        return jnp.concatenate(pair)

    def _extend(
        self, x: Float[Array, "R E"], cache: KVCache, at: int | Int[Array, ""], keeps: bool = True
    ) -> tuple[Float[Array, "1 E"], KVCache]:
        """Run R new tokens, the first of them at position ``at``, against the cache.

        Returns the features of the last token, and the cache with the new tokens appended. With
        ``keeps=False`` the tokens only attend to cached ones up to their position, and the cache is
        unchanged.
        """
        num_new = len(x)
        capacity = cache.keys[0].shape[1]
        num_steps_tokens = capacity - self.config.max_prompt_length
        seen = jnp.concatenate([cache.prompt_mask, jnp.ones(num_steps_tokens, bool)])
        keys, values = [], []
        for index, block in enumerate(self.blocks):
            last = index == self.config.num_layers - 1
            first_row = num_new - 1 if last else 0
            row_positions = at + jnp.arange(first_row, num_new)
            visible = seen & (jnp.arange(capacity) <= row_positions[:, None])

            def attend(
                query: Array, key: Array, value: Array, index: int = index, visible: Array = visible
            ) -> Array:
                old = cache.keys[index], cache.values[index]
                if keeps:
                    key, value = (
                        jax.lax.dynamic_update_slice_in_dim(rows, new.swapaxes(0, 1), at, axis=1)
                        for rows, new in zip(old, (key, value), strict=True)
                    )
                else:
                    key, value = old
                keys.append(key)
                values.append(value)
                return _attention_by_row(query, key, value, visible)

            x = block(x, slice(first_row, None), attend, True)
        grown = KVCache(tuple(keys), tuple(values), cache.prompt_mask, cache.step + 1)
        return self.norm_out(x), grown if keeps else cache

    def _distribution(self, features: Float[Array, "1 E"]) -> Distribution:
        """The action distribution at one observation."""
        found: Distribution = jax.tree.map(lambda leaf: leaf[-1], self.read_out(features))
        return found

    def _prompt_tokens(self, prompt: Prompt) -> Float[Array, "P E"]:
        tokens = self.embed_goal(prompt.goals)
        return tokens + self.embed_slot if self.config.prompt_order else tokens

    def _obs_token(self, obs: Shaped[Array, "T ..."], time: Array) -> Float[Array, "T E"]:
        return self.embed_obs(self.config.standardized(obs)) + time

    def _action_token(self, actions: Array, time: Array) -> Float[Array, "T E"]:
        return self._embedded(actions) + time

    def _embedded(self, actions: Array) -> Float[Array, "T E"]:
        return self.embed_action(self.config.action_numbers(actions))

    def _step_tokens(
        self, obs: Shaped[Array, "T ..."], actions: Array, time: Float[Array, "T E"]
    ) -> Float[Array, "S E"]:
        """The S tokens of T steps, up to the last observation."""
        if self.config.tokens_per_step == 1:
            before = self._embedded(actions)[:-1]  # no action comes before the first observation
            return self._obs_token(obs, time) + jnp.pad(before, ((1, 0), (0, 0)))
        pairs = jnp.stack([self._obs_token(obs, time), self._action_token(actions, time)], axis=1)
        return pairs.reshape(2 * len(obs), -1)[:-1]  # the last action predicts nothing

    def read_out(self, x: Float[Array, "*R E"]) -> Distribution:
        """Action distributions from ``features``."""
        return HEADS[self.config.head].make(self.head(x))
