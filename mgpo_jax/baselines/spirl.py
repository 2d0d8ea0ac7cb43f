"""SPiRL: soft actor-critic over pre-trained skills, near their prior (paper, appendix F.2, Table 9).

Every k steps the high level samples a latent z, and the low level (``skills``) decodes it into actions. The
high level is initialized with the prior p(z | o_t) and maximizes R - alpha KL(pi, p), where R is the
undiscounted sum of the k rewards and alpha is learned so that the divergence settles at a target, as in
clvrai/spirl. Here the divergence of the two Gaussians is computed in closed form, while that code draws ten
samples and squashes latents by 2 tanh. A decision that is cut short by the end of an episode does not
bootstrap.

Of the settings in Table 9, the discount, the batch size and the target interval belong to this level. The
paper does not give the target divergence, the number of decisions before the first update, nor the number
of updates. Here the prior acts in the first ten episodes, which count against the budget, and then there is
one update for every decision. Neither level sees the task goal, which shows only in the reward.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.agents import Agent
from envs.base import Episode, State
from envs.errors import UsageError
from mgpo_jax.adaptation import Adapter
from mgpo_jax.baselines.hierarchy import (
    Choice,
    Mlp,
    Replay,
    Transitions,
    draw,
    empty_replay,
    hierarchical,
    num_decisions,
    reference,
    remember,
    transitions,
)
from mgpo_jax.baselines.methods import SpirlHyper
from mgpo_jax.baselines.skills import (
    Normal,
    SkillConfig,
    low_level,
    normal_of,
    prior_agent,
    prior_of,
)
from mgpo_jax.methods import NoHyper, Setting
from mgpo_jax.trees import choose


class Kept(NamedTuple):
    """The data of a decision that are kept for training."""

    seen: Float[Array, "*batch E"]
    """The embedded observation."""
    latent: Float[Array, "*batch L"]


class Weights(NamedTuple):
    """The trained parameters."""

    actor: Any
    critics: Any
    """The parameters of the two critics, stacked."""
    log_alpha: Float[Array, "*batch"]


class Learner(NamedTuple):
    """The state of the high level on one task."""

    weights: Weights
    target: Any
    """The target critics."""
    opt_state: Any
    replay: Replay
    updates: Int[Array, "*batch"]
    episodes: Int[Array, "*batch"]


class Spirl:
    """SPiRL on one task; all methods are pure.

    Args:
      setting: the setting (``methods.Setting``).
      params: the parameters of the skill network.
      hyper: the hyper-parameters of the high level.
    """

    def __init__(self, setting: Setting, params: Any, hyper: SpirlHyper) -> None:
        self.setting, self.low_params, self.hyper = setting, params, hyper
        self.config: SkillConfig = setting.network
        config = self.config
        self.actor: Any = Mlp(2 * config.latent_dim, config.embed_dim, config.num_layers)
        self.critic: Any = Mlp(1)
        self.low = low_level(config, params, setting.judged)
        self.optimize = optax.adam(hyper.learning_rate)

    def adapter(self) -> Adapter:
        return Adapter(
            init=self.init,
            ask=lambda key, state: (Choice(jnp.zeros((), bool)), state),
            agent=self.agent,
            tell=self.tell,
            best=lambda state: Choice(jnp.asarray(self.hyper.judged_by == "mean")),
            tell_in_turn=True,
        )

    def init(self, key: PRNGKeyArray, task_goal: Float[Array, "G"]) -> Learner:
        del task_goal
        config = self.config
        blank = jnp.zeros(config.embed_dim + config.latent_dim)
        critics = jax.vmap(lambda key: self.critic.init(key, blank))(jax.random.split(key))
        # The actor is initialized with the prior, whose architecture it shares.
        actor = {"params": self.low_params["params"]["prior_head"]}
        weights = Weights(actor, critics, jnp.log(jnp.float32(self.hyper.alpha)))
        kept = Kept(jnp.zeros(config.embed_dim), jnp.zeros(config.latent_dim))
        per_episode = num_decisions(config.horizon, config.skill_steps)
        return Learner(
            weights=weights,
            target=critics,
            opt_state=self.optimize.init(weights),
            replay=empty_replay(kept, per_episode, self.setting.num_episodes),
            updates=jnp.zeros((), jnp.int32),
            episodes=jnp.zeros((), jnp.int32),
        )

    def policy(self, actor: Any, seen: Float[Array, "*batch E"]) -> Normal:
        """pi(z | o_t)."""
        return normal_of(self.actor.apply(actor, seen))

    def agent(self, state: Learner, choice: Choice) -> Agent:
        def decide(key: PRNGKeyArray, seen: Array, world: State) -> tuple[Array, Kept]:
            del world
            policy = self.policy(state.weights.actor, seen)
            latent = jnp.where(choice.greedy, policy.mean, policy.sample(key))
            return latent, Kept(seen, latent)

        return hierarchical(self.low, decide, self.config.skill_steps, self.config.horizon)

    def tell(self, key: PRNGKeyArray, state: Learner, choice: Choice, episodes: Episode) -> Learner:
        """Add an episode to the replay buffer, and update once for every decision in it."""
        del choice
        episode = jax.tree.map(lambda leaf: leaf[0], episodes)
        new = transitions(episode, self.config.skill_steps)
        state = state._replace(replay=remember(state.replay, new), episodes=state.episodes + 1)
        learns = state.episodes >= self.hyper.warmup_episodes
        num = jnp.where(learns, new.valid.sum(), 0)
        keys = jax.random.split(key, len(new.valid))
        return jax.lax.fori_loop(0, num, lambda i, state: self._update(keys[i], state), state)

    def _update(self, key: PRNGKeyArray, state: Learner) -> Learner:
        """Take one gradient step on a batch from the replay buffer."""
        key_draw, key_step = jax.random.split(key)
        now, after = draw(key_draw, state.replay, self.hyper.batch_size)
        return self.improved(key_step, state, now, after)

    def divergence(self, policy: Normal, seen: Float[Array, "B E"]) -> Float[Array, "B"]:
        """KL(pi, p) at B observations, in nats."""
        return policy.kl(prior_of(self.config, self.low_params, seen))

    def values(
        self, critics: Any, seen: Float[Array, "B E"], latent: Float[Array, "B L"]
    ) -> Float[Array, "2 B"]:
        """Q(o, z) by both critics."""
        pairs = jnp.concatenate([seen, latent], axis=-1)
        found: Array = jax.vmap(lambda critic: self.critic.apply(critic, pairs)[:, 0])(critics)
        return found

    def improved(
        self, key: PRNGKeyArray, state: Learner, now: Transitions, after: Transitions
    ) -> Learner:
        """Take one gradient step on transitions (``now``) and their successors (``after``)."""
        key_next, key_now = jax.random.split(key)
        actor, alpha = state.weights.actor, jnp.exp(state.weights.log_alpha)
        seen, then = now.kept.seen, after.kept.seen
        next_policy = self.policy(actor, then)
        next_values = self.values(state.target, then, next_policy.sample(key_next)).min(axis=0)
        worth = next_values - alpha * self.divergence(next_policy, then)
        wanted = now.reward + jnp.where(now.done, 0.0, self.hyper.discount * worth)

        def loss(weights: Weights) -> Array:
            missed = self.values(weights.critics, seen, now.kept.latent) - wanted
            policy = self.policy(weights.actor, seen)
            judges = jax.lax.stop_gradient(weights.critics)
            value = self.values(judges, seen, policy.sample(key_now)).min(axis=0)
            away = self.divergence(policy, seen)
            gap = jax.lax.stop_gradient(self.hyper.target_divergence - away)
            return (
                jnp.mean(missed**2, axis=1).sum() / 2
                + jnp.mean(jax.lax.stop_gradient(alpha) * away - value)
                + jnp.exp(weights.log_alpha) * jnp.mean(gap)
            )

        updates, opt_state = self.optimize.update(jax.grad(loss)(state.weights), state.opt_state)
        weights: Any = optax.apply_updates(state.weights, updates)
        count = state.updates + 1
        target = choose(count % self.hyper.target_interval == 0, weights.critics, state.target)
        return state._replace(weights=weights, target=target, opt_state=opt_state, updates=count)


def make_spirl(setting: Setting, params: Any, hyper: SpirlHyper) -> Adapter:
    return Spirl(setting, params, hyper).adapter()


def make_prior(setting: Setting, params: Any, hyper: NoHyper) -> Adapter:
    """The agent that draws skills from the prior in every episode, with which SPiRL starts."""
    del hyper
    agent = prior_agent(setting.network, params, setting.judged)
    return reference(agent, Choice(jnp.zeros((), bool)))


def check_spirl(setting: Setting, hyper: SpirlHyper) -> None:
    """Raise ``UsageError`` if the budget leaves no episode after the first update of the high level."""
    if setting.num_episodes <= hyper.warmup_episodes:
        raise UsageError(
            f"{setting.num_episodes} episodes leave none after the first update, which follows "
            f"--warmup-episodes {hyper.warmup_episodes}; raise --episodes, or lower --warmup-episodes"
        )
