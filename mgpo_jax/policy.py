"""The interface that a rollout needs from a policy, and the Transformer behind it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from envs.errors import DataError
from envs.specs import EnvSpec
from mgpo_jax.network_configs import NetworkConfig, TransformerConfig
from mgpo_jax.seen_goals import SeenGoals
from mgpo_jax.transformer import GoalTransformer, grow_cache


class Policy(NamedTuple):
    """A prompted policy that acts step by step, as pure functions for one episode."""

    prefill: Callable
    """``(prompt, obs) -> (action distribution, carry)`` at the first observation."""
    decode: Callable
    """``(carry, action, obs) -> (action distribution, carry)``: called after every step with the last
    action and the new observation."""
    grow: Callable
    """``(carry, num_steps) -> carry`` with room for that many more decodes."""
    num_slots: int
    """P, the number of slots of a prompt, and so the length of the longest prompt."""
    score: Callable | None = None
    """``(prompt, obs [T, ..], actions [T, ..]) -> action distributions [T]``: teacher forcing, all steps of
    a recorded episode in one pass. Needed by prompt optimizers that use likelihoods of the policy."""


class LoadedPolicy(NamedTuple):
    """A trained network with its parameters and its provenance."""

    config: Any
    """The network's config, a ``network_configs.NetworkConfig``; a ``TransformerConfig`` for multi-goal
    policies."""
    params: Any
    """The network's parameters, a Flax pytree."""
    made: dict[str, Any]
    """How the policy was trained, by the names of ``policy.json``."""
    sha256: str = ""
    """Digest of the parameter file; empty for parameters that were never on disk."""
    folder: Path | None = None
    """The folder that it was read from."""
    seen_goals: SeenGoals | None = None
    """The goals that it was trained on; None if they were not kept."""

    @property
    def policy(self) -> Policy:
        """The network and its parameters as a policy for rollouts."""
        return transformer_policy(self.config, self.params)


def check_fits(config: NetworkConfig, spec: EnvSpec, who: str = "the policy") -> None:
    """Raise ``DataError`` if a network was trained for another world than that of ``spec``.

    ``who`` names the network in the message.
    """
    facts = {
        "discrete actions": (config.head == "categorical", spec.discrete),
        "obs_shape": (config.obs_shape, spec.obs.shape),
        "obs_dtype": (config.obs_dtype, spec.obs.dtype),
        "goal_dim": (config.goal_dim, spec.goal_dim),
        "action_dim": (config.action_dim, spec.action_dim),
        "horizon": (config.horizon, spec.horizon),
    }
    if config.obs_layout is not None:
        facts["obs_layout"] = (config.obs_layout, spec.layout)
    for field, (found, want) in facts.items():
        if found != want:
            raise DataError(
                f"{who} has {field} {found}, {spec.name} needs {want}: it was trained for another world"
            )


def transformer_policy(config: TransformerConfig, params: Any) -> Policy:
    """The pre-trained multi-goal Transformer as a policy; the carry is its KV cache."""
    return prepared_policy(config, config.prepared(params), params)


def prepared_policy(config: TransformerConfig, acting: Any, params: Any = None) -> Policy:
    """The same policy from parameters that are prepared for acting (``Encoder.prepare``).

    Args:
      config: the config of the network.
      acting: the prepared parameters.
      params: the parameters themselves, which only ``score`` needs.
    """
    network = GoalTransformer(config)

    def prefill(prompt: Any, obs: Any) -> Any:
        return network.apply(acting, prompt, obs, method="prefill")

    def decode(carry: Any, action: Any, obs: Any) -> Any:
        return network.apply(acting, carry, action, obs, method="decode")

    def grow(cache: Any, num_steps: int) -> Any:
        return grow_cache(cache, config.tokens_per_step * num_steps)

    def score(prompt: Any, obs: Any, actions: Any) -> Any:
        return network.apply(params, prompt, obs, actions)

    return Policy(prefill, decode, grow, config.max_prompt_length, score)
