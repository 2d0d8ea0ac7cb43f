"""Policies to act with: the released one of a world, or a user's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from envs.base import Environment
from experiments.configs import PRETRAINED, make_env
from mgpo_jax.checkpoint import load_policy_files
from mgpo_jax.policy import Policy, transformer_policy
from mgpo_jax.transformer import TransformerConfig


class LoadedPolicy(NamedTuple):
    """A network, its weights and how it was made."""

    config: TransformerConfig
    params: Any
    made: dict[str, Any]


def released_folder(env_name: str) -> Path:
    """Where the released policy and the test tasks of a world lie."""
    return PRETRAINED / env_name


def load_network(env: Environment, path: Path | None) -> LoadedPolicy:
    """The network in ``path`` (default: the released one), checked against the world."""
    return LoadedPolicy(*load_policy_files(path or released_folder(env.spec.name), env.spec))


def load_policy(env_name: str, path: Path | None = None) -> tuple[Environment, Policy]:
    """A world and a policy for it, ready for ``mgpo_jax.rollout.rollout``."""
    env = make_env(env_name)
    network = load_network(env, path)
    return env, transformer_policy(network.config, network.params)
