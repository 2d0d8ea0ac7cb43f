"""What is fixed of a network before it has weights: the shapes of its world, its encoder, head and sizes.

All networks share ``NetworkConfig``, whose fields follow from a world (``world_side``) or from the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from annotated_types import Ge, Gt, Le, MaxLen
from jaxtyping import Array, Float, Int, Shaped

from envs.errors import UsageError, nearest, shown
from envs.registry import Encoder
from envs.specs import ArraySpec, EnvSpec, ObsLayout
from mgpo_jax.distributions import HEADS
from mgpo_jax.schema import STRICT
from mgpo_jax.settings import ENCODERS, NumGoals, NumLayers, Share, TokensPerStep, Width

OBS_LIMIT = 5.0  # standardized observations are clipped to this many standard deviations
Size = Annotated[int, Ge(1), Le(1_000_000)]
DTYPES = (
    "bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64",
    "float16", "float32", "float64",
)  # fmt: skip
"""The dtypes that observations may have."""


@dataclass(frozen=True)
class NetworkConfig:
    """The config that all networks share: the shapes of the world, the encoder and the action head."""

    __pydantic_config__ = STRICT

    obs_shape: Annotated[tuple[Size, ...], MaxLen(8)]
    """Shape of an observation."""
    goal_dim: Size
    """Size G of a goal."""
    action_dim: Size
    """Number of discrete actions, or size A of a continuous action."""
    horizon: Size
    """Largest number of steps T of an episode."""
    obs_dtype: str = "float32"
    """Dtype of an observation."""
    encoder: str = "linear"
    """How observations become tokens, one of ``settings.ENCODERS``."""
    head: str = "categorical"
    """The action distribution, one of ``distributions.HEADS``."""
    obs_mean: tuple[Annotated[float, Ge(-1e18), Le(1e18)], ...] = ()
    """Mean over the training data of every component of the flattened observation (empty: observations are
    not standardized)."""
    obs_std: tuple[Annotated[float, Gt(0), Le(1e18)], ...] = ()
    """Standard deviation of every component, in the same order."""
    obs_layout: ObsLayout | None = None
    """The meaning of an observation's components, for encoders that use it."""

    def standardized(self, obs: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
        """Observations ``[*batch, ...]`` standardized and clipped, as the encoder expects them."""
        if not self.obs_mean:
            return obs
        mean, std = (
            jnp.array(row).reshape(self.obs_shape) for row in (self.obs_mean, self.obs_std)
        )
        return jnp.clip((obs - mean) / std, -OBS_LIMIT, OBS_LIMIT)

    def make_encoder(self, width: int) -> nn.Module:
        """The module that embeds observations as tokens of the given width."""
        make = ENCODERS.find(self.encoder).make
        module: nn.Module = make(self.obs_shape, width, self.obs_layout)
        return module

    def prepared(self, params: Any) -> Any:
        """Parameters with which the network acts as with ``params``, and its encoder with less work.

        None, the parameters of a policy that never acts, stays None.
        """
        prepare = ENCODERS.find(self.encoder).prepare
        if prepare is None or params is None:
            return params
        parts = params["params"]
        return {**params, "params": {**parts, "embed_obs": prepare(parts["embed_obs"])}}

    def action_numbers(self, actions: Array) -> Float[Array, "... A"]:
        """Actions as input features: one-hot if they are discrete, unchanged if continuous."""
        discrete = self.head == "categorical"
        return jax.nn.one_hot(actions, self.action_dim) if discrete else actions

    def blank_episode(self, num_steps: int = 1) -> tuple[Array, Array]:
        """All-zero observations and actions of an episode, with the right shapes and dtypes."""
        discrete = self.head == "categorical"
        actions = (num_steps,) if discrete else (num_steps, self.action_dim)
        obs = jnp.zeros((num_steps, *self.obs_shape), self.obs_dtype)
        return obs, jnp.zeros(actions, jnp.int32 if discrete else jnp.float32)


@dataclass(frozen=True)
class TransformerConfig(NetworkConfig):
    """Config of the multi-goal Transformer. The defaults are those of Table 6 in the paper."""

    __pydantic_config__ = STRICT

    max_prompt_length: NumGoals = 5
    """K, the number of prompt slots."""
    embed_dim: Width = 128
    num_layers: NumLayers = 3
    num_heads: Width = 1
    dropout: Share = 0.1
    """Dropout rate on embeddings, attention weights and residual branches."""
    prompt_order: bool = True
    """Whether prompt slots have a position embedding (the paper's network: False)."""
    tokens_per_step: TokensPerStep = 2
    """2: observation and action are separate tokens; 1: the last action and the observation share one."""

    def num_step_tokens(self, num_steps: int | Int[Array, ""]) -> Any:
        """The number of tokens of an episode with ``num_steps`` steps, up to the last observation."""
        return self.tokens_per_step * num_steps - (self.tokens_per_step - 1)


def network_config(spec: EnvSpec, head: str | None = None, **sizes: Any) -> TransformerConfig:
    """The network config for a world, with the sizes of Table 6 except for those given.

    Raises:
      UsageError: if ``sizes`` holds what follows from the world; see also ``world_side``.
    """
    from_world = world_side(spec, head, sizes.get("encoder", "linear"))
    for name in sizes.keys() & from_world.keys():
        raise UsageError(f"{name} of a network follows from the world {spec.name}; leave it out")
    return TransformerConfig(**from_world, **sizes)


def world_side(spec: EnvSpec, head: str | None, encoder: str) -> dict[str, Any]:
    """The fields of a network config that follow from its world, by name (without ``encoder``).

    Args:
      spec: the world's specification.
      head: the action distribution (default: the first one in ``distributions.HEADS`` that fits).
      encoder: the encoder of observations.

    Raises:
      UsageError: if the head or the encoder does not exist, the head does not fit the world's actions, or
        the encoder does not fit its observations.
    """
    known = [name for name in HEADS if (name == "categorical") == spec.discrete]
    head = head or known[0]
    if head not in known:
        raise nearest(head, known, f"head for {spec.name}")
    return {
        "obs_shape": spec.obs.shape,
        "obs_dtype": spec.obs.dtype,
        "goal_dim": spec.goal_dim,
        "action_dim": spec.action_dim,
        "horizon": spec.horizon,
        "head": head,
        "obs_layout": _layout_for(ENCODERS.find(encoder), spec),
    }


def _layout_for(encoder: Encoder, spec: EnvSpec) -> ObsLayout | None:
    """The layout of a world's observations, if the encoder uses it."""
    if not encoder.uses_layout:
        return None
    if spec.layout is None:
        raise UsageError(
            f"--encoder {encoder.name} embeds codes and counts, the observations of {spec.name} are "
            f"{spec.obs} without a layout of them; choose another encoder"
        )
    if said := encoder.fault(spec.layout, spec.obs.shape):
        raise UsageError(
            f"--encoder {encoder.name} cannot be used in {spec.name}: the layout of its observations "
            f"{said}; choose another encoder"
        )
    return spec.layout


def network_fault(config: NetworkConfig) -> str | None:
    """What is wrong with a network's config, beyond types and ranges; None if nothing is."""
    if config.head not in HEADS:
        return f"head must be one of {', '.join(HEADS)}, found {shown(config.head)}"
    if config.encoder not in (known := ENCODERS.names()):
        return f"encoder must be one of {', '.join(known)}, found {shown(config.encoder)}"
    if config.obs_dtype not in DTYPES:
        return f"obs_dtype must be one of {', '.join(DTYPES)}, found {shown(config.obs_dtype)}"
    if isinstance(config, TransformerConfig) and config.embed_dim % config.num_heads:
        return f"num_heads must divide embed_dim {config.embed_dim}, found {config.num_heads}"
    size = ArraySpec(config.obs_shape, config.obs_dtype).size
    for name in ("obs_mean", "obs_std"):
        if len(getattr(config, name)) not in (0, size):
            return f"{name} must hold {size} numbers or none, found {len(getattr(config, name))}"
    if (num := len(config.obs_std)) != len(config.obs_mean):
        return (
            f"obs_std must hold as many numbers as obs_mean, found {num} and {len(config.obs_mean)}"
        )
    return _layout_fault(config)


def _layout_fault(config: NetworkConfig) -> str | None:
    """What is wrong with the layout of observations in a network's config; None if nothing is."""
    layout = config.obs_layout
    encoder = ENCODERS.find(config.encoder)
    if not encoder.uses_layout:
        return None if layout is None else f"obs_layout does not apply to encoder {config.encoder}"
    if layout is None:
        return f"obs_layout must not be null with encoder {config.encoder}"
    if config.obs_mean:
        return (
            f"obs_mean must be empty with encoder {config.encoder}, whose inputs are codes rather than "
            "quantities"
        )
    said = encoder.fault(layout, config.obs_shape)
    return said and f"obs_layout {said}"
