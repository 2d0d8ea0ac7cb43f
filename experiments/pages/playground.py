"""The playground: a page in which anyone guides a frozen policy, and a search finds prompts for it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from flax.traverse_util import flatten_dict

from envs.errors import UsageError
from envs.registry import World
from experiments.pages.build import SCRIPTS, html, script_of
from experiments.pages.packing import packed
from experiments.pages.worlds import page_of, tasks_in_page
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.policy_files import load_policy
from mgpo_jax.seen_goals import SeenGoals
from mgpo_jax.tasks import test_tasks

ENTRY = SCRIPTS / "playground.js"
NETWORK = (
    "goal_dim", "action_dim", "horizon", "max_prompt_length", "embed_dim", "num_layers", "num_heads",
    "obs_mean", "obs_std",
)  # fmt: skip
"""The entries of a network's config that the decoder in the page needs."""


def playground(worlds: Sequence[World], policy: Path | None = None) -> str:
    """Make the page of some worlds, with their released policies or the one in a folder.

    Raises:
      UsageError: if a page cannot run a world or a policy, or there is no such policy.
      DataError: if a policy is damaged or does not fit its world.
    """
    entries = [world_data(world, load_policy(world, policy)) for world in worlds]
    scripts = [page_of(world).script for world in worlds]
    body = (SCRIPTS / "playground.html").read_text(encoding="utf-8")
    return html(body, script_of(ENTRY, scripts), {"worlds": entries})


def world_data(world: World, policy: LoadedPolicy) -> dict[str, Any]:
    """The data of the page on one world and its policy, as JSON values."""
    page, spec, network = page_of(world), world.make().spec, policy.config
    if page.script is None or page.track is not None:
        raise UsageError(
            f"no playground can be made of {world.name}: its page (World.page) does not implement the "
            "rules of the world"
        )
    form = (network.head, network.encoder, network.tokens_per_step)
    if form != ("categorical", "linear", 2):
        raise UsageError(
            f"the policy of {world.name} has the head {form[0]}, the encoder {form[1]} and {form[2]} "
            "token(s) per step; a playground supports only the head categorical with the encoder linear "
            "and 2 tokens per step"
        )
    return {
        "name": world.name,
        "summary": world.summary,
        "facts": dict(page.facts),
        "tasks": tasks_in_page(page, test_tasks(world)),
        "network": {name: getattr(network, name) for name in NETWORK},
        "weights": packed(half_weights(policy)),
        "seen": _seen(policy.seen_goals),
        "sha256": policy.sha256,
        "returnSpan": spec.return_range[1] - spec.return_range[0],
        "deterministic": spec.deterministic,
        "keepRewarded": spec.reward_confirms_goals,
    }


def _seen(seen: SeenGoals | None) -> dict[str, Any] | None:
    """The goals of the training as JSON values."""
    return seen and {"goals": packed({"goals": seen.goals}), "reach": seen.limit}


def half_weights(policy: LoadedPolicy) -> dict[str, np.ndarray]:
    """The weights in half precision, by name.

    Raises:
      UsageError: if a weight is too large for half precision.
    """
    flat = flatten_dict(policy.params["params"], sep="/")
    halves = {}
    for name, leaf in flat.items():
        with np.errstate(over="ignore"):
            halves[name] = np.asarray(leaf).astype(np.float16)
        if not np.isfinite(halves[name]).all():
            raise UsageError(
                f"the weight {name} of the policy is above 65504, the largest number of half precision, in "
                "which a playground keeps weights"
            )
    return halves
