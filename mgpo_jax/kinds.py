"""Kinds of pre-trained networks: the one that follows prompts, and those that other methods need.

A kind says what ``experiments.pretrain --method`` trains: the network, its loss, and what a run watches. A
policy on disk names its kind. Kinds are found as worlds are; an installed package can bring more under the
entry-point group ``mgpo_jax.kinds``. Nothing here imports jax.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from envs.registry import Registry

if TYPE_CHECKING:
    from envs.base import Agent
    from mgpo_jax.transformer import NetworkConfig

MULTI_GOAL = "mgpo"
"""The kind of the paper's policy, which follows prompts."""


def _as_it_is(config: Any, env: Any, dataset: Any) -> Any:
    del env, dataset
    return config


@dataclass(frozen=True, kw_only=True)
class Learned:
    """What a kind of network is made of.

    Attributes:
      config: the frozen dataclass of its sizes, which derives from ``transformer.NetworkConfig``. Those
        of its fields that are settings of a training (``PretrainConfig``) are taken from there.
      init: ``(key, config) -> params``, random weights.
      loss: ``(params, key, config, trajectory, deterministic, obs_noise) -> (loss, stats)`` of one
        trajectory, summed over its steps; see ``training.bc_loss``.
      complete: ``(config, env, dataset) -> config`` with what comes from the world and its data. Raises
        ``UsageError`` in a world for which there is no such network.
      agent: ``(config, params, judged) -> Agent`` whose returns a training watches: what the
        network does by itself before any method has learned anything. None for the multi-goal policy,
        which is watched under prompts.
      facts: ``(config) -> rows`` of a released network's card, texts by their names; one is ``network``.
      fault: ``(config) -> text``, what of a config that was read does not fit together, after types and
        ranges were found right; None if nothing.
    """

    config: type[NetworkConfig]
    init: Callable[[Any, Any], Any]
    loss: Callable[..., Any]
    complete: Callable[[Any, Any, Any], Any] = _as_it_is
    agent: Callable[[Any, Any, Any], Agent] | None = None
    facts: Callable[[Any], Mapping[str, str]] = lambda config: {"network": "of its own kind"}
    fault: Callable[[Any], str | None] = lambda config: None


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of pre-trained network.

    Attributes:
      name: what ``pretrain --method`` calls it, and the folder of its released weights in that of the
        world's policy.
      learned: what it is made of, or its place as ``module:attribute``.
      title: its name in the title of a card.
      watched: whose returns a training watches, in words.
      preset: what it changes in the settings of the world's presets, by the names of the settings.
      summary: what it is, in one line.
    """

    name: str
    learned: str | Learned
    title: str
    watched: str
    preset: Mapping[str, Any] = field(default_factory=dict)
    summary: str = ""

    def load(self) -> Learned:
        """What it is made of."""
        if not isinstance(self.learned, str):
            return self.learned
        module, _, attribute = self.learned.partition(":")
        found: Learned = getattr(importlib.import_module(module), attribute)
        return found


PROMPTED = Kind(
    name=MULTI_GOAL,
    learned="mgpo_jax.training:PROMPTED",
    title="Multi-goal Transformer",
    watched="the prompt (g^M)",
    summary="the multi-goal Transformer, which follows prompts",
)
COMMANDED = Kind(
    name="ptgm",
    learned="mgpo_jax.baselines.commanded:COMMANDED",
    title="Low level of PTGM",
    watched="goals drawn from the prior",
    summary="the low level of PTGM: a Transformer that is commanded one goal at a time, with a goal prior",
)

SKILLS = Kind(
    name="spirl",
    learned="mgpo_jax.baselines.skills:SKILLS",
    title="Skills of SPiRL",
    watched="skills drawn from the prior",
    summary="the low level of SPiRL: skills of ten steps in a latent space, with a prior",
    preset={"optimizer": "adamw", "learning_rate": 1e-3, "batch_size": 64, "steps": 6_000},
)

KINDS: Registry[Kind] = Registry(
    "kind of network",
    Kind,
    "mgpo_jax.kinds",
    {
        MULTI_GOAL: "mgpo_jax.kinds:PROMPTED",
        "ptgm": "mgpo_jax.kinds:COMMANDED",
        "spirl": "mgpo_jax.kinds:SKILLS",
    },
)


def kind_of(config: NetworkConfig) -> Kind:
    """The kind that a network's config belongs to."""
    return next(kind for kind in KINDS.usable() if kind.load().config is type(config))
