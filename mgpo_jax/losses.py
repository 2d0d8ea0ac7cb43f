"""What a multi-goal policy learns: behavior cloning with hindsight prompts (paper, section 3.1, Eq. 2).

The losses of other kinds of networks count their predictions with the same ``Stats``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PRNGKeyArray

from envs.base import Trajectory
from mgpo_jax.kinds import Learned
from mgpo_jax.network_configs import NetworkConfig, TransformerConfig
from mgpo_jax.prompts import hindsight_outcome, sample_prompt, single_goal
from mgpo_jax.transformer import GoalTransformer

HIT = 0.1  # per-dimension tolerance for counting a predicted action as correct


class Stats(NamedTuple):
    """Statistics of predictions, summed over real (not padded) steps."""

    nll: Float[Array, "*batch"]
    """Negative log-likelihood of the actions, in nats."""
    correct: Float[Array, "*batch"]
    """Number of steps at which the most likely action is the demonstrated (intended) one, within ``HIT`` in
    each dimension."""
    num_steps: Float[Array, "*batch"]
    parts: dict[str, Float[Array, "*batch"]]
    """Other terms of the loss by name, for kinds of networks that learn more than actions."""

    @property
    def divisor(self) -> Any:
        """The number of steps, or 1 where there are none."""
        return self.num_steps + (self.num_steps == 0)

    @property
    def means(self) -> dict[str, Any]:
        """Means over the steps, by metric name."""
        sums = {"loss": self.nll, "accuracy": self.correct, **self.parts}
        return {name: total / self.divisor for name, total in sums.items()}


def stats_of(distribution: Any, labels: Array, counts: Array, **parts: Array) -> Stats:
    """The statistics of predicted action distributions.

    Args:
      distribution: the predicted distributions, batched over [*steps].
      labels: the demonstrated (intended) actions, [*steps] or [*steps, A].
      counts: which steps count, bool [*steps].
      **parts: other terms of the loss at every step, [*steps].
    """

    def total(values: Array) -> Array:
        return jnp.sum(jnp.where(counts, values, 0.0))

    hits = jnp.abs(distribution.mode() - labels) <= HIT
    hits = jnp.all(hits.reshape(*counts.shape, -1), axis=-1)
    return Stats(
        nll=-total(distribution.log_prob(labels)),
        correct=jnp.sum(hits & counts).astype(jnp.float32),
        num_steps=counts.sum().astype(jnp.float32),
        parts={name: total(values) for name, values in parts.items()},
    )


def blurred(key: PRNGKeyArray, trajectory: Trajectory, largest: float) -> Trajectory:
    """The trajectory with Gaussian noise on its observations.

    The standard deviation is drawn once per trajectory, uniformly from [0, ``largest``]. A policy trained
    on exact observations alone relies on their last digits; one trained with a single noise level does
    worse on exact observations.
    """
    key_size, key_noise = jax.random.split(key)
    size = largest * jax.random.uniform(key_size)
    noise = size * jax.random.normal(key_noise, trajectory.obs.shape)
    noise = noise.astype(trajectory.obs.dtype)
    return trajectory._replace(obs=trajectory.obs + noise)


def bc_loss(
    params: Any,
    key: PRNGKeyArray,
    network: GoalTransformer,
    trajectory: Trajectory,
    deterministic: bool = False,
    obs_noise: float = 0.0,
) -> tuple[Float[Array, ""], Stats]:
    """-sum_t log pi(a_t | p, h_{t-1}, o_t) of one trajectory, with p ~ P(p | tau) (Eq. 2).

    The history h holds the executed actions. The target a_t is the action that the demonstrator intended,
    if the dataset has it, and otherwise the executed one.

    Args:
      params: the network's parameters.
      key: random key.
      network: the policy's network.
      trajectory: a demonstration, padded to T steps.
      deterministic: whether to disable dropout and noise.
      obs_noise: largest noise on observations, see ``TrainConfig`` (static; not in the paper).
    """
    key_prompt, key_dropout, key_noise = jax.random.split(key, 3)
    if obs_noise and not deterministic:
        trajectory = blurred(key_noise, trajectory, obs_noise)
    num_slots = network.config.max_prompt_length
    prompt = sample_prompt(key_prompt, trajectory, hindsight_outcome(trajectory), num_slots)
    distribution: Any = network.apply(
        params,
        prompt,
        trajectory.obs,
        trajectory.actions,
        deterministic or network.config.dropout == 0,
        rngs={"dropout": key_dropout},
    )
    real = jnp.arange(len(trajectory.obs)) < trajectory.length
    stats = stats_of(distribution, trajectory.labels, real)
    return stats.nll, stats


def batch_loss(
    params: Any,
    keys: Key[Array, "B"],
    part: Trajectory,
    deterministic: bool,
    learned: Learned,
    network: NetworkConfig,
    obs_noise: float,
) -> tuple[Float[Array, ""], Stats]:
    """The loss and statistics of a part of a batch, summed over its B trajectories."""

    def one(key: PRNGKeyArray, trajectory: Trajectory) -> tuple[Array, Stats]:
        return learned.loss(params, key, network, trajectory, deterministic, obs_noise)

    loss, stats = jax.vmap(one)(keys, part)
    return loss.sum(), jax.tree.map(jnp.sum, stats)


def initial_params(key: PRNGKeyArray, config: TransformerConfig) -> Any:
    """Randomly initialized parameters of a multi-goal policy."""
    prompt = single_goal(jnp.zeros(config.goal_dim), config.max_prompt_length)
    return GoalTransformer(config).init(key, prompt, *config.blank_episode())


def _prompted_loss(
    params: Any, key: PRNGKeyArray, config: TransformerConfig, *rest: Any
) -> tuple[Float[Array, ""], Stats]:
    return bc_loss(params, key, GoalTransformer(config), *rest)


def transformer_told(config: TransformerConfig) -> str:
    """The sizes of a Transformer as text."""
    return f"{config.num_layers} layers, width {config.embed_dim}, {config.num_heads} head(s)"


def _facts(config: TransformerConfig) -> dict[str, str]:
    order = "with" if config.prompt_order else "without"
    return {
        "network": transformer_told(config),
        "prompts": f"up to {config.max_prompt_length} goals, {order} position embeddings",
    }


PROMPTED = Learned(config=TransformerConfig, init=initial_params, loss=_prompted_loss, facts=_facts)
