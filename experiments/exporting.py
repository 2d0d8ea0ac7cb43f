"""Export a policy for runtimes other than jax, with metadata about it."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

from envs.errors import MissingExtraError, UsageError
from envs.installing import how_to_install
from envs.registry import World
from mgpo_jax.files import to_json, written
from mgpo_jax.network_configs import OBS_LIMIT, TransformerConfig
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.policy_files import load_policy

KEY = "mgpo_jax"  # key of our facts in the metadata of a model


def check_extra() -> None:
    """Raise ``MissingExtraError`` if onnx is not installed, without importing it."""
    if importlib.util.find_spec("onnx") is None:
        raise MissingExtraError(f"an export needs the package onnx: {how_to_install('onnx')}")


def check_exportable(config: TransformerConfig, name: str) -> None:
    """Raise ``UsageError`` for a network that cannot be exported."""
    if config.head != "categorical" or config.encoder != "linear":
        raise UsageError(
            f"the policy of {name} has the head {config.head} and the encoder {config.encoder}; an export "
            "supports only the head categorical with the encoder linear"
        )


def prefill_path(out: Path) -> Path:
    """The file of the model that reads the prompt, beside that of the model of one step."""
    return out.with_name(f"{out.stem}_prefill{out.suffix}")


def export_onnx(world: World, policy_folder: Path | None, out: Path) -> None:
    """Write the released policy of a world, or the one in a folder, as two ONNX files.

    Raises:
      UsageError: if there is no such policy, or its network cannot be exported.
      DataError: if the policy is damaged or does not fit the world.
      MissingExtraError: if onnx is not installed.
    """
    policy = load_policy(world, policy_folder)
    check_exportable(policy.config, world.name)
    facts = {KEY: json.dumps(facts_of(world, policy), allow_nan=False)}
    check_extra()
    from experiments.onnx_graphs import prefill_graph, step_graph

    for path, make in ((prefill_path(out), prefill_graph), (out, step_graph)):
        with written(path) as partial:
            partial.write_bytes(make(policy, facts).SerializeToString())


def facts_of(world: World, policy: LoadedPolicy) -> dict[str, Any]:
    """The facts that a program needs to run the models, as JSON values."""
    config, spec = policy.config, world.make().spec
    return {
        "world": world.name,
        "spec": {
            "obs_shape": list(spec.obs.shape),
            "obs_dtype": str(spec.obs.dtype),
            "goal_dim": spec.goal_dim,
            "num_actions": spec.action_dim,
            "horizon": spec.horizon,
        },
        "network": to_json(
            {
                "max_prompt_length": config.max_prompt_length,
                "tokens_per_step": config.tokens_per_step,
                "num_layers": config.num_layers,
                "num_heads": config.num_heads,
                "embed_dim": config.embed_dim,
            }
        ),
        # For information only: the models standardize observations themselves.
        "standardization": {
            "mean": list(config.obs_mean),
            "std": list(config.obs_std),
            "limit": OBS_LIMIT,
        },
        "weights_sha256": policy.sha256,
    }
