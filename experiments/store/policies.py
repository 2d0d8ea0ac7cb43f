"""The policy that an adaptation was made with."""

from __future__ import annotations

from pathlib import Path

from envs.errors import DataError
from envs.registry import World, find
from experiments.store.results import Results
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.policy_files import load_policy, released_folder


def load_policy_of(results: Results, world: World) -> LoadedPolicy:
    """The policy that an adaptation was made with, checked against a world to act in.

    Raises:
      DataError: if there are other weights at its place by now, or it does not fit the world.
    """
    path = results.config.get("policy")
    folder = Path(path) if path else released_folder(find(results.env))
    policy = load_policy(world, folder)
    check_weights(results, policy, "adapt again with `python -m experiments.adapt`")
    return policy


def check_weights(results: Results, policy: LoadedPolicy, mend: str) -> None:
    """Raise ``DataError``, which ends in ``mend``, if an adaptation was made with other weights."""
    made_with = results.summary.get("policy_sha256", policy.sha256)
    if policy.sha256 != made_with:
        raise DataError(
            f"the weights in {policy.folder} ({policy.sha256[:12]}) are not those that the results of "
            f"{results.env} {results.method} were found with ({made_with[:12]}): " + mend
        )
