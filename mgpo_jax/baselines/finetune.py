"""BC-finetune: fine-tunes the pre-trained network by policy gradients (paper, Tables 1, 7, 8).

The prompt is always (g^M). A round runs some episodes with sampled actions, and then updates the network's
weights by REINFORCE or PPO. Table 7 gives the discount, the learning rate, its "decay" and the number of
episodes in a round; everything else is ours, since the authors published no code for it. Actions are
sampled from the distribution of the pre-trained head; in the kitchen the authors sample with a fixed
standard deviation.

Everything is for one task, as in every adapter.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from envs.agents import Agent
from envs.base import Episode
from envs.errors import UsageError
from mgpo_jax.adaptation import Adapter
from mgpo_jax.baselines.methods import FinetuneHyper, PpoHyper, ReinforceHyper
from mgpo_jax.baselines.returns import estimates, ppo_loss, real_mean, returns_to_go
from mgpo_jax.baselines.subsets import Subset, subset
from mgpo_jax.distributions import Distribution
from mgpo_jax.methods import Setting
from mgpo_jax.optimizers.methods import judged_query
from mgpo_jax.policy import transformer_policy
from mgpo_jax.prompts import Prompt, single_goal
from mgpo_jax.rollout import Query, prompted
from mgpo_jax.transformer import GoalTransformer
from mgpo_jax.trees import choose


class ValueHead(NamedTuple):
    """A linear map from the network's features to the value of an observation."""

    weights: Float[Array, "*batch E"]
    bias: Float[Array, "*batch"]

    def __call__(self, features: Float[Array, "*T E"]) -> Float[Array, "*T"]:
        return features @ self.weights + self.bias


class Weights(NamedTuple):
    """The trained parameters."""

    policy: Any
    """The trained part of the network; see ``subsets``."""
    value: ValueHead


POLICY, VALUE = Weights._fields


class Learner(NamedTuple):
    """The state of fine-tuning on one task."""

    task_goal: Float[Array, "*batch G"]
    weights: Weights
    opt_state: Any
    rounds: Int[Array, "*batch"]
    """Number of rounds so far."""


class Batch(NamedTuple):
    """The K episodes of a round, with quantities that stay fixed during its gradient steps."""

    prompt: Prompt
    obs: Shaped[Array, "K T ..."]
    actions: Array
    rewards: Float[Array, "K T"]
    real: Bool[Array, "K T"]
    before: Distribution
    """The action distributions of the policy that ran the episodes, [K, T]."""
    pretrained: Distribution
    """The action distributions of the pre-trained network at the same observations, [K, T]."""
    values: Float[Array, "K T"]
    """Value estimates before the update."""


class Pass(NamedTuple):
    """The network's outputs for the episodes of a round."""

    actions: Distribution
    values: Float[Array, "K T"]


Loss = Callable[[Pass, Batch], Float[Array, ""]]


class Round(NamedTuple):
    """A policy-gradient algorithm: its loss and how it learns from a round."""

    loss: Callable[[Batch], Loss]
    """``(batch) -> ((pass, batch) -> loss)``: makes the loss of a round. What does not depend on the
    current weights, such as advantages, is computed once, before the first gradient step."""
    epochs: int = 1
    share_trunk: bool = False
    """Whether the value loss also trains the network below the value head."""
    value_rounds: Int[Array, ""] | int = 0
    """Number of rounds at the start in which only the value head is trained."""
    value_rate: Float[Array, ""] | float = 0.0
    max_kl: Float[Array, ""] | float | None = None


def optimizer(
    hyper: FinetuneHyper, value_rate: Any, warmth: Float[Array, ""] | float = 1.0
) -> optax.GradientTransformation:
    """AdamW with gradient clipping, separately for the policy and for the value head.

    Args:
      hyper: the hyper-parameters.
      value_rate: learning rate of the value head.
      warmth: factor in [0, 1] of the policy's learning rate.
    """

    def adamw(rate: Any) -> optax.GradientTransformation:
        return optax.chain(
            optax.clip_by_global_norm(hyper.clip_norm),
            optax.adamw(rate, weight_decay=hyper.weight_decay),
        )

    kinds = {"policy": adamw(hyper.learning_rate * warmth), "value": adamw(value_rate)}
    return optax.multi_transform(kinds, Weights._make([POLICY, VALUE]))


def with_policy(state: Any, source: Any) -> Any:
    """An optimizer's state in which the part of the policy is that of another state, ``source``."""
    parts = {**state.inner_states, POLICY: source.inner_states[POLICY]}
    return state._replace(inner_states=parts)


def repeated(num: int, epoch: Callable[[Array, Any], Any], start: Any, stops: bool) -> Any:
    """Run the epochs of a round.

    Args:
      num: the number of epochs.
      epoch: ``(index, carry) -> carry``. The last entry of the carry says whether to go on; an epoch that
        sets it to False leaves the others as they are.
      start: the first carry.
      stops: whether an epoch may set it to False; the remaining ones are then not computed.
    """
    if not stops:
        return jax.lax.fori_loop(0, num, epoch, start)
    _, carry = jax.lax.while_loop(
        lambda loop: (loop[0] < num) & loop[1][-1],
        lambda loop: (loop[0] + 1, epoch(*loop)),
        (jnp.zeros((), jnp.int32), start),
    )
    return carry


class Finetuner:
    """Fine-tuning by policy gradients on one task; all methods are pure.

    Args:
      setting: the setting (``methods.Setting``).
      params: the pre-trained parameters.
      hyper: the hyper-parameters that both algorithms share.
      how: the algorithm.
    """

    def __init__(self, setting: Setting, params: Any, hyper: FinetuneHyper, how: Round) -> None:
        self.setting, self.params, self.hyper, self.how = setting, params, hyper, how
        self.network = GoalTransformer(setting.network)
        self.part: Subset = subset(hyper.tune, params, hyper.rank)

    def adapter(self) -> Adapter:
        """The methods as an adapter."""
        return Adapter(
            init=self.init,
            ask=self.ask,
            agent=self.agent,
            tell=self.tell,
            best=lambda state: judged_query(self.prompt_of(state), self.setting.judged),
            episodes_per_round=self.hyper.round_episodes,
            tell_in_turn=True,
        )

    def init(self, key: PRNGKeyArray, task_goal: Float[Array, "G"]) -> Learner:
        value = ValueHead(jnp.zeros(self.setting.network.embed_dim), jnp.zeros(()))
        weights = Weights(self.part.start(key), value)
        opt_state = optimizer(self.hyper, self.how.value_rate).init(weights)
        return Learner(task_goal, weights, opt_state, jnp.zeros((), jnp.int32))

    def prompt_of(self, state: Learner) -> Prompt:
        """The prompt (g^M), which never changes."""
        return single_goal(state.task_goal, self.setting.network.max_prompt_length)

    def ask(self, key: PRNGKeyArray, state: Learner) -> tuple[Query, Learner]:
        del key
        temperature = jnp.ones(()) if self.setting.judged.tempered else None
        return Query(self.prompt_of(state), jnp.zeros((), bool), temperature), state

    def agent(self, state: Learner, query: Query) -> Agent:
        params = self.part.merge(state.weights.policy)
        return prompted(transformer_policy(self.setting.network, params), query)

    def tell(self, key: PRNGKeyArray, state: Learner, query: Query, episodes: Episode) -> Learner:
        """Update the weights with the episodes of a round."""
        del key
        batch = self._batch(state, query, episodes)
        loss_of = self.how.loss(batch)
        round_ = state.rounds - self.how.value_rounds  # of those that train the policy
        warmth = jnp.clip((round_ + 1) / jnp.maximum(self.hyper.warmup_rounds, 1), 0.0, 1.0)
        optimize = optimizer(self.hyper, self.how.value_rate, warmth)

        def loss(weights: Weights) -> tuple[Array, Array]:
            now = self._forward(weights, batch)
            away = real_mean(now.actions.kl(batch.pretrained), batch.real)
            moved = real_mean(batch.before.kl(now.actions), batch.real)
            return loss_of(now, batch) + self.hyper.kl * away, moved

        def epoch(index: Array, carry: tuple) -> tuple:
            del index
            weights, opt_state, going = carry
            grads, moved = jax.grad(loss, has_aux=True)(weights)
            if self.how.max_kl is not None:
                going = going & (moved <= self.how.max_kl)
            updates, new_state = optimize.update(grads, opt_state, weights)
            new = optax.apply_updates(weights, updates)
            new, new_state = choose(going, (new, new_state), (weights, opt_state))
            # While only the value head learns, the policy keeps its weights and its moments.
            held = new._replace(policy=weights.policy), with_policy(new_state, opt_state)
            new, new_state = choose(round_ >= 0, (new, new_state), held)
            return new, new_state, going

        start = (state.weights, state.opt_state, jnp.ones((), bool))
        weights, opt_state, _ = repeated(self.how.epochs, epoch, start, self.how.max_kl is not None)
        return state._replace(weights=weights, opt_state=opt_state, rounds=state.rounds + 1)

    def _batch(self, state: Learner, query: Query, episodes: Episode) -> Batch:
        trajectory = episodes.trajectory
        obs, actions = trajectory.obs, trajectory.actions
        merged = self.part.merge(state.weights.policy)
        before, features = self._outputs(merged, query.prompt, obs, actions)
        return Batch(
            prompt=query.prompt,
            obs=obs,
            actions=actions,
            rewards=episodes.rewards,
            real=jnp.arange(actions.shape[1]) < trajectory.length[:, None],
            before=before,
            pretrained=self._outputs(self.params, query.prompt, obs, actions)[0],
            values=state.weights.value(features),
        )

    def _outputs(
        self, params: Any, prompt: Prompt, obs: Array, actions: Array
    ) -> tuple[Distribution, Array]:
        """Action distributions and features at all steps of K episodes."""

        def one(obs: Array, actions: Array) -> Any:
            features = self.network.apply(params, prompt, obs, actions, method="features")
            return self.network.apply(params, features, method="read_out"), features

        seen: tuple[Distribution, Array] = jax.vmap(one)(obs, actions)
        return seen

    def _forward(self, weights: Weights, batch: Batch) -> Pass:
        merged = self.part.merge(weights.policy)
        actions, features = self._outputs(merged, batch.prompt, batch.obs, batch.actions)
        if not self.how.share_trunk:
            features = jax.lax.stop_gradient(features)
        return Pass(actions, weights.value(features))


def make_reinforce(setting: Setting, params: Any, hyper: ReinforceHyper) -> Adapter:
    """REINFORCE: -mean_t (G_t - b_t) log pi(a_t | g^M, h_t, o_t), with b_t = 0 unless asked for."""

    def loss_of(batch: Batch) -> Loss:
        togo = jax.vmap(returns_to_go, (0, None))(batch.rewards, hyper.discount)
        if hyper.baseline:
            togo = togo - togo.mean(axis=0)

        def loss(now: Pass, batch: Batch) -> Array:
            return -real_mean(togo * now.actions.log_prob_of_sample(batch.actions), batch.real)

        return loss

    return Finetuner(setting, params, hyper, Round(loss_of)).adapter()


def make_ppo(setting: Setting, params: Any, hyper: PpoHyper) -> Adapter:
    """PPO with clipped ratios (Schulman et al., 2017) and generalized advantage estimation.

    Advantages are normalized over the real steps of a round, whose episodes are one batch.
    """

    def loss_of(batch: Batch) -> Loss:
        values, discount = batch.values, hyper.discount
        known = estimates(batch.rewards, values, batch.real, discount, hyper.gae_lambda)
        old = jax.lax.stop_gradient(batch.before.log_prob_of_sample(batch.actions))

        def loss(now: Pass, batch: Batch) -> Array:
            log_ratio = now.actions.log_prob_of_sample(batch.actions) - old
            return ppo_loss(
                log_ratio, now.values, known, batch.real, hyper.clip, hyper.value_weight
            )

        return loss

    how = Round(
        loss_of,
        epochs=hyper.epochs,
        share_trunk=hyper.share_trunk,
        value_rounds=hyper.value_rounds,
        value_rate=hyper.value_rate,
        max_kl=hyper.max_kl,
    )
    return Finetuner(setting, params, hyper, how).adapter()


def check_finetune(setting: Setting, hyper: FinetuneHyper) -> None:
    """Raise ``UsageError`` if the policy cannot be trained by policy gradients, or no round trains it.

    The exploratory actions of the policy must be samples of its distribution.
    """
    if setting.network.head == "mixture":
        raise UsageError(
            "a policy gradient needs actions that are samples of the policy, and a mixture explores "
            "without the noise of its components; pre-train with --head binned or --head gaussian"
        )
    held = hyper.value_rounds if isinstance(hyper, PpoHyper) else 0
    if setting.num_episodes <= held * hyper.round_episodes:
        raise UsageError(
            f"{setting.num_episodes} episodes are spent before the policy is trained: in the first {held} "
            f"rounds of {hyper.round_episodes} episodes only the value head learns; raise --episodes, or "
            "lower --value-rounds"
        )
