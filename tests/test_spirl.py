"""SPiRL: the loss of skills, their windows, acting under skills, and the soft actor-critic over them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from test_ptgm import rule_of

import envs
from envs.base import Trajectory
from envs.episodes import run_episode
from envs.errors import UsageError
from envs.registry import Judgement
from mgpo_jax import methods
from mgpo_jax.adaptation import search
from mgpo_jax.baselines import skills
from mgpo_jax.baselines import spirl as spirl_module
from mgpo_jax.baselines.hierarchy import Transitions
from mgpo_jax.baselines.methods import SpirlHyper
from mgpo_jax.baselines.skills import (
    Normal,
    SkillConfig,
    SkillNetwork,
    prior_agent,
    skill_loss,
    standard,
    windows,
)
from mgpo_jax.baselines.spirl import Kept, Spirl
from mgpo_jax.methods import Setting
from mgpo_jax.network_configs import world_side

ENV = envs.make("gridworld")
K, T = 3, 8
SIZES = {"embed_dim": 16, "num_layers": 2, "skill_steps": K, "latent_dim": 4}
OPEN = SkillConfig(**world_side(ENV.spec, None, "linear"), **SIZES)
CLOSED = replace(OPEN, loop="closed")
CONTINUOUS = replace(OPEN, head="gaussian", action_dim=2)
SETTING = Setting(ENV, OPEN, 12, Judgement())


def make_params(config: SkillConfig) -> Any:
    return skills.init(jax.random.key(0), config)


@pytest.fixture(scope="module")
def params() -> Any:
    return make_params(OPEN)


def make_trajectory(config: SkillConfig, length: int = T) -> Trajectory:
    rng = np.random.default_rng(0)
    obs = jnp.asarray(rng.standard_normal((T, *config.obs_shape)), jnp.float32)
    actions = jnp.asarray(rng.integers(0, config.action_dim, T))
    if config.head != "categorical":
        actions = jnp.asarray(rng.uniform(-1, 1, (T, config.action_dim)), jnp.float32)
    goals = jnp.zeros((T, config.goal_dim))
    return Trajectory(obs, actions, goals, jnp.ones(T, bool), goals, jnp.int32(length))


def test_windows_follow_one_another_from_a_random_step_on():
    keys = jax.random.split(jax.random.key(0), 200)
    steps, inside = jax.vmap(lambda key: windows(key, jnp.int32(7), T, K))(keys)
    offsets = np.asarray(steps[:, 0, 0])
    assert set(offsets) == {0, 1, 2}
    for row, counts, offset in zip(np.asarray(steps), inside, offsets, strict=True):
        np.testing.assert_array_equal(row[0], offset + np.arange(K))
        np.testing.assert_array_equal(counts, [offset + K <= 7, offset + 2 * K <= 7])


@pytest.mark.parametrize("config", [OPEN, CLOSED, CONTINUOUS], ids=["open", "closed", "continuous"])
def test_the_loss_by_hand(config):
    """Means over steps and dimensions, times the number of steps."""
    params, trajectory, key = make_params(config), make_trajectory(config), jax.random.key(3)
    loss, stats = skill_loss(params, key, config, trajectory, True)
    key_windows, key_latent, _ = jax.random.split(key, 3)
    steps, inside = windows(key_windows, trajectory.length, T, K)
    reading: Any = SkillNetwork(config).apply(
        params, key_latent, trajectory.obs[steps], trajectory.actions[steps]
    )
    expected = nll = 0.0
    dimensions = config.action_dim if config is CONTINUOUS else 1
    for window in np.flatnonzero(inside):
        at = jax.tree.map(lambda leaf, i=window: np.asarray(leaf[i], np.float64), reading)
        if config is CONTINUOUS:
            gap = (np.asarray(trajectory.actions)[steps[window]] - at.actions.mean) / np.exp(
                at.actions.log_std
            )
            each = 0.5 * gap**2 + at.actions.log_std + 0.5 * np.log(2 * np.pi)
        else:
            log_pi = at.actions.logits - np.log(np.exp(at.actions.logits).sum(1, keepdims=True))
            each = -log_pi[np.arange(K), np.asarray(trajectory.actions)[steps[window]]]
        mean, log_std = at.posterior.mean, at.posterior.log_std
        divergence = (np.exp(2 * log_std) + mean**2 - 1) / 2 - log_std
        gap = (at.latent - at.prior.mean) / np.exp(at.prior.log_std)
        surprise = 0.5 * gap**2 + at.prior.log_std + 0.5 * np.log(2 * np.pi)
        nll += each.sum()
        expected += K * (each.sum() / K / dimensions + config.beta * divergence.mean())
        expected += surprise.sum()
    np.testing.assert_allclose(stats.nll, nll, rtol=1e-4)
    np.testing.assert_allclose(loss, expected, rtol=1e-4)
    assert stats.num_steps == K * inside.sum()


def test_the_prior_teaches_the_encoder_nothing(params):
    """Its error has a gradient in its own weights alone."""
    trajectory, key = make_trajectory(OPEN), jax.random.key(1)
    grads = jax.grad(
        lambda params: skill_loss(params, key, OPEN, trajectory, True)[1].parts["prior"]
    )(params)
    for name, part in grads["params"].items():
        assert (float(optax.tree.norm(part)) > 0) == (name == "prior_head"), name


def test_the_divergence_of_gaussians_is_that_of_many_draws():
    first = Normal(jnp.array([0.3, -1.0]), jnp.array([-0.5, 0.2]))
    second = Normal(jnp.array([0.0, 0.5]), jnp.array([0.1, -0.3]))
    draws = jax.vmap(first.sample)(jax.random.split(jax.random.key(0), 200_000))
    expected = np.mean(first.log_prob(draws) - second.log_prob(draws))
    np.testing.assert_allclose(first.kl(second), expected, rtol=0.02)
    assert first.kl(first) == 0
    assert standard(2).kl(standard(2)) == 0


@pytest.mark.optimized
@pytest.mark.parametrize("config", [OPEN, CLOSED], ids=["open", "closed"])
def test_four_skills_are_told_apart(config):
    """Windows of four fixed sequences, two possible after each first observation, are given back.

    The prior then draws only the two of its observation.
    """
    config = replace(config, action_dim=4, obs_shape=(2 + K,), beta=1e-3)
    # An observation tells the kind and the step.
    observed = jnp.stack([jnp.eye(2 + K)[2:].at[:, kind].set(1.0) for kind in (0, 1)])
    sequences = jnp.array([[0, 1, 2], [0, 2, 3], [3, 3, 1], [2, 2, 2]])
    kinds = jnp.array([0, 0, 1, 1])
    params, network = make_params(config), SkillNetwork(config)
    # The rate falls: at a constant one, what is drawn at the end depends on the last steps and the machine.
    optimizer = optax.adam(optax.cosine_decay_schedule(1e-2, 4_000))

    def loss(params: Any, key: jax.Array) -> jax.Array:
        key_which, key_latent = jax.random.split(key)
        which = jax.random.randint(key_which, (32,), 0, 4)
        obs = observed[kinds[which]]
        reading: Any = network.apply(params, key_latent, obs, sequences[which])
        nll = -reading.actions.log_prob(sequences[which]).sum(axis=1)
        away = reading.posterior.kl(standard(config.latent_dim))
        surprise = -reading.prior.log_prob(jax.lax.stop_gradient(reading.latent))
        weight = config.beta * K / config.latent_dim
        return jnp.mean(nll + weight * away + surprise)

    def step(carry: Any, key: jax.Array) -> tuple[Any, None]:
        params, state = carry
        updates, state = optimizer.update(jax.grad(loss)(params, key), state)
        return (optax.apply_updates(params, updates), state), None

    start = (params, optimizer.init(params))
    keys = jax.random.split(jax.random.key(0), 4_000)
    (params, _), _ = jax.jit(lambda start: jax.lax.scan(step, start, keys))(start)

    seen: Any = network.apply(params, observed, method="embedded")
    prior: Any = network.apply(params, seen[:, 0], method="prior")
    latents = jax.vmap(prior.sample)(jax.random.split(jax.random.key(1), 500))
    decode = jax.vmap(lambda z: network.apply(params, seen, z, method="decoded").mode())
    drawn = np.asarray(decode(latents))
    for kind in (0, 1):
        known = [tuple(row) for row in np.asarray(sequences)[np.asarray(kinds) == kind]]
        found = [tuple(row) for row in drawn[:, kind]]
        shares = [found.count(row) / len(found) for row in known]
        assert sum(shares) > 0.9, shares
        assert min(shares) > 0.2, shares


def spirl(hyper: SpirlHyper, params: Any, num_episodes: int = 12, config: Any = OPEN) -> Spirl:
    setting = replace(SETTING, network=config, num_episodes=num_episodes)
    return Spirl(setting, params, hyper)


def test_before_the_first_update_the_prior_acts(params):
    """The same keys give the same episodes, bit for bit."""
    agent = spirl(SpirlHyper(), params)
    state = agent.init(jax.random.key(0), jnp.zeros(ENV.spec.goal_dim))
    choice, state = agent.adapter().ask(jax.random.key(1), state)
    task = ENV.sample_task(jax.random.key(2))
    prior = prior_agent(OPEN, params, Judgement())
    for seed in range(3):
        key = jax.random.key(seed)
        mine = run_episode(key, ENV, agent.agent(state, choice), task)
        other = run_episode(key, ENV, prior, task)
        np.testing.assert_array_equal(mine.trajectory.actions, other.trajectory.actions)


@pytest.mark.parametrize("judged_by", ["mean", "sample"])
def test_it_explores_in_the_search_and_is_judged_by_means_or_samples(params, judged_by):
    agent = spirl(SpirlHyper(judged_by=judged_by), params)
    state = agent.init(jax.random.key(0), jnp.zeros(ENV.spec.goal_dim))
    seen = jax.random.normal(jax.random.key(1), (OPEN.embed_dim,))
    policy, key = agent.policy(state.weights.actor, seen), jax.random.key(2)
    tried, _ = agent.adapter().ask(jax.random.key(3), state)
    judged = agent.adapter().best(state)
    last = policy.mean if judged_by == "mean" else policy.sample(key)
    for choice, wanted in ((tried, policy.sample(key)), (judged, last)):
        latent, kept = rule_of(spirl_module, agent, state, choice)(key, seen, None)
        np.testing.assert_array_equal(latent, wanted)
        np.testing.assert_array_equal(kept.latent, latent)
        np.testing.assert_array_equal(kept.seen, seen)
    assert np.abs(policy.sample(key) - policy.mean).max() > 1e-3


def one_state(params: Any, latents: jax.Array, rewards: jax.Array) -> Transitions:
    num = len(latents)
    seen = jnp.zeros((num, OPEN.embed_dim))
    return Transitions(Kept(seen, latents), rewards, jnp.ones(num, bool), jnp.ones(num, bool))


def learned(agent: Spirl, params: Any, reward: Any, num: int) -> Any:
    """The state after updates on a world of one state and one decision."""

    def update(state: Any, key: jax.Array) -> tuple[Any, None]:
        key_draw, key_step = jax.random.split(key)
        policy = agent.policy(state.weights.actor, jnp.zeros(OPEN.embed_dim))
        latents = jax.vmap(policy.sample)(jax.random.split(key_draw, 64))
        now = one_state(params, latents, reward(latents))
        return agent.improved(key_step, state, now, now), None

    state = agent.init(jax.random.key(0), jnp.zeros(ENV.spec.goal_dim))
    keys = jax.random.split(jax.random.key(1), num)
    return jax.jit(lambda state: jax.lax.scan(update, state, keys)[0])(state)


def test_the_divergence_settles_at_its_target(params):
    """Where a reward pulls away from the prior, alpha grows until the divergence is what was asked for."""
    agent = spirl(SpirlHyper(learning_rate=3e-3, target_divergence=2.0), params)
    state = learned(agent, params, lambda z: 10 * z[:, 0], 2_500)
    seen = jnp.zeros((1, OPEN.embed_dim))
    found = agent.divergence(agent.policy(state.weights.actor, seen), seen)
    np.testing.assert_allclose(found, 2.0, rtol=0.2)
    assert state.updates == 2_500


def test_a_large_alpha_keeps_the_prior(params):
    hyper = SpirlHyper(learning_rate=1e-3, alpha=1e6, target_divergence=0.0)
    state = learned(spirl(hyper, params), params, lambda z: 10 * z[:, 0], 300)
    seen = jnp.zeros((1, OPEN.embed_dim))
    agent = spirl(hyper, params)
    assert agent.divergence(agent.policy(state.weights.actor, seen), seen)[0] < 1e-3


@pytest.mark.parametrize("alpha", [1.0, 0.0])
def test_the_policy_of_one_state_is_the_closed_form(params, monkeypatch, alpha):
    """For the reward -c/2 (z - m)^2 and N(0, I) it is N(c m / (alpha + c), alpha / (alpha + c))."""
    monkeypatch.setattr(
        Spirl, "divergence", lambda self, policy, seen: policy.kl(standard(OPEN.latent_dim))
    )
    center, curve = 1.0, 2.0
    agent = spirl(SpirlHyper(learning_rate=3e-3, alpha=1.0), params)
    exact = lambda self, critics, seen, z: jnp.broadcast_to(  # noqa: E731
        -curve / 2 * ((z - center) ** 2).sum(axis=-1), (2, len(z))
    )
    monkeypatch.setattr(Spirl, "values", exact)
    state = agent.init(jax.random.key(0), jnp.zeros(ENV.spec.goal_dim))
    log_alpha = jnp.log(jnp.float32(alpha))  # minus infinity is a weight of exactly 0
    now = one_state(params, jnp.zeros((256, OPEN.latent_dim)), jnp.zeros(256))

    def update(state: Any, key: jax.Array) -> tuple[Any, None]:
        state = agent.improved(key, state, now, now)
        return state._replace(weights=state.weights._replace(log_alpha=log_alpha)), None

    state = state._replace(weights=state.weights._replace(log_alpha=log_alpha))
    keys = jax.random.split(jax.random.key(1), 1_500)
    state = jax.jit(lambda state: jax.lax.scan(update, state, keys)[0])(state)
    found = agent.policy(state.weights.actor, jnp.zeros(OPEN.embed_dim))
    np.testing.assert_allclose(found.mean, curve * center / (alpha + curve), atol=0.05)
    variance = np.exp(2 * np.asarray(found.log_std))
    # A variance of 0 is only approached, since the network puts out its logarithm.
    np.testing.assert_allclose(variance, alpha / (alpha + curve), atol=0.05)


def test_the_weight_of_the_divergence_of_skills(params):
    """The loss grows with beta by the divergence, and with a weight of 0 the encoder is not held back."""
    trajectory, key = make_trajectory(OPEN), jax.random.key(3)

    def at(beta: float) -> tuple[Any, Any]:
        config = replace(OPEN, beta=beta)
        loss = lambda params: skill_loss(params, key, config, trajectory, True)[0]  # noqa: E731
        return jax.value_and_grad(loss)(params)

    (free, free_grad), (some, some_grad), (much, much_grad) = map(at, (0.0, 1.0, 1e3))
    assert some > free
    np.testing.assert_allclose(much - free, 1e3 * (some - free), rtol=1e-3)
    away = optax.tree.sub(some_grad, free_grad)  # what the divergence alone teaches
    assert optax.tree.norm(away) > 0
    for found, wanted in zip(
        jax.tree.leaves(optax.tree.sub(much_grad, free_grad)), jax.tree.leaves(away), strict=True
    ):
        np.testing.assert_allclose(found, 1e3 * wanted, rtol=1e-2, atol=1e-2)


def test_the_value_of_the_next_decision_is_discounted_once(params):
    """Q of a decision that pays nothing is gamma times the worth of the next one, which is at its end."""
    agent = spirl(SpirlHyper(learning_rate=3e-3, discount=0.9, target_divergence=1e3), params)
    # A target divergence that is never reached lets alpha fall to nothing: no divergence is paid for.
    first, second = jnp.zeros(OPEN.embed_dim), jnp.ones(OPEN.embed_dim)

    def update(state: Any, key: jax.Array) -> tuple[Any, None]:
        keys = jax.random.split(key, 3)
        latents = jax.vmap(standard(OPEN.latent_dim).sample)(jax.random.split(keys[0], 64))
        at_end = jnp.arange(64) % 2 == 1
        now = Transitions(
            Kept(jnp.where(at_end[:, None], second, first), latents),
            jnp.where(at_end, 1.0, 0.0),
            at_end,
            jnp.ones(64, bool),
        )
        after = now._replace(kept=Kept(jnp.broadcast_to(second, (64, len(second))), latents))
        return agent.improved(keys[1], state, now, after), None

    state = agent.init(jax.random.key(0), jnp.zeros(ENV.spec.goal_dim))
    keys = jax.random.split(jax.random.key(1), 2_000)
    state = jax.jit(lambda state: jax.lax.scan(update, state, keys)[0])(state)
    latents = jnp.zeros((2, OPEN.latent_dim))
    values = agent.values(state.weights.critics, jnp.stack([first, second]), latents)
    np.testing.assert_allclose(values[:, 1], 1.0, atol=0.05)
    np.testing.assert_allclose(values[:, 0], 0.9, atol=0.08)


def test_the_target_is_the_smaller_value_and_pays_for_the_divergence(params):
    """By a step of plain gradient descent on the error of both critics, away from the prior."""
    agent = spirl(SpirlHyper(alpha=2.0, discount=0.9), params)
    agent.optimize = optax.sgd(1.0)
    state = agent.init(jax.random.key(0), jnp.zeros(ENV.spec.goal_dim))
    actor = jax.tree.map(lambda leaf: leaf + 0.05, state.weights.actor)
    weights = state.weights._replace(actor=actor)
    state = state._replace(weights=weights, opt_state=agent.optimize.init(weights))
    seen, then = jax.random.normal(jax.random.key(1), (2, 16, OPEN.embed_dim))
    latents = jax.random.normal(jax.random.key(2), (16, OPEN.latent_dim))
    rewards, done = jnp.arange(16.0), jnp.arange(16) == 0
    now = Transitions(Kept(seen, latents), rewards, done, jnp.ones(16, bool))
    key = jax.random.key(5)
    policy = agent.policy(actor, then)
    drawn = policy.sample(jax.random.split(key)[0])
    # The second target critic is moved so that each of the two is the smaller one somewhere.
    ahead = jnp.median(jnp.diff(agent.values(state.target, then, drawn), axis=0))
    target = jax.tree.map(jnp.copy, state.target)
    target["params"]["Dense_3"]["bias"] -= jnp.array([[0.0], [ahead]])
    state = state._replace(target=target)
    both = agent.values(target, then, drawn)
    assert np.unique(jnp.argmin(both, axis=0)).tolist() == [0, 1]
    away = agent.divergence(policy, then)
    assert (away > 1e-3).all()
    wanted = rewards + jnp.where(done, 0.0, 0.9 * (both.min(axis=0) - 2.0 * away))
    after = jax.jit(agent.improved)(key, state, now, now._replace(kept=Kept(then, latents)))

    def loss(critics: Any) -> jax.Array:
        return jnp.mean((agent.values(critics, seen, latents) - wanted) ** 2, axis=1).sum() / 2

    grads = jax.grad(loss)(weights.critics)
    expected = jax.tree.map(lambda leaf, grad: leaf - grad, weights.critics, grads)
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)  # noqa: E731
    jax.tree.map(close, after.weights.critics, expected)


def test_it_updates_once_for_every_decision_after_the_warm_up(params):
    agent = spirl(SpirlHyper(batch_size=8, warmup_episodes=2), params)
    task = ENV.sample_task(jax.random.key(0))
    state = agent.init(jax.random.key(0), ENV.task_goal(task))
    per_episode = ENV.spec.horizon // K

    @jax.jit
    def one_round(state: Any, key: jax.Array) -> Any:
        choice, asked = agent.adapter().ask(key, state)
        episode = run_episode(key, ENV, agent.agent(asked, choice), task)
        episodes = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], episode)
        return agent.tell(key, asked, choice, episodes)

    counts = []
    for seed in range(3):
        state = one_round(state, jax.random.key(seed))
        counts.append(int(state.updates))
    assert counts == [0, per_episode, 2 * per_episode]
    assert int(state.replay.size) == 3 * per_episode


@pytest.mark.parametrize("config", [OPEN, CLOSED], ids=["open", "closed"])
def test_lanes_side_by_side_equal_lanes_alone(config):
    params = make_params(config)
    agent = spirl(SpirlHyper(batch_size=8, warmup_episodes=1), params, config=config)
    tasks = jax.vmap(ENV.sample_task)(jax.random.split(jax.random.key(0), 2))
    keys = jax.random.split(jax.random.key(1), 2)

    def returns(key: Any, task: Any) -> Any:
        return search(key, ENV, agent.adapter(), task, 3).log.returns

    together, alone = jax.jit(jax.vmap(returns))(keys, tasks), jax.jit(returns)
    for lane in range(2):
        task = jax.tree.map(lambda leaf, lane=lane: leaf[lane], tasks)
        np.testing.assert_allclose(together[lane], alone(keys[lane], task))


def test_a_budget_of_warm_up_alone_is_refused():
    with pytest.raises(
        UsageError, match=r"10 episodes leave none after the first update.*--warmup-episodes 10"
    ):
        methods.find("spirl").check_use(replace(SETTING, num_episodes=10), SpirlHyper())
