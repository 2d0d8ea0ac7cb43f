"""The two ends of SPiRL's trade-off: latents that say everything, and latents that say nothing."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import envs
from envs.base import Trajectory
from mgpo_jax.baselines import skills
from mgpo_jax.baselines.skills import SkillConfig, SkillNetwork, skill_loss, standard
from mgpo_jax.network_configs import world_side

ENV = envs.make("gridworld")
SEQUENCES = jnp.array([[0, 1, 2], [0, 2, 3], [3, 3, 1], [0, 2, 2]])
"""Actions of four skills of three steps, which are equally frequent."""
SIZES = {"embed_dim": 16, "num_layers": 1, "skill_steps": 3, "latent_dim": 2}


def trained(config: SkillConfig) -> Any:
    """The parameters after training on the four skills, all of which begin with the same observation."""
    obs = jnp.zeros((3, *config.obs_shape))
    goals, flags = jnp.zeros((3, config.goal_dim)), jnp.ones(3, bool)
    optimizer = optax.adam(optax.cosine_decay_schedule(2e-2, 600))

    def loss(params: Any, key: jax.Array) -> jax.Array:
        def of(key: jax.Array, actions: jax.Array) -> jax.Array:
            told = Trajectory(obs, actions, goals, flags, goals, jnp.int32(3))
            return skill_loss(params, key, config, told, True)[0]

        # Windows start at a random one of the first three steps, and only the first is whole.
        keys = jax.random.split(key, 24)
        return jax.vmap(of)(keys, jnp.tile(SEQUENCES, (6, 1))).mean()

    def step(carry: Any, key: jax.Array) -> tuple[Any, None]:
        params, state = carry
        updates, state = optimizer.update(jax.grad(loss)(params, key), state)
        return (optax.apply_updates(params, updates), state), None

    @jax.jit
    def run(params: Any) -> Any:
        keys = jax.random.split(jax.random.key(1), 600)
        return jax.lax.scan(step, (params, optimizer.init(params)), keys)[0][0]

    return run(skills.init(jax.random.key(0), config))


@pytest.mark.parametrize("beta", [0.0, 1e3])
def test_without_a_price_skills_are_told_apart_and_at_a_high_one_not(beta):
    config = SkillConfig(**world_side(ENV.spec, None, "linear"), **SIZES, beta=beta)
    params, network = trained(config), SkillNetwork(config)

    @jax.jit
    def read(params: Any) -> Any:
        obs = jnp.zeros((4, 3, *config.obs_shape))
        return network.apply(params, jax.random.key(2), obs, SEQUENCES)

    reading: Any = read(params)
    chances = np.asarray(jax.nn.softmax(reading.actions.logits))
    if beta == 0:
        np.testing.assert_array_equal(chances.argmax(axis=-1), SEQUENCES)
        assert reading.posterior.kl(standard(2)).min() > 1
    else:
        shares = np.mean(np.eye(config.action_dim)[np.asarray(SEQUENCES)], axis=0)
        np.testing.assert_allclose(chances, np.broadcast_to(shares, chances.shape), atol=0.1)
        assert reading.posterior.kl(standard(2)).max() < 0.01
