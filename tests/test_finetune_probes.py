"""Fine-tuning in worlds of one or two steps, whose values and gradients are known exactly."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from test_finetune import tuner_of

from envs.base import Environment, Episode, TimeStep, Trajectory
from envs.registry import Judgement
from envs.specs import ArraySpec, Discrete, EnvSpec
from mgpo_jax.adaptation import proceed, start
from mgpo_jax.baselines.finetune import Weights, make_ppo, make_reinforce
from mgpo_jax.baselines.methods import PpoHyper, ReinforceHyper
from mgpo_jax.methods import Setting
from mgpo_jax.network_configs import network_config
from mgpo_jax.prompts import single_goal
from mgpo_jax.transformer import GoalTransformer

CONSTANT, OBSERVED, LATER, CHOSEN = range(4)
"""Tasks: the reward is 1, the observation, 1 after a second step, or the action."""


class ProbeState(NamedTuple):
    task: jax.Array
    sign: jax.Array
    steps: jax.Array


@dataclass(frozen=True)
class Probe(Environment):
    """Episodes of one step, of two in the task ``LATER``; the observation is a random sign and the step."""

    @property
    def spec(self) -> EnvSpec:
        return EnvSpec(
            name="probe",
            obs=ArraySpec((2,)),
            goal_dim=1,
            actions=Discrete(2),
            horizon=2,
            return_range=(-1.0, 1.0),
        )

    def sample_task(self, key):
        return jax.random.randint(key, (), 0, 4)

    def task_goal(self, task):
        return jnp.ones(1)

    def reset(self, key, task):
        sign = jax.random.rademacher(key, (), jnp.float32)
        state = ProbeState(task, sign, jnp.zeros((), jnp.int32))
        return state, self._seen(state, jnp.zeros(()))

    def step(self, state, action):
        over = state.steps >= self._length(state)
        pays = jnp.array([1.0, state.sign, state.steps == 1, action])[state.task]
        state = state._replace(steps=state.steps + ~over)
        return state, self._seen(state, jnp.where(over, 0.0, pays))

    def _length(self, state):
        return jnp.where(state.task == LATER, 2, 1)

    def _seen(self, state, reward):
        over = state.steps >= self._length(state)
        return TimeStep(
            obs=jnp.stack([state.sign, state.steps.astype(jnp.float32)]),
            achieved_goal=jnp.ones(1),
            goal_reached=over,
            outcome=jnp.ones(1),
            reward=reward,
            terminated=over,
            truncated=jnp.zeros((), bool),
        )


ENV = Probe()
NETWORK = network_config(
    ENV.spec, max_prompt_length=1, embed_dim=16, num_layers=1, num_heads=1, dropout=0.0
)
SETTING = Setting(ENV, NETWORK, 300, Judgement())
PROMPT = single_goal(jnp.ones(1), 1)
FIRST = jnp.array([[1.0, 0.0], [1.0, 1.0]])
"""The observations of an episode with a positive sign."""


@pytest.fixture(scope="module")
def params() -> Any:
    inputs = (PROMPT, FIRST, jnp.zeros(2, jnp.int32))
    return GoalTransformer(NETWORK).init(jax.random.key(0), *inputs)


def test_values_and_choices_of_the_shortest_worlds(params: Any) -> None:
    hyper = PpoHyper(
        learning_rate=0.01, weight_decay=0.0, value_rate=0.01, discount=0.7, round_episodes=10
    )
    adapter = make_ppo(SETTING, params, hyper)

    @jax.jit
    @jax.vmap
    def learned(task: Any) -> Any:
        state = start(jax.random.key(task), ENV, adapter, task)
        return proceed(state, ENV, adapter, task, 100, max_rounds=100)[0].search.weights

    @jax.vmap
    def read(weights: Weights, obs: Any) -> tuple[Any, Any]:
        inputs = (weights.policy, PROMPT, obs, jnp.zeros(2, jnp.int32))
        features = GoalTransformer(NETWORK).apply(*inputs, method="features")
        policy = GoalTransformer(NETWORK).apply(*inputs)
        return weights.value(features), jax.nn.softmax(policy.logits[0])

    weights = learned(jnp.arange(4))
    for sign in (1.0, -1.0):
        obs = jnp.broadcast_to(FIRST * jnp.array([sign, 1.0]), (4, 2, 2))
        values, chances = read(weights, obs)
        np.testing.assert_allclose(values[CONSTANT, 0], 1.0, atol=0.1)
        np.testing.assert_allclose(values[OBSERVED, 0], sign, atol=0.1)
        np.testing.assert_allclose(values[LATER], [0.7, 1.0], atol=0.1)
        np.testing.assert_allclose(values[CHOSEN, 0], 1.0, atol=0.1)
        assert chances[CHOSEN, 1] > 0.95


def test_the_gradient_of_reinforce_is_that_of_the_expected_return(params: Any) -> None:
    """Of two actions twice: all four trajectories, each of which weighs as often as it is drawn."""
    tuner = tuner_of(make_reinforce, ReinforceHyper(discount=1.0), params, SETTING)
    value = tuner.init(jax.random.key(0), jnp.ones(1)).weights.value
    actions = jnp.array(list(itertools.product((0, 1), repeat=2)))
    rewards = jnp.array([[0.3, -1.0], [0.3, 0.5], [2.0, 0.0], [2.0, 1.5]])
    obs = jnp.broadcast_to(FIRST, (4, 2, 2))

    def chances(policy: Any) -> jax.Array:
        one = lambda obs, acted: GoalTransformer(NETWORK).apply(policy, PROMPT, obs, acted)  # noqa: E731
        return jnp.exp(jax.vmap(one)(obs, actions).log_prob(actions).sum(axis=1))

    def expected(policy: Any) -> jax.Array:
        return chances(policy) @ rewards.sum(axis=1)

    @jax.jit
    def gradients(policy: Any) -> tuple[Any, Any, Any]:
        goals = jnp.ones((4, 2, 1))
        there = jnp.ones((4, 2), bool)
        trajectory = Trajectory(obs, actions, goals, there, goals, jnp.full(4, 2))
        weighed = 4 * chances(policy)[:, None] * rewards  # the loss is a mean over four episodes
        episodes = Episode(trajectory, weighed, weighed.sum(axis=1), obs[:, -1])
        state = tuner.init(jax.random.key(0), jnp.ones(1))
        batch = tuner._batch(state, tuner.ask(jax.random.key(0), state)[0], episodes)
        loss = lambda policy: tuner.how.loss(batch)(  # noqa: E731
            tuner._forward(Weights(policy, value), batch), batch
        )
        return chances(policy), jax.grad(loss)(policy), jax.grad(expected)(policy)

    found_chances, found, wanted = gradients(params)
    np.testing.assert_allclose(found_chances.sum(), 1.0, rtol=1e-5)
    # It is a mean over two steps, too.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(-2 * a, b, atol=1e-5), found, wanted)
    assert optax.tree.norm(wanted) > 0.01
