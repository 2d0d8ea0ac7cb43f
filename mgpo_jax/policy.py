"""What a rollout needs of a policy, and how the Transformer provides it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from envs.base import EnvSpec
from envs.errors import DataError
from mgpo_jax.seen_goals import SeenGoals
from mgpo_jax.transformer import (
    GoalTransformer,
    NetworkConfig,
    TransformerConfig,
    grow_cache,
)


class Policy(NamedTuple):
    """Acts step by step from a prompt; the functions are for one episode and are pure."""

    prefill: Callable
    """``(prompt, obs) -> (action distribution, carry)`` at the first observation."""
    decode: Callable
    """``(carry, action, obs) -> (action distribution, carry)`` after every step."""
    grow: Callable
    """``(carry, num_steps) -> carry`` with room for that many more decodes."""
    num_slots: int
    """P, the number of slots of the prompts that it takes: its longest prompt."""
    score: Callable | None = None
    """``(prompt, obs [T, ..], actions [T, ..]) -> action distributions [T]`` of an episode that took these
    actions, all at once. Prompt optimizers that ask the policy for likelihoods need it."""


class LoadedPolicy(NamedTuple):
    """A network, its weights and how it was made."""

    config: Any
    """The network's sizes, a ``transformer.NetworkConfig``; of the policy that follows prompts a
    ``TransformerConfig``."""
    params: Any
    made: dict[str, Any]
    sha256: str = ""
    """Of the file of weights; empty for weights that were never on disk."""
    folder: Path | None = None
    """Where it was read."""
    seen_goals: SeenGoals | None = None
    """The goals it was trained on; None for a policy that did not keep them."""

    @property
    def policy(self) -> Policy:
        """The network as functions that act."""
        return transformer_policy(self.config, self.params)


def check_fits(config: NetworkConfig, spec: EnvSpec, who: str = "the policy") -> None:
    """Raise ``DataError`` if a network was made for another world than that of ``spec``."""
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
    network = GoalTransformer(config)

    def prefill(prompt: Any, obs: Any) -> Any:
        return network.apply(params, prompt, obs, method="prefill")

    def decode(carry: Any, action: Any, obs: Any) -> Any:
        return network.apply(params, carry, action, obs, method="decode")

    def grow(cache: Any, num_steps: int) -> Any:
        return grow_cache(cache, config.tokens_per_step * num_steps)

    def score(prompt: Any, obs: Any, actions: Any) -> Any:
        return network.apply(params, prompt, obs, actions)

    return Policy(prefill, decode, grow, config.max_prompt_length, score)
