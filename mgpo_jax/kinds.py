"""Kinds of pre-trained networks: the multi-goal policy, and the networks that other methods need.

A kind determines what ``experiments.pretrain --method`` trains: the network, its loss, and the returns that
are monitored. A policy on disk names its kind. Kinds are found in the same way as worlds; an installed
package can add more under the entry-point group ``mgpo_jax.kinds``. Nothing here imports jax.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from envs.errors import UsageError
from envs.registry import Registry, imported

if TYPE_CHECKING:
    from envs.agents import Agent
    from mgpo_jax.network_configs import NetworkConfig

MULTI_GOAL = "mgpo"
"""The kind of the paper's policy, which follows prompts."""


def _unchanged(config: Any, env: Any, dataset: Any) -> Any:
    del env, dataset
    return config


@dataclass(frozen=True, kw_only=True)
class Learned:
    """The functions that make up a kind of network.

    Attributes:
      config: the frozen dataclass of its config, which derives from ``network_configs.NetworkConfig``.
        Fields that are also settings of pre-training (``PretrainConfig``) are taken from there.
      init: ``(key, config) -> params``, randomly initialized parameters.
      loss: ``(params, key, config, trajectory, deterministic, obs_noise) -> (loss, stats)`` of one
        trajectory, summed over its steps; see ``losses.bc_loss``.
      complete: ``(config, env, dataset) -> config``, completed with what comes from the world and its data.
        Raises ``UsageError`` if there is no such network for the world.
      agent: ``(config, params, judged) -> Agent`` whose returns are monitored during training: the network
        acting by itself, before any method has adapted it. None for the multi-goal policy, which is
        monitored under prompts.
      facts: ``(config) -> rows`` of a released network's model card, texts by name; one is ``network``.
      fault: ``(config) -> text``, what is wrong with a config that was read from disk, beyond types and
        ranges; None if nothing is.
      starts_from: other kinds, by name, whose networks a training may start from. Parameters with the same
        names and shapes are taken over from them, and the others start from random values.
    """

    config: type[NetworkConfig]
    init: Callable[[Any, Any], Any]
    loss: Callable[..., Any]
    complete: Callable[[Any, Any, Any], Any] = _unchanged
    agent: Callable[[Any, Any, Any], Agent] | None = None
    facts: Callable[[Any], Mapping[str, str]] = lambda config: {"network": "custom architecture"}
    fault: Callable[[Any], str | None] = lambda config: None
    starts_from: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of pre-trained network.

    Attributes:
      name: its name, as given to ``pretrain --method``; also the name of the subfolder of a world's
        released policy that holds its weights.
      learned: the functions that make it up, or their place as ``module:attribute``.
      title: its name in the title of a model card.
      watched: a description of the agent whose returns are monitored during training.
      preset: settings in which it differs from the presets of all worlds, by name; only the preset
        ``smoke`` may replace them.
      settings: the settings of pre-training that apply to no other kind.
      summary: a one-line description.
    """

    name: str
    learned: str | Learned
    title: str
    watched: str
    preset: Mapping[str, Any] = field(default_factory=dict)
    settings: tuple[str, ...] = ()
    summary: str = ""

    def load(self) -> Learned:
        """Import the functions that make up the kind."""
        if not isinstance(self.learned, str):
            return self.learned
        found: Learned = imported(self.learned)
        return found


PROMPTED = Kind(
    name=MULTI_GOAL,
    learned="mgpo_jax.losses:PROMPTED",
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
    preset={  # the learning rate is that of Table 9
        "optimizer": "adamw",
        "learning_rate": 1e-3,
        "warmup_steps": 300,
        "schedule": "cosine",
        "clip_norm": 1.0,
        "steps": 8_000,
    },
    settings=("loop",),
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
    """The kind that a network's config belongs to.

    Raises:
      UsageError: if no kind that is registered, or was found by its place, has such networks.
    """
    for kind in (*KINDS.usable(), *KINDS.loaded()):
        if kind.load().config is type(config):
            return kind
    raise UsageError(
        f"no kind of network has the config {type(config).__name__}; register the kind, or name it by its "
        "place first"
    )
