"""PTGM with PPO over clusters of goals, after its own code (PKU-RL/PTGM); not in Table 1 of the paper.

The low level is that of ``ptgm``. PTGM's own high level chooses among the centers of clusters of the goals
in its dataset. An adaptation knows only the frozen network, so that here the goals that the network can be
commanded with are clustered (``CommandConfig.commands``: in mazes all cells, walls included). Each of them
counts once, where in a dataset a goal counts as often as it is reached; the prior says how likely it is.
The prior of a cluster is the sum over its goals, those to which its own goal is the nearest: their network
learns the same from goals of demonstrations that are replaced by the nearest center.

PPO then trains a policy over clusters and its values by the rewards r' = R - w KL(pi, p), where R is the
undiscounted sum of the k rewards of a decision and pi the policy that chose. Their code trains the last
layers of a Transformer that reads earlier decisions. Here both are multilayer perceptrons of Table 10's
size, which see what the high level of ``ptgm`` sees, and a round is some whole episodes, all of which count
against the budget. Their policy for Minecraft is trained by far more decisions than 100 episodes have, at a
tenth of Table 10's learning rate. As in BC-finetune, nothing is bootstrapped at the end of an episode.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.agents import Agent
from envs.base import Episode, State
from envs.errors import UsageError
from mgpo_jax.adaptation import Adapter
from mgpo_jax.baselines.clusters import representatives
from mgpo_jax.baselines.commanded import (
    CommandConfig,
    View,
    log_prior,
    low_level,
    nearest_command,
)
from mgpo_jax.baselines.hierarchy import Choice, Mlp, Transitions, hierarchical, transitions
from mgpo_jax.baselines.methods import PtgmPpoHyper
from mgpo_jax.baselines.ptgm import input_width, seen_by
from mgpo_jax.baselines.returns import Estimates, estimates, ppo_loss
from mgpo_jax.distributions import Categorical
from mgpo_jax.methods import Setting

USUAL_CLUSTERS = 50
"""Number of clusters unless told otherwise, where there are as many goals: that of PTGM's kitchen."""


class Kept(NamedTuple):
    """The data of a decision that are kept for training."""

    seen: Float[Array, "*batch I"]
    """The input of the high level."""
    cluster: Int[Array, "*batch"]
    log_p: Float[Array, "*batch C"]
    """The prior over clusters."""


class Weights(NamedTuple):
    """The trained parameters."""

    actor: Any
    critic: Any


class Learner(NamedTuple):
    """The state of the high level on one task."""

    task_goal: Float[Array, "*batch G"]
    weights: Weights
    opt_state: Any


class Round(NamedTuple):
    """The K episodes of a round, with quantities that stay fixed during its gradient steps."""

    decisions: Transitions
    """Rows [K, M]; rewards include the penalty for leaving the prior."""
    log_before: Float[Array, "K M"]
    """Log-probabilities of the chosen clusters under the policy that chose them."""
    known: Estimates


def num_clusters(config: CommandConfig, hyper: PtgmPpoHyper) -> int:
    """C, the number of clusters.

    Raises:
      UsageError: if more are asked for than there are distinct goals.
    """
    most = len(set(config.commands))
    if hyper.clusters is not None and hyper.clusters > most:
        raise UsageError(
            f"--clusters {hyper.clusters} exceeds the {most} distinct goals that the low level can be "
            f"commanded with; with --clusters {most} each goal is its own cluster"
        )
    return hyper.clusters or min(USUAL_CLUSTERS, most)


class ClusteredPtgm:
    """PTGM by PPO over clusters of goals on one task; all methods are pure.

    Args:
      setting: the setting (``methods.Setting``).
      params: the parameters of the low level.
      hyper: the hyper-parameters of the high level.
    """

    def __init__(self, setting: Setting, params: Any, hyper: PtgmPpoHyper) -> None:
        self.low_params, self.hyper = params, hyper
        self.config: CommandConfig = setting.network
        goals = np.array(self.config.commands)
        self.codes = representatives(goals, num_clusters(self.config, hyper))
        """The command of each cluster."""
        self.actor: Any = Mlp(len(self.codes), starts_at_zero=True)
        self.critic: Any = Mlp(1, starts_at_zero=True)
        self.low = low_level(self.config, params, setting.judged)
        self.optimize = optax.chain(
            optax.clip_by_global_norm(hyper.clip_norm), optax.adam(hyper.learning_rate)
        )

    def adapter(self) -> Adapter:
        return Adapter(
            init=self.init,
            ask=lambda key, state: (Choice(jnp.zeros((), bool)), state),
            agent=self.agent,
            tell=self.tell,
            best=lambda state: Choice(jnp.ones((), bool)),
            episodes_per_round=self.hyper.round_episodes,
            tell_in_turn=True,
        )

    def init(self, key: PRNGKeyArray, task_goal: Float[Array, "G"]) -> Learner:
        key_actor, key_critic = jax.random.split(key)
        blank = jnp.zeros(input_width(self.config, self.hyper))
        weights = Weights(self.actor.init(key_actor, blank), self.critic.init(key_critic, blank))
        return Learner(task_goal, weights, self.optimize.init(weights))

    def log_prior(self, view: View) -> Float[Array, "C"]:
        """log p(c | h_t, o_t) of all C clusters, each of which has the goals nearest to its own."""
        goals = self.config.goals
        of_cluster = jax.nn.one_hot(
            nearest_command(goals, goals[self.codes]), len(self.codes), axis=0
        )
        log_p = log_prior(self.config, self.low_params, view)
        return jax.nn.logsumexp(log_p, b=of_cluster, axis=-1)

    def policy(
        self, weights: Weights, seen: Float[Array, "*batch I"], log_p: Float[Array, "*batch C"]
    ) -> Categorical:
        """pi(c | o_t)."""
        logits: Array = self.actor.apply(weights.actor, seen)
        return Categorical(logits + log_p if self.hyper.starts_as_prior else logits)

    def values(self, weights: Weights, seen: Float[Array, "*batch I"]) -> Float[Array, "*batch"]:
        """V(o_t)."""
        found: Array = self.critic.apply(weights.critic, seen)
        return found[..., 0]

    def agent(self, state: Learner, choice: Choice) -> Agent:
        def decide(key: PRNGKeyArray, view: View, world: State) -> tuple[Array, Kept]:
            del world
            seen, log_p = seen_by(self.hyper, view, state.task_goal), self.log_prior(view)
            policy = self.policy(state.weights, seen, log_p)
            cluster = jnp.where(choice.greedy, policy.mode(), policy.sample(key))
            return jnp.asarray(self.codes)[cluster], Kept(seen, cluster, log_p)

        return hierarchical(self.low, decide, self.config.skill_steps, self.config.horizon)

    def tell(self, key: PRNGKeyArray, state: Learner, choice: Choice, episodes: Episode) -> Learner:
        """Update the high level with the episodes of a round, all of whose decisions are one batch."""
        del key, choice
        round_ = self.read(state.weights, episodes)

        def epoch(index: Array, carry: tuple[Weights, Any]) -> tuple[Weights, Any]:
            del index
            weights, opt_state = carry
            grads = jax.grad(self.loss)(weights, round_)
            updates, opt_state = self.optimize.update(grads, opt_state, weights)
            moved: Any = optax.apply_updates(weights, updates)
            return moved, opt_state

        start = (state.weights, state.opt_state)
        weights, opt_state = jax.lax.fori_loop(0, self.hyper.epochs, epoch, start)
        return state._replace(weights=weights, opt_state=opt_state)

    def read(self, weights: Weights, episodes: Episode) -> Round:
        """What a round's episodes say, which were run with these weights."""
        hyper, steps = self.hyper, self.config.skill_steps
        made = jax.vmap(lambda episode: transitions(episode, steps))(episodes)
        kept: Kept = made.kept
        policy = self.policy(weights, kept.seen, kept.log_p)
        penalty = hyper.kl * policy.kl(Categorical(kept.log_p))
        rewards = jnp.where(made.valid, made.reward - penalty, 0.0)
        values = self.values(weights, kept.seen)
        known = estimates(rewards, values, made.valid, hyper.discount, hyper.gae_lambda)
        return Round(made._replace(reward=rewards), policy.log_prob(kept.cluster), known)

    def loss(self, weights: Weights, round_: Round) -> Float[Array, ""]:
        """The loss of PPO."""
        kept, valid = round_.decisions.kept, round_.decisions.valid
        policy = self.policy(weights, kept.seen, kept.log_p)
        log_ratio = policy.log_prob(kept.cluster) - round_.log_before
        values, hyper = self.values(weights, kept.seen), self.hyper
        return ppo_loss(log_ratio, values, round_.known, valid, hyper.clip, hyper.value_weight)


def make_ptgm_ppo(setting: Setting, params: Any, hyper: PtgmPpoHyper) -> Adapter:
    return ClusteredPtgm(setting, params, hyper).adapter()


def check_ptgm_ppo(setting: Setting, hyper: PtgmPpoHyper) -> None:
    """Raise ``UsageError`` if there are fewer goals than clusters."""
    num_clusters(setting.network, hyper)
