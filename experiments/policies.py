"""Policies to act with: the released one of a world, or a user's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from envs.base import Environment
from experiments.configs import PRETRAINED, make_env
from experiments.results import Results
from mgpo_jax.checkpoint import WEIGHTS, load_policy_files
from mgpo_jax.errors import DataError
from mgpo_jax.files import hash_file
from mgpo_jax.policy import Policy, transformer_policy
from mgpo_jax.transformer import TransformerConfig


class LoadedPolicy(NamedTuple):
    """A network, its weights and how it was made."""

    config: TransformerConfig
    params: Any
    made: dict[str, Any]
    sha256: str = ""
    """Of the file of weights; none for those that were never on disk."""
    folder: Path | None = None
    """Where it was read."""


def released_folder(env_name: str) -> Path:
    """Where the released policy and the test tasks of a world lie."""
    return PRETRAINED / env_name


def load_network(env: Environment, path: Path | None) -> LoadedPolicy:
    """The network in ``path`` (default: the released one), checked against the world."""
    folder = path or released_folder(env.spec.name)
    return LoadedPolicy(*load_policy_files(folder, env.spec), hash_file(folder / WEIGHTS), folder)


def load_network_of(result: Results, env: Environment) -> LoadedPolicy:
    """The network that an adaptation was made with, checked against ``env``.

    Raises:
      DataError: if there are other weights at its place by now, or it does not fit the world.
    """
    path = result.config.get("policy")
    folder = Path(path) if path else released_folder(make_env(result.config["env"]).spec.name)
    network = load_network(env, folder)
    check_weights(result, network, "adapt again with `python -m experiments.adapt`")
    return network


def check_weights(result: Results, network: LoadedPolicy, mend: str) -> None:
    """Raise ``DataError``, which ends in ``mend``, if an adaptation was made with other weights."""
    made_with = result.summary.get("policy_sha256", network.sha256)
    if network.sha256 != made_with:
        raise DataError(
            f"the weights in {network.folder} ({network.sha256[:12]}) are not those that the prompts of "
            f"{result.config['env']} {result.config['bandit']} were found with ({made_with[:12]}): "
            + mend
        )


def load_policy(env_name: str, path: Path | None = None) -> tuple[Environment, Policy]:
    """A world and a policy for it, ready for ``mgpo_jax.rollout.rollout``."""
    env = make_env(env_name)
    network = load_network(env, path)
    return env, transformer_policy(network.config, network.params)
