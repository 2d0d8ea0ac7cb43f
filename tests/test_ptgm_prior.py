"""PTGM's prior over goals: what leaving it costs the high level."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_ptgm import CONFIG, ENV, SETTING, episode_of, make_params, rule_of

from mgpo_jax.baselines import ptgm
from mgpo_jax.baselines.commanded import View, log_prior
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
