"""The low level of SPiRL: skills in a latent space, and a prior over them (paper, appendix F.2, Table 9).

An encoder q(z | o_t, a_t .. a_{t+k-1}) encodes k actions, a decoder pi(a_t .. a_{t+k-1} | o_t, z)
reconstructs them, and a prior p(z | o_t) is fitted to samples of the encoder. The history h_t, on which the
paper conditions as well, is left out, as in the code of SPiRL (clvrai/spirl). The loss of that code is a
sum of three terms: the negative log-likelihood of the reconstruction, averaged over steps and dimensions;
beta times KL(q, N(0, I)), averaged over latent dimensions; and the prior's negative log-likelihood of a
sample, with no gradient into the encoder. Here the likelihood is that of the world's action head, where
their code uses a unit Gaussian, and the decoder is not autoregressive, so that all k distributions are
known when a skill begins.

The open loop decodes a skill from the observation at its start, as in the paper's text. With
``loop="closed"`` every step is decoded from its own observation, the variant that SPiRL's repository
recommends.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from annotated_types import Ge, Le
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from envs.agents import Agent
from envs.base import Trajectory
from envs.registry import Judgement
from mgpo_jax.baselines.hierarchy import LowLevel, Mlp, hierarchical
from mgpo_jax.distributions import HEADS, Distribution
from mgpo_jax.kinds import Learned
from mgpo_jax.losses import Stats, blurred, stats_of
from mgpo_jax.network_configs import NetworkConfig
from mgpo_jax.rollout import act, acting_as
from mgpo_jax.schema import STRICT
from mgpo_jax.settings import NotNegative, NumLayers, Width

MIN_LOG_STD, MAX_LOG_STD = -10.0, 2.0  # clvrai/spirl


@dataclass(frozen=True)
class SkillConfig(NetworkConfig):
    """Config of the networks. Values in brackets are those of Table 9."""

    __pydantic_config__ = STRICT

    embed_dim: Width = 128
    """Width of all layers."""
    num_layers: NumLayers = 3
    """Number of hidden layers of the prior and of a closed-loop decoder."""
    skill_steps: Annotated[int, Ge(1), Le(10_000)] = 10
    """k, the number of steps of a skill [10]."""
    latent_dim: Annotated[int, Ge(1), Le(4_096)] = 10
    """Dimension L of the latent z [10]."""
    beta: NotNegative = 5e-4
    """Weight of the divergence of the encoder from N(0, I) [5e-4]."""
    loop: Literal["open", "closed"] = "open"
    """Whether all steps of a skill are decoded from its first observation (``open``), or each step from its
    own (``closed``)."""


class Normal(NamedTuple):
    """A diagonal Gaussian over latents, whose samples are not clipped."""

    mean: Float[Array, "*batch L"]
    log_std: Float[Array, "*batch L"]

    def sample(self, key: PRNGKeyArray) -> Float[Array, "*batch L"]:
        return self.mean + jnp.exp(self.log_std) * jax.random.normal(key, self.mean.shape)

    def log_prob(self, latent: Float[Array, "*batch L"]) -> Float[Array, "*batch"]:
        found = jax.scipy.stats.norm.logpdf(latent, self.mean, jnp.exp(self.log_std))
        return jnp.sum(found, axis=-1)

    def kl(self, other: Normal) -> Float[Array, "*batch"]:
        """KL(self, other) in nats."""
        shift = (self.mean - other.mean) * jnp.exp(-other.log_std)
        log_ratio = self.log_std - other.log_std
        return jnp.sum((jnp.exp(2 * log_ratio) + shift**2 - 1) / 2 - log_ratio, axis=-1)


def standard(latent_dim: int) -> Normal:
    """N(0, I)."""
    return Normal(jnp.zeros(latent_dim), jnp.zeros(latent_dim))


def normal_of(params: Float[Array, "*batch L2"]) -> Normal:
    """The Gaussian whose means and log standard deviations are the outputs of a layer."""
    mean, log_std = jnp.split(params, 2, axis=-1)
    return Normal(mean, jnp.clip(log_std, MIN_LOG_STD, MAX_LOG_STD))


class SkillNetwork(nn.Module):
    """The encoder, the decoder and the prior of skills."""

    config: SkillConfig

    def setup(self) -> None:
        config = self.config
        width = config.embed_dim
        self.embed_obs = config.make_encoder(width)
        self.read_actions: Any = nn.RNN(nn.OptimizedLSTMCell(width), return_carry=True)
        self.posterior_head = nn.Sequential(
            [nn.Dense(width), nn.relu, nn.Dense(2 * config.latent_dim)]
        )
        self.prior_head = Mlp(2 * config.latent_dim, width, config.num_layers)
        num_outputs = HEADS[config.head].num_params(config.action_dim)
        if config.loop == "open":
            self.write_actions: Any = nn.RNN(nn.OptimizedLSTMCell(width))
            self.action_head: Any = nn.Dense(num_outputs)
        else:
            self.action_head = Mlp(num_outputs, width, config.num_layers)

    def embedded(self, obs: Shaped[Array, "..."]) -> Float[Array, "*batch E"]:
        """The embeddings of observations, which the other parts of the network take."""
        token: Array = nn.relu(self.embed_obs(self.config.standardized(obs)))
        return token

    def posterior(self, seen: Float[Array, "W E"], actions: Shaped[Array, "W k ..."]) -> Normal:
        """q(z | o_t, a_t .. a_{t+k-1}) of W windows."""
        numbers = self.config.action_numbers(actions)
        first = jnp.broadcast_to(seen[:, None], (*numbers.shape[:2], seen.shape[-1]))
        (_, last), _ = self.read_actions(jnp.concatenate([numbers, first], axis=-1))
        return normal_of(self.posterior_head(last))

    def prior(self, seen: Float[Array, "*batch E"]) -> Normal:
        """p(z | o_t)."""
        return normal_of(self.prior_head(seen))

    def decoded(
        self, seen: Float[Array, "*batch k E"], latent: Float[Array, "*batch L"]
    ) -> Distribution:
        """Action distributions of the steps of a skill, [*batch, k].

        ``seen`` holds the embedded observations of its steps; the open loop uses only the first one.
        """
        steps = seen.shape[-2]
        every = jnp.broadcast_to(latent[..., None, :], (*seen.shape[:-1], latent.shape[-1]))
        if self.config.loop == "open":
            first = jnp.broadcast_to(seen[..., :1, :], seen.shape)
            x = jnp.concatenate([first, every], axis=-1)
            rows = self.write_actions(x.reshape(-1, steps, x.shape[-1]))
            x = rows.reshape(*seen.shape[:-1], -1)
        else:
            x = jnp.concatenate([seen, every], axis=-1)
        return HEADS[self.config.head].make(self.action_head(x))

    def __call__(self, key: PRNGKeyArray, obs: Any, actions: Any) -> Reading:
        """Encode W windows of k steps, sample a latent for each, and decode it."""
        seen = self.embedded(obs)
        posterior = self.posterior(seen[:, 0], actions)
        latent = posterior.sample(key)
        # No gradient of the prior reaches the encoder or the embedding of observations.
        prior = self.prior(jax.lax.stop_gradient(seen[:, 0]))
        return Reading(posterior, latent, prior, self.decoded(seen, latent))


class Reading(NamedTuple):
    """The networks' outputs for W windows of k steps."""

    posterior: Normal
    latent: Float[Array, "W L"]
    prior: Normal
    actions: Distribution
    """The decoded action distributions, [W, k]."""


def windows(
    key: PRNGKeyArray, length: Int[Array, ""], num_steps: int, skill_steps: int
) -> tuple[Int[Array, "W k"], Any]:
    """Cut an episode into consecutive windows of k steps, starting at a random step below k.

    Returns:
      The indices of the steps of W windows, and which windows lie within the episode, bool [W].
    """
    offset = jax.random.randint(key, (), 0, skill_steps)
    num = max(num_steps // skill_steps, 1)
    start = offset + skill_steps * jnp.arange(num)
    steps = start[:, None] + jnp.arange(skill_steps)
    return jnp.minimum(steps, num_steps - 1), start + skill_steps <= length


def skill_loss(
    params: Any,
    key: PRNGKeyArray,
    config: SkillConfig,
    trajectory: Trajectory,
    deterministic: bool = False,
    obs_noise: float = 0.0,
) -> tuple[Float[Array, ""], Stats]:
    """The loss of the windows of one trajectory, summed over their steps; see the module docstring.

    The parts ``kl`` and ``prior`` of the statistics are in nats per step.
    """
    key_windows, key_latent, key_noise = jax.random.split(key, 3)
    if obs_noise and not deterministic:
        trajectory = blurred(key_noise, trajectory, obs_noise)
    steps, counts = windows(key_windows, trajectory.length, len(trajectory.obs), config.skill_steps)
    obs, labels = trajectory.obs[steps], trajectory.labels[steps]
    network: Any = SkillNetwork(config)
    reading: Reading = network.apply(params, key_latent, obs, labels)
    k, latent = config.skill_steps, jax.lax.stop_gradient(reading.latent)
    divergence = reading.posterior.kl(standard(config.latent_dim))
    surprise = -reading.prior.log_prob(latent)
    every = jnp.broadcast_to(counts[:, None], steps.shape)
    spread = lambda values: jnp.broadcast_to(values[:, None] / k, steps.shape)  # noqa: E731
    stats = stats_of(reading.actions, labels, every, kl=spread(divergence), prior=spread(surprise))
    dimensions = 1 if config.head == "categorical" else config.action_dim
    weight = config.beta * k / config.latent_dim
    loss = stats.nll / dimensions + weight * stats.parts["kl"] + stats.parts["prior"]
    return loss, stats


class Carry(NamedTuple):
    """The memory of the low level."""

    seen: Float[Array, "*batch E"]
    """The latest observation, embedded."""


def low_level(config: SkillConfig, params: Any, judged: Judgement) -> LowLevel:
    """The decoder as the low level; a decision is a latent, and a view an embedded observation.

    Args:
      config: the networks' config.
      params: their parameters.
      judged: how actions are chosen. Training episodes use the same way as judging ones.
    """
    network: Any = SkillNetwork(config)
    params = config.prepared(params)
    greedy, temperature = acting_as(judged)

    def see(obs: Array) -> tuple[Array, Carry]:
        seen = network.apply(params, obs, method="embedded")
        return seen, Carry(seen)

    def decoded(seen: Array, latent: Array, steps: int) -> Any:
        rows = jnp.broadcast_to(seen, (steps, *seen.shape))
        return network.apply(params, rows, latent, method="decoded")

    def command(carry: Carry, latent: Float[Array, "L"]) -> Any:
        if config.loop == "open":
            return decoded(carry.seen, latent, config.skill_steps)
        return latent

    def act_on(key: PRNGKeyArray, carry: Carry, orders: Any, index: Int[Array, ""]) -> Array:
        closed = config.loop == "closed"
        rows, at = (decoded(carry.seen, orders, 1), 0) if closed else (orders, index)
        distribution = jax.tree.map(lambda leaf: leaf[at], rows)
        return act(key, distribution, greedy, temperature)

    return LowLevel(
        begin=see,
        proceed=lambda carry, action, obs: see(obs),
        command=command,
        act=act_on,
    )


def prior_of(config: SkillConfig, params: Any, seen: Array) -> Normal:
    """p(z | o_t), given the embedded observation."""
    network: Any = SkillNetwork(config)
    found: Normal = network.apply(params, seen, method="prior")
    return found


def prior_agent(config: SkillConfig, params: Any, judged: Judgement) -> Agent:
    """The agent that follows skills drawn from the prior, which does not depend on the task."""

    def decide(key: PRNGKeyArray, seen: Array, state: Any) -> tuple[Array, tuple]:
        del state
        return prior_of(config, params, seen).sample(key), ()

    return hierarchical(
        low_level(config, params, judged), decide, config.skill_steps, config.horizon
    )


def init(key: PRNGKeyArray, config: SkillConfig) -> Any:
    """Randomly initialized parameters."""
    obs, actions = (row[None] for row in config.blank_episode(config.skill_steps))
    return SkillNetwork(config).init(key, jax.random.key(0), obs, actions)


def facts(config: SkillConfig) -> dict[str, str]:
    """The facts about the networks for a model card."""
    return {
        "network": f"layers of width {config.embed_dim}, {config.loop} loop",
        "skills": f"{config.skill_steps} steps, latents of {config.latent_dim} numbers",
    }


SKILLS = Learned(config=SkillConfig, init=init, loss=skill_loss, agent=prior_agent, facts=facts)
