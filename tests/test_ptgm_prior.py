"""PTGM's prior over goals: what the network learns of it, and what leaving it costs the high level."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from test_ptgm import CONFIG, ENV, SETTING, episode_of, make_params, rule_of

from envs.base import Trajectory
from mgpo_jax.baselines import commanded, ptgm
from mgpo_jax.baselines.commanded import View, commanded_loss, log_prior
from mgpo_jax.baselines.methods import PtgmHyper
from mgpo_jax.baselines.ptgm import Choice, Ptgm

NUM, M = CONFIG.goal_dim, ENV.spec.horizon // CONFIG.skill_steps
TINY_REWARDS = 1e-6


@pytest.fixture(scope="module")
def params() -> Any:
    return make_params(CONFIG)


@pytest.fixture(scope="module")
def view() -> View:
    return View(*jax.random.normal(jax.random.key(5), (2, CONFIG.embed_dim)))


@pytest.mark.parametrize("epsilon", [0.0, 0.5])
def test_the_divergence_of_a_goal_is_that_of_always_choosing_it(params, view, epsilon):
    agent = Ptgm(SETTING, params, PtgmHyper(kl_of="goal"))
    state = agent.init(jax.random.key(0), jnp.zeros(NUM))
    decide = rule_of(ptgm, agent, state, Choice(jnp.float32(epsilon)))
    keys = jax.random.split(jax.random.key(2), 50)
    goals, kept = jax.jit(jax.vmap(lambda key: decide(key, view, None)))(keys)
    assert (len(np.unique(goals)) > 1) == (epsilon > 0)
    log_p = log_prior(CONFIG, params, view)
    np.testing.assert_allclose(kept.divergence, -log_p[goals], rtol=1e-5)


def learned_in_one_state(agent: Ptgm, view: View, rewards: jax.Array, key: jax.Array) -> Any:
    """The Q-values after 40 episodes in a world of one state, where goal g pays ``rewards[g]``."""
    state = agent.init(key, jnp.zeros(NUM))
    choice, _ = agent.ask(key, state)

    def one(state: Any, key: jax.Array) -> tuple[Any, None]:
        keys = jax.random.split(key, M + 1)
        decide = rule_of(ptgm, agent, state, choice)
        goals, kept = jax.vmap(lambda key: decide(key, view, None))(keys[1:])
        paid = jnp.zeros((M, CONFIG.skill_steps)).at[:, 0].set(rewards[goals])
        episode = episode_of(paid.reshape(-1), ENV.spec.horizon, kept)
        episodes = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], episode)
        return agent.tell(keys[0], state, choice, episodes), None

    state, _ = jax.lax.scan(one, state, jax.random.split(key, 40))
    return agent.q.apply(state.params, view.obs)


def test_with_a_large_weight_of_its_goals_the_choice_is_the_priors(params, view):
    """The weight is a million times the largest reward, which is highest where the prior is lowest."""
    hyper = PtgmHyper(kl_of="goal", kl=1.0, epsilon=0.3, discount=0.0, batch_size=32)
    agent = Ptgm(replace(SETTING, num_episodes=40), params, hyper)
    log_p = log_prior(CONFIG, params, view)
    rewards = jnp.where(jnp.arange(NUM) == jnp.argmin(log_p), TINY_REWARDS, 0.0)
    learn = jax.jit(jax.vmap(lambda key: learned_in_one_state(agent, view, rewards, key)))
    values = learn(jax.random.split(jax.random.key(3), 4))
    assert (jnp.argmax(values, axis=1) == jnp.argmax(log_p)).all()
    np.testing.assert_allclose(values.max(axis=1), log_p.max(), atol=0.2)


def test_the_prior_is_as_often_right_as_goals_are_reached():
    """Of a table of counts, its cross-entropy becomes the entropy of the goal given the observation."""
    counts = np.array([[6, 3, 1], [1, 1, 8]])
    rows = [(kind, goal) for kind in range(2) for goal in range(3)]
    kinds, goals = (jnp.array(column) for column in zip(*rows, strict=True))
    weights = jnp.asarray(counts.reshape(-1) / counts.sum(), jnp.float32)
    p = counts / counts.sum(axis=1, keepdims=True)
    entropy = -np.sum(counts * np.log(p)) / counts.sum()
    config = replace(CONFIG, arrived=0.0)

    def trajectory(kind: jax.Array, goal: jax.Array) -> Trajectory:
        achieved = jnp.eye(NUM)[goal][None]
        obs = jnp.zeros((1, *config.obs_shape)).at[0, kind].set(1.0)
        none = jnp.zeros(1, jnp.int32)
        return Trajectory(obs, none, achieved, jnp.ones(1, bool), achieved, jnp.int32(1))

    told = jax.vmap(trajectory)(kinds, goals)

    def loss(params: Any) -> tuple[jax.Array, jax.Array]:
        one = lambda told: commanded_loss(params, jax.random.key(0), config, told, True)  # noqa: E731
        losses, stats = jax.vmap(one)(told)
        return weights @ losses, weights @ stats.parts["prior"]

    optimizer = optax.adam(1e-2)

    def step(carry: Any, index: jax.Array) -> tuple[Any, jax.Array]:
        params, state = carry
        grads, surprise = jax.grad(loss, has_aux=True)(params)
        updates, state = optimizer.update(grads, state)
        return (optax.apply_updates(params, updates), state), surprise

    start = commanded.init(jax.random.key(0), config)
    run = jax.jit(lambda carry: jax.lax.scan(step, carry, jnp.arange(200))[1])
    surprise = run((start, optimizer.init(start)))
    assert surprise[0] > 1.05 * entropy
    np.testing.assert_allclose(surprise[-1], entropy, rtol=0.01)
    assert surprise.min() > entropy - 1e-4
