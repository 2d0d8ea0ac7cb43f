"""BC-finetune: returns, divergences, one update against oracles, and learning in small worlds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from envs.base import Environment, Episode, TimeStep
from envs.episodes import run_episode
from envs.errors import NotAvailableError, UsageError
from envs.registry import Judgement
from envs.specs import ArraySpec, Discrete, EnvSpec
from mgpo_jax import methods
from mgpo_jax.adaptation import Adapter, proceed, search, start
from mgpo_jax.baselines import finetune
from mgpo_jax.baselines.finetune import (
    Batch,
    Finetuner,
    Pass,
    Round,
    ValueHead,
    Weights,
    make_ppo,
    make_reinforce,
)
from mgpo_jax.baselines.methods import (
    CarefulPpoHyper,
    CarefulReinforceHyper,
    PpoHyper,
    ReinforceHyper,
)
from mgpo_jax.baselines.returns import advantages, returns_to_go
from mgpo_jax.baselines.subsets import subset
from mgpo_jax.distributions import HEADS
from mgpo_jax.methods import Setting, with_numbers
from mgpo_jax.network_configs import network_config
from mgpo_jax.optimizers.base import PromptOptimizer
from mgpo_jax.optimizers.methods import fixed_prompt, prompt_adapter
from mgpo_jax.policy import transformer_policy
from mgpo_jax.prompts import single_goal
from mgpo_jax.rollout import Query
from mgpo_jax.transformer import GoalTransformer

NUM_STATES = 5


class ChainState(NamedTuple):
    place: jax.Array
    steps: jax.Array


@dataclass(frozen=True)
class Chain(Environment):
    """States 0 to 4 in a row; action 1 goes right and 0 left, and state 4 pays 1 and ends the episode."""

    horizon: int = 8

    @property
    def spec(self) -> EnvSpec:
        return EnvSpec(
            name="chain",
            obs=ArraySpec((NUM_STATES,)),
            goal_dim=1,
            actions=Discrete(2),
            horizon=self.horizon,
            return_range=(0.0, 1.0),
        )

    def sample_task(self, key):
        return jnp.zeros((), jnp.int32)

    def task_goal(self, task):
        return jnp.ones(1)

    def reset(self, key, task):
        state = ChainState(jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))
        return state, self._seen(state, jnp.zeros((), bool))

    def step(self, state, action):
        over = (state.place == NUM_STATES - 1) | (state.steps >= self.horizon)
        place = jnp.clip(state.place + jnp.where(action == 1, 1, -1), 0, NUM_STATES - 1)
        state = ChainState(jnp.where(over, state.place, place), state.steps + ~over)
        return state, self._seen(state, ~over & (state.place == NUM_STATES - 1))

    def _seen(self, state, paid):
        there = state.place == NUM_STATES - 1
        return TimeStep(
            obs=jax.nn.one_hot(state.place, NUM_STATES),
            achieved_goal=jnp.ones(1) * there,
            goal_reached=there,
            outcome=jnp.ones(1) * there,
            reward=jnp.float32(paid),
            terminated=there,
            truncated=~there & (state.steps >= self.horizon),
        )


ENV = Chain()
NETWORK = network_config(
    ENV.spec, max_prompt_length=2, embed_dim=16, num_layers=1, num_heads=1, dropout=0.0
)
SETTING = Setting(ENV, NETWORK, 20, Judgement())
TASK = jnp.zeros((), jnp.int32)
GOAL = jnp.ones(1)


@pytest.fixture(scope="module")
def params() -> Any:
    inputs = (single_goal(GOAL, 2), jnp.zeros((2, NUM_STATES)), jnp.zeros(2, jnp.int32))
    return GoalTransformer(NETWORK).init(jax.random.key(0), *inputs)


@pytest.fixture(scope="module")
def round_of_episodes(params: Any) -> tuple[Adapter, Any, Query, Episode]:
    """An adapter of PPO with the state, choice and episodes of its first round."""
    adapter = make_ppo(SETTING, params, PpoHyper())
    state = adapter.init(jax.random.key(1), GOAL)
    query, state = adapter.ask(jax.random.key(2), state)
    play = jax.jit(jax.vmap(lambda key: run_episode(key, ENV, adapter.agent(state, query), TASK)))
    rounds = (play(jax.random.split(jax.random.key(seed), 5)) for seed in range(100))
    lengths = lambda episodes: set(episodes.trajectory.length.tolist())  # noqa: E731
    episodes = next(episodes for episodes in rounds if len(lengths(episodes)) > 2)
    return adapter, state, query, episodes


def assert_close(first: Any, second: Any, atol: float) -> None:
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=atol, rtol=0), first, second)


def assert_equal(first: Any, second: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_returns_and_advantages_by_hand() -> None:
    rewards = jnp.array([1.0, 0.0, 2.0, 0.0])
    values = jnp.array([0.5, 1.0, 1.5, 9.0])
    real = jnp.array([True, True, True, False])
    assert_close(returns_to_go(rewards, 0.5), jnp.array([1.5, 1.0, 2.0, 0.0]), 1e-6)
    one = advantages(rewards, values, real, 0.5, 1.0)
    assert_close(one, jnp.array([1.0, 0.0, 0.5, 0.0]), 1e-6)  # return-to-go minus value
    none = advantages(rewards, values, real, 0.5, 0.0)
    assert_close(none, jnp.array([1.0, -0.25, 0.5, 0.0]), 1e-6)  # errors of one step


def test_advantages_equal_the_sum_of_the_definition() -> None:
    rng = np.random.default_rng(0)
    rewards, values = (rng.normal(size=20).astype(np.float32) for _ in range(2))
    length, discount, lam = 13, 0.9, 0.8
    rewards[length:] = 0
    errors = [
        rewards[t] + (discount * values[t + 1] if t + 1 < length else 0) - values[t]
        for t in range(length)
    ]
    wanted = [
        sum((discount * lam) ** (u - t) * errors[u] for u in range(t, length))
        for t in range(length)
    ]
    found = advantages(
        jnp.array(rewards), jnp.array(values), jnp.arange(20) < length, discount, lam
    )
    np.testing.assert_allclose(found[:length], wanted, atol=1e-5)
    assert not found[length:].any()


@pytest.mark.parametrize("head", ["categorical", "binned", "gaussian"])
def test_divergences_are_those_of_samples(head: str) -> None:
    num = HEADS[head].num_params(2)
    first, second = (
        HEADS[head].make(0.3 * jax.random.normal(jax.random.key(seed), (num,))) for seed in (0, 1)
    )
    assert float(first.kl(first)) == pytest.approx(0, abs=1e-6)
    if head == "gaussian":  # samples are clipped, the divergence is that of the density
        noise = jax.random.normal(jax.random.key(2), (100_000, 2))
        actions = first.mean + jnp.exp(first.log_std) * noise
    else:
        actions = jax.vmap(first.sample)(jax.random.split(jax.random.key(2), 100_000))
    ratios = jax.vmap(lambda a: first.log_prob(a) - second.log_prob(a))(actions)
    error = 4 * float(ratios.std()) / 100_000**0.5
    assert float(first.kl(second)) == pytest.approx(float(ratios.mean()), abs=error)


def test_mixtures_have_no_divergence_and_are_refused() -> None:
    mixture = HEADS["mixture"].make(jnp.zeros(HEADS["mixture"].num_params(2)))
    with pytest.raises(NotAvailableError, match="no closed form"):
        mixture.kl(mixture)
    with pytest.raises(NotAvailableError, match="without the noise"):
        mixture.log_prob_of_sample(jnp.zeros(2))
    mixed = replace(SETTING, network=replace(NETWORK, head="mixture"))
    for name in ("ppo", "ppo-careful", "reinforce", "reinforce-careful"):
        method = methods.find(name)
        with pytest.raises(UsageError, match="pre-train with --head binned"):
            method.check_use(mixed, method.hyper())
        method.check_use(SETTING, method.hyper())


def test_a_budget_that_never_trains_the_policy_is_refused() -> None:
    """In the first round of the careful form, only the value head learns."""
    one_round = replace(SETTING, num_episodes=5)
    careful = methods.find("ppo-careful")
    with pytest.raises(UsageError, match=r"5 episodes are spent before .*lower --value-rounds"):
        careful.check_use(one_round, careful.hyper())
    careful.check_use(one_round, careful.hyper(value_rounds=0))
    for name in ("ppo", "reinforce", "reinforce-careful"):
        methods.find(name).check_use(one_round, methods.find(name).hyper())


@pytest.mark.parametrize("tune", ["all", "head", "lora"])
def test_a_part_starts_as_the_network_that_it_is_of(params: Any, tune: str) -> None:
    part = subset(tune, params, rank=2)
    start = part.start(jax.random.key(0))
    assert_equal(part.merge(start), params)
    moved = part.merge(jax.tree.map(lambda leaf: leaf + 1, start))
    same = jax.tree.map(lambda a, b: bool((a == b).all()), moved, params)["params"]
    expected = {
        "all": set(),
        "head": {layer for layer in same if layer not in ("norm_out", "head")},
        "lora": {layer for layer in same if not layer.startswith("blocks")},
    }[tune]
    assert {layer for layer, flags in same.items() if all(jax.tree.leaves(flags))} == expected


def sampled_bc(params: Any) -> Adapter:
    """Goal-conditioned BC that samples, in rounds of five episodes."""
    fixed = fixed_prompt(NETWORK.max_prompt_length)

    def ask(key: Any, state: Any) -> Any:
        query, state = fixed.ask(key, state)
        return query._replace(greedy=jnp.zeros((), bool)), state

    optimizer = PromptOptimizer(fixed.init, ask, fixed.tell, fixed.best)
    policy = transformer_policy(NETWORK, params)
    return prompt_adapter(policy, optimizer)._replace(episodes_per_round=5)


@pytest.mark.parametrize("make", [make_ppo, make_reinforce])
def test_without_a_learning_rate_it_is_sampled_behavior_cloning(params: Any, make: Any) -> None:
    still = {"learning_rate": 0.0, "weight_decay": 0.0}
    hyper = PpoHyper(**still) if make is make_ppo else ReinforceHyper(**still)
    run = jax.jit(search, static_argnums=(1, 2, 4))
    found, wanted = (
        run(jax.random.key(5), ENV, adapter, TASK, 20).log
        for adapter in (make(SETTING, params, hyper), sampled_bc(params))
    )
    assert_equal(found.returns, wanted.returns)
    assert_equal(found.played.actions, wanted.played.actions)


def test_steps_after_the_end_change_nothing(round_of_episodes: Any) -> None:
    adapter, state, query, episodes = round_of_episodes
    trajectory = episodes.trajectory
    over = jnp.arange(ENV.horizon) >= trajectory.length[:, None]
    noisy = episodes._replace(
        trajectory=trajectory._replace(
            obs=jnp.where(over[..., None], 7.0, trajectory.obs),
            actions=jnp.where(over, 1, trajectory.actions),
        )
    )
    tell = jax.jit(adapter.tell)
    first, second = (tell(jax.random.key(4), state, query, each) for each in (episodes, noisy))
    assert_equal(first.weights, second.weights)


def test_the_first_gradient_is_that_of_the_advantages(round_of_episodes: Any, params: Any) -> None:
    """At the ratio 1 PPO's gradient is the policy gradient; AdamW's first step is its sign."""
    _, _, query, episodes = round_of_episodes
    hyper = PpoHyper(epochs=1, weight_decay=0.0, value_weight=0.0, clip_norm=1e9)
    adapter = make_ppo(SETTING, params, hyper)
    state = adapter.init(jax.random.key(1), GOAL)
    after = jax.jit(adapter.tell)(jax.random.key(4), state, query, episodes).weights.policy

    trajectory = episodes.trajectory
    real = jnp.arange(ENV.horizon) < trajectory.length[:, None]
    zero = jnp.zeros(ENV.horizon)
    gains = jax.vmap(advantages, (0, None, 0, None, None))(episodes.rewards, zero, real, 0.98, 0.95)
    gains = jnp.where(real, (gains - gains[real].mean()) / gains[real].std(), 0)

    def objective(params: Any) -> Any:
        apply = lambda o, a: GoalTransformer(NETWORK).apply(params, query.prompt, o, a)  # noqa: E731
        log_probs = jax.vmap(apply)(trajectory.obs, trajectory.actions).log_prob(trajectory.actions)
        return jnp.sum(gains * log_probs) / real.sum()

    grads = jax.jit(jax.grad(objective))(params)
    for moved, before, grad in zip(*map(jax.tree.leaves, (after, params, grads)), strict=True):
        clear = jnp.abs(grad) > 1e-4
        step = (moved - before)[clear]
        np.testing.assert_allclose(step, 1e-4 * jnp.sign(grad[clear]), atol=2e-6)


@pytest.mark.parametrize("hyper", [PpoHyper(), CarefulPpoHyper(tune="lora")])
def test_lanes_side_by_side_equal_single_ones(params: Any, hyper: Any) -> None:
    adapter = make_ppo(SETTING, params, hyper)
    keys = jax.random.split(jax.random.key(6), 3)
    run = lambda key: search(key, ENV, adapter, TASK, 10).log.returns  # noqa: E731
    together = jax.jit(jax.vmap(run))(keys)
    single = jax.jit(run)
    np.testing.assert_array_equal(together, jnp.stack([single(key) for key in keys]))


FAST = {"learning_rate": 0.01, "weight_decay": 0.0, "warmup_rounds": 0}


@pytest.mark.parametrize(
    ("make", "hyper"),
    [
        (make_ppo, PpoHyper(**FAST, value_rate=0.01)),
        (make_ppo, CarefulPpoHyper(**FAST, max_kl=None)),
        (make_reinforce, ReinforceHyper(**FAST)),
        (make_reinforce, CarefulReinforceHyper(**FAST)),
    ],
    ids=["ppo", "ppo-careful", "reinforce", "reinforce-careful"],
)
def test_a_chain_is_learned(params: Any, make: Any, hyper: Any) -> None:
    adapter = make(SETTING, params, hyper)
    runs = jax.jit(jax.vmap(lambda key: search(key, ENV, adapter, TASK, 200).log.returns))
    returns = runs(jax.random.split(jax.random.key(7), 4)).reshape(4, -1)
    assert returns[:, -20:].mean() > 0.95 > returns[:, :20].mean() + 0.2


def tuner_of(make: Any, hyper: Any, params: Any, setting: Setting = SETTING) -> Finetuner:
    """The fine-tuning behind an adapter."""
    made = []

    class Noted(Finetuner):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            made.append(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finetune, "Finetuner", Noted)
        make(setting, params, hyper)
    return made[0]


@pytest.fixture(scope="module")
def batch(params: Any, round_of_episodes: Any) -> Batch:
    """Five episodes of different lengths, with values that are not 0."""
    _, state, query, episodes = round_of_episodes
    tuner = Finetuner(SETTING, params, PpoHyper(), Round(lambda batch: lambda now, batch: 0.0))
    batch = jax.jit(tuner._batch)(state, query, episodes)
    values = jax.random.normal(jax.random.key(8), batch.rewards.shape)
    rewards = batch.rewards + jnp.where(batch.real, 0.1 * values, 0.0)
    return batch._replace(rewards=rewards, values=values)


def shifted(batch: Batch, by: float) -> Pass:
    """The network's outputs after the logits of action 1 have grown, and with values of 0."""
    logits = batch.before.logits.at[..., 1].add(by)
    return Pass(type(batch.before)(logits), jnp.zeros_like(batch.values))


@pytest.mark.parametrize("baseline", [False, True])
def test_the_loss_of_reinforce_by_hand(params: Any, batch: Batch, baseline: bool) -> None:
    tuner = tuner_of(make_reinforce, ReinforceHyper(baseline=baseline, discount=0.5), params)
    now = shifted(batch, 0.3)
    found = tuner.how.loss(batch)(now, batch)
    rewards, real = np.asarray(batch.rewards), np.asarray(batch.real)
    steps = range(ENV.horizon)
    togo = np.array(
        [[sum(0.5 ** (u - t) * row[u] for u in steps[t:]) for t in steps] for row in rewards]
    )
    if baseline:
        togo = togo - togo.mean(axis=0)
    log_probs = np.asarray(now.actions.log_prob(batch.actions))
    np.testing.assert_allclose(found, -(togo * log_probs)[real].mean(), rtol=1e-4)


def test_the_loss_of_ppo_by_hand(params: Any, batch: Batch) -> None:
    """The policy has moved so far that some ratios are clipped on either side."""
    hyper = PpoHyper(clip=0.2, value_weight=0.25, discount=0.9, gae_lambda=0.8)
    tuner, now = tuner_of(make_ppo, hyper, params), shifted(batch, 1.0)
    found = tuner.how.loss(batch)(now, batch)
    real = np.asarray(batch.real)
    estimate = jax.vmap(advantages, (0, 0, 0, None, None))
    gains = np.asarray(estimate(batch.rewards, batch.values, batch.real, 0.9, 0.8))
    targets = (gains + np.asarray(batch.values))[real]
    gains = ((gains - gains[real].mean()) / gains[real].std())[real]
    log_ratio = now.actions.log_prob(batch.actions) - batch.before.log_prob(batch.actions)
    ratio = np.exp(np.asarray(log_ratio))[real]
    assert ratio.min() < 0.8
    assert ratio.max() > 1.2
    gained = np.minimum(ratio * gains, np.clip(ratio, 0.8, 1.2) * gains)
    np.testing.assert_allclose(found, -gained.mean() + 0.25 * (targets**2).mean(), rtol=1e-4)


@pytest.mark.parametrize("shared", [True, False])
def test_values_train_the_network_only_where_it_is_shared(
    params: Any, batch: Batch, shared: bool
) -> None:
    tuner = tuner_of(make_ppo, PpoHyper(share_trunk=shared), params)
    weights = tuner.init(jax.random.key(1), GOAL).weights
    head = jax.tree.map(lambda leaf: leaf + 1.0, weights.value)

    @jax.jit
    def gradient(policy: Any) -> Any:
        values = lambda policy: tuner._forward(Weights(policy, head), batch).values.sum()  # noqa: E731
        return jax.grad(values)(policy)

    grads = gradient(weights.policy)
    assert any(np.any(np.asarray(grad)) for grad in jax.tree.leaves(grads)) == shared


def test_gradients_of_policy_and_values_are_clipped_apart() -> None:
    """AdamW's first moment is a tenth of the gradient that it is given."""
    optimize = finetune.optimizer(PpoHyper(clip_norm=0.5), 0.01)
    weights = Weights({"kernel": jnp.zeros(4)}, ValueHead(jnp.zeros(4), jnp.zeros(())))
    grads = Weights({"kernel": jnp.full(4, 5.0)}, ValueHead(jnp.full(4, 0.1), jnp.zeros(())))
    _, state = optimize.update(grads, optimize.init(weights), weights)
    for kind, norm in (("policy", 0.5), ("value", 0.2)):
        moments = optax.tree.get(state.inner_states[kind], "mu")
        np.testing.assert_allclose(optax.tree.norm(moments), 0.1 * norm, rtol=1e-5)


def test_the_penalty_is_for_leaving_the_pre_trained_policy(
    params: Any, round_of_episodes: Any
) -> None:
    """Also after rounds that have moved the policy."""
    _, state, query, episodes = round_of_episodes
    tuner = tuner_of(make_ppo, PpoHyper(), params)
    policy = jax.tree.map(lambda leaf: leaf + 0.1, state.weights.policy)
    moved = state._replace(weights=state.weights._replace(policy=policy))
    batch_of = jax.jit(lambda state: tuner._batch(state, query, episodes))
    first, later = batch_of(state), batch_of(moved)
    assert_close(first.pretrained, first.before, 1e-6)
    assert_close(later.pretrained, first.before, 1e-6)
    assert np.abs(later.before.logits - first.before.logits).max() > 1e-2


def test_the_penalty_weighs_by_the_policy_and_not_by_the_pre_trained_one(
    params: Any, round_of_episodes: Any
) -> None:
    """The first moment of Adam is a tenth of the gradient of sum_a pi(a) log(pi(a) / pi_0(a))."""
    _, state, query, episodes = round_of_episodes
    without_loss = Round(lambda batch: lambda now, batch: jnp.zeros(()))
    tuner = Finetuner(SETTING, params, PpoHyper(kl=1.0, clip_norm=1e9), without_loss)
    noise = lambda leaf: 0.3 * jax.random.normal(jax.random.key(leaf.size), leaf.shape)  # noqa: E731
    policy = jax.tree.map(lambda leaf: leaf + noise(leaf), params)
    moved = state._replace(weights=state.weights._replace(policy=policy))
    batch = jax.jit(tuner._batch)(moved, query, episodes)

    def log_probs(weights: Any) -> jax.Array:
        one = lambda *own: GoalTransformer(NETWORK).apply(weights, query.prompt, *own).logits  # noqa: E731
        return jax.nn.log_softmax(jax.vmap(one)(batch.obs, batch.actions))

    def penalty(weights: Any, weighs_first: bool) -> jax.Array:
        now, before = log_probs(weights), log_probs(params)
        first, second = (now, before) if weighs_first else (before, now)
        divergences = jnp.sum(jnp.exp(first) * (first - second), axis=-1)
        return divergences[batch.real].mean()

    told = jax.jit(tuner.tell)(jax.random.key(4), moved, query, episodes)
    moments = optax.tree.get(told.opt_state.inner_states["policy"], "mu").policy
    right, wrong = (jax.grad(penalty)(policy, weighs_first) for weighs_first in (True, False))
    assert_close(moments, jax.tree.map(lambda leaf: 0.1 * leaf, right), 1e-5)
    assert optax.tree.norm(optax.tree.sub(right, wrong)) > 0.1 * optax.tree.norm(right)


def test_a_strong_penalty_keeps_the_policy(params: Any, round_of_episodes: Any) -> None:
    _, _, query, episodes = round_of_episodes
    hyper = PpoHyper(epochs=100)
    start = make_ppo(SETTING, params, PpoHyper()).init(jax.random.key(1), GOAL)

    @jax.jit
    def moved(kl: Any, learning_rate: Any) -> Any:
        changed = with_numbers(hyper, {"kl": kl, "learning_rate": learning_rate})
        adapter = make_ppo(SETTING, params, changed)
        state = adapter.tell(jax.random.key(4), start, query, episodes)
        trajectory = episodes.trajectory
        network = GoalTransformer(NETWORK)
        now, before = (
            network.apply(weights, query.prompt, trajectory.obs[0], trajectory.actions[0])
            for weights in (state.weights.policy, params)
        )
        return now.kl(before).mean()

    assert moved(100.0, 1e-3) < 0.2 * moved(0.0, 1e-3)
    # Steps of Adam have a size of their own, whatever the weight, so that the rate matters.
    assert moved(1e6, 1e-4) < 1e-4 < moved(0.0, 1e-4)


def test_the_rate_of_the_policy_rises_over_the_rounds_that_train_it(
    params: Any, round_of_episodes: Any
) -> None:
    """All epochs of a round have one rate, and rounds that only train the values do not count."""
    _, _, query, episodes = round_of_episodes
    hyper = PpoHyper(epochs=3, learning_rate=0.01, value_rounds=1, warmup_rounds=4)

    @jax.jit
    def told(rounds: Any, learning_rate: Any, warmup_rounds: Any) -> Any:
        numbers = {"learning_rate": learning_rate, "warmup_rounds": warmup_rounds}
        changed = with_numbers(hyper, numbers)
        adapter = make_ppo(SETTING, params, changed)
        state = adapter.init(jax.random.key(1), GOAL)._replace(rounds=rounds)
        return adapter.tell(jax.random.key(4), state, query, episodes).weights.policy

    assert_equal(told(0, 0.01, 4), params)
    for rounds, share in ((1, 0.25), (2, 0.5), (4, 1.0), (9, 1.0)):
        assert_close(told(rounds, 0.01, 4), told(rounds, share * 0.01, 0), 1e-6)


@pytest.mark.optimized
def test_a_round_ends_when_the_policy_has_moved_too_far(
    params: Any, round_of_episodes: Any
) -> None:
    """With a bound that the first step breaks, four epochs are as one."""
    _, state, query, episodes = round_of_episodes

    def told(hyper: Any, max_kl: Any, state: Any) -> Any:
        changed = hyper if max_kl is None else with_numbers(hyper, {"max_kl": max_kl})
        adapter = make_ppo(SETTING, params, changed)
        return adapter.tell(jax.random.key(4), state, query, episodes).weights

    hyper = PpoHyper(learning_rate=0.01, epochs=4)
    after = jax.jit(told, static_argnums=0)  # compiled with a bound, without one, and for one epoch
    assert_close(after(hyper, 1e-9, state), after(replace(hyper, epochs=1), None, state), 1e-6)
    assert_close(after(hyper, 1e9, state), after(hyper, None, state), 1e-6)


@pytest.mark.optimized
def test_epochs_after_the_end_of_a_round_are_left_out_and_no_bit_changes(
    params: Any, round_of_episodes: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against the loop that computes them all and throws away what follows the end."""
    _, state, query, episodes = round_of_episodes
    hyper = PpoHyper(learning_rate=0.01, kl=0.1, epochs=6)

    def rounds() -> Callable[[float], list[Any]]:
        @jax.jit
        def tell(state: Any, max_kl: Any) -> Any:
            adapter = make_ppo(SETTING, params, with_numbers(hyper, {"max_kl": max_kl}))
            return adapter.tell(jax.random.key(4), state, query, episodes)

        def after(max_kl: float) -> list[Any]:
            states = [state]
            for _ in range(3):
                states.append(tell(states[-1], max_kl))
            return [one.weights for one in states[1:]]

        return after

    after = rounds()
    short, whole = after(1e-3), after(1e9)
    with pytest.raises(AssertionError):
        assert_equal(short, whole)  # rounds do end early
    monkeypatch.setattr(
        finetune, "repeated", lambda num, epoch, start, _: jax.lax.fori_loop(0, num, epoch, start)
    )
    assert_equal(short, rounds()(1e-3))


def test_values_alone_are_learned_at_first(params: Any, round_of_episodes: Any) -> None:
    """They approach the discounted returns, while the policy stays as it was."""
    _, _, query, episodes = round_of_episodes
    hyper = PpoHyper(
        epochs=400, value_rounds=1, value_rate=0.05, share_trunk=False, weight_decay=0.0,
        clip_norm=1e9, gae_lambda=1.0,
    )  # fmt: skip
    adapter = make_ppo(SETTING, params, hyper)
    start = adapter.init(jax.random.key(1), GOAL)
    state = jax.jit(adapter.tell)(jax.random.key(4), start, query, episodes)
    assert_equal(state.weights.policy, params)
    moments = lambda state: state.opt_state.inner_states["policy"]  # noqa: E731
    assert_equal(moments(state), moments(start))
    real = jnp.arange(ENV.horizon) < episodes.trajectory.length[:, None]
    look = lambda obs, actions: GoalTransformer(NETWORK).apply(  # noqa: E731
        params, query.prompt, obs, actions, method="features"
    )
    features = jax.vmap(look)(episodes.trajectory.obs, episodes.trajectory.actions)
    returns = jax.vmap(returns_to_go, (0, None))(episodes.rewards, 0.98)
    missed = (state.weights.value(features) - returns)[real]
    assert float((missed**2).mean()) < 0.5 * float((returns[real] ** 2).mean())


def test_the_values_of_a_chain_are_the_discounted_returns_of_its_best_policy(params: Any) -> None:
    """After PPO has learned to go right, V(s) is the discount to the power of the steps that are left."""
    hyper = PpoHyper(**FAST, value_rate=0.01, discount=0.8)
    adapter = make_ppo(SETTING, params, hyper)

    @jax.jit
    def learned(key: Any) -> Any:
        state = start(key, ENV, adapter, TASK)
        state, _, _ = proceed(state, ENV, adapter, TASK, 80, max_rounds=80)
        return state.search.weights

    weights = learned(jax.random.key(9))
    obs, actions = jnp.eye(NUM_STATES)[: NUM_STATES - 1], jnp.ones(NUM_STATES - 1, jnp.int32)
    features = GoalTransformer(NETWORK).apply(
        weights.policy, single_goal(GOAL, 2), obs, actions, method="features"
    )
    np.testing.assert_allclose(weights.value(features), 0.8 ** np.arange(3, -1, -1), atol=0.1)
    log_probs = GoalTransformer(NETWORK).apply(weights.policy, single_goal(GOAL, 2), obs, actions)
    assert log_probs.mode().tolist() == [1, 1, 1, 1]
