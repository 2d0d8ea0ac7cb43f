"""The learners of the baselines on gymnasium's CartPole and Pendulum, where good returns are well known.

The learners of PTGM and SPiRL are tested on their own, with one decision per step: Q-learning without a
prior, and a soft actor-critic whose skills are the actions, with a wide prior that turns its divergence
into an entropy. PPO and REINFORCE finetune a small untrained Transformer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
import mgpo_jax
from envs.gymnasium_world import GymnasiumWorld
from envs.live import Moment
from envs.registry import Judgement
from mgpo_jax.baselines import skills
from mgpo_jax.baselines.commanded import CommandConfig
from mgpo_jax.baselines.hierarchy import Transitions, remember
from mgpo_jax.baselines.methods import PpoHyper, PtgmHyper, ReinforceHyper, SpirlHyper
from mgpo_jax.baselines.ptgm import Kept as KeptGoal
from mgpo_jax.baselines.ptgm import Ptgm
from mgpo_jax.baselines.skills import SkillConfig
from mgpo_jax.baselines.spirl import Kept as KeptLatent
from mgpo_jax.baselines.spirl import Spirl
from mgpo_jax.losses import initial_params
from mgpo_jax.methods import Setting
from mgpo_jax.network_configs import network_config, world_side
from mgpo_jax.policy import LoadedPolicy

pytestmark = pytest.mark.slow
ENV = envs.make("gridworld")  # lends its spec to networks that are never run
SIDE = world_side(ENV.spec, None, "linear")
Learn = Callable[[jax.Array, Any, Transitions], Any]


def mlp(params: Any, x: np.ndarray) -> np.ndarray:
    """The outputs of a multilayer perceptron, in numpy: one observation is too little work for jax."""
    layers = [params["params"][f"Dense_{i}"] for i in range(len(params["params"]))]
    for layer in layers[:-1]:
        x = np.maximum(x @ layer["kernel"] + layer["bias"], 0)
    found: np.ndarray = x @ layers[-1]["kernel"] + layers[-1]["bias"]
    return found


def played(
    env: Any, seed: int, horizon: int, act: Callable[[np.ndarray], tuple[Any, Any]]
) -> tuple[list[Any], np.ndarray, bool]:
    """What was kept of each step of an episode, the rewards, and whether the episode ended by itself."""
    obs, _ = env.reset(seed=seed)
    kept, rewards, terminated = [], [], False
    while not terminated and len(rewards) < horizon:
        action, row = act(np.asarray(obs, np.float32))
        obs, reward, terminated, _, _ = env.step(action)
        kept.append(row)
        rewards.append(reward)
    return kept, np.array(rewards, np.float32), terminated


def padded(rows: list[Any], rewards: np.ndarray, horizon: int) -> Transitions:
    """The transitions of an episode, its last step without a successor."""
    missing = horizon - len(rewards)
    kept = jax.tree.map(lambda *leaves: np.stack([*leaves, *[leaves[0]] * missing]), *rows)
    valid = np.arange(horizon) < len(rewards)
    done = np.arange(horizon) >= len(rewards) - 1
    return Transitions(kept, np.pad(rewards, (0, missing)), done, valid)


def learner(improve: Any, warm_up: int) -> Learn:
    """``(key, state, new) -> state`` after one update for each new transition, as ``tell`` has them."""

    def learn(key: jax.Array, state: Any, new: Transitions) -> Any:
        state = state._replace(replay=remember(state.replay, new))
        num = jnp.where(state.replay.size >= warm_up, new.valid.sum(), 0)
        keys = jax.random.split(key, len(new.valid))
        return jax.lax.fori_loop(0, num, lambda i, state: improve(keys[i], state), state)

    return jax.jit(learn)


def test_q_learning_balances_the_pole() -> None:
    """100,000 steps of CartPole; random actions last 22 steps, the limit is 500."""
    horizon, steps = 500, 100_000
    config = CommandConfig(
        **{**SIDE, "horizon": horizon}, embed_dim=4, num_layers=1, num_heads=1,
        commands=((0.0,) * 7, (1.0,) * 7), skill_steps=1,
    )  # fmt: skip
    hyper = PtgmHyper(kl=0.0, discount=0.99, learning_rate=5e-4, target_interval=200)
    ptgm = Ptgm(Setting(ENV, config, steps // horizon + 1, Judgement()), None, hyper)
    learn = learner(ptgm._update, 1_000)
    state = ptgm.init(jax.random.key(0), jnp.zeros(config.goal_dim))
    env, rng = gymnasium.make("CartPole-v1").unwrapped, np.random.default_rng(0)
    scale = np.array([0.4, 0.7, 5.0, 0.7], np.float32)

    def actor(params: Any, epsilon: float) -> Callable[[np.ndarray], tuple[int, KeptGoal]]:
        params = jax.device_get(params)

        def act(obs: np.ndarray) -> tuple[int, KeptGoal]:
            seen = obs * scale
            best = int(mlp(params, seen).argmax())
            action = int(rng.integers(2)) if rng.random() < epsilon else best
            return action, KeptGoal(seen, np.int32(action), np.float32(0))

        return act

    done, episode, judged = 0, 0, []
    while done < steps - horizon:
        epsilon = max(0.05, 1 - done / 10_000)
        kept, rewards, _ = played(env, episode, horizon, actor(state.params, epsilon))
        state = learn(jax.random.key(episode), state, padded(kept, rewards, horizon))
        done, episode = done + len(rewards), episode + 1
        if episode % 50 == 0:
            greedy = actor(state.params, 0.0)
            returns = [played(env, 10_000 + i, horizon, greedy)[1].sum() for i in range(10)]
            judged.append(np.mean(returns))
    assert np.median(judged[-5:]) > 300


def test_the_actor_critic_swings_the_pendulum_up() -> None:
    """10,000 steps of Pendulum; random actions cost about 1,200 in an episode of 200 steps."""
    horizon, steps, width = 200, 10_000, 64
    config = SkillConfig(
        **{**SIDE, "horizon": horizon}, embed_dim=width, num_layers=2, skill_steps=1, latent_dim=1
    )
    params = skills.init(jax.random.key(0), config)
    head = jax.tree.map(jnp.zeros_like, params["params"]["prior_head"])
    last = f"Dense_{len(head) - 1}"
    head[last]["bias"] = jnp.array([0.0, np.log(5.0)])  # a wide Gaussian everywhere
    blank = {"params": {**params["params"], "prior_head": head}}
    hyper = SpirlHyper(
        target_divergence=2.5, alpha=0.2, discount=0.95, learning_rate=1e-3, warmup_episodes=0
    )
    spirl = Spirl(Setting(ENV, config, steps // horizon + 1, Judgement()), blank, hyper)
    learn = learner(spirl._update, 1_000)
    state = spirl.init(jax.random.key(0), jnp.zeros(config.goal_dim))
    # An actor of zeros learns nothing: it starts as any network does, not as the prior.
    fresh = {"params": skills.init(jax.random.key(1), config)["params"]["prior_head"]}
    state = state._replace(weights=state.weights._replace(actor=fresh))
    env, rng = gymnasium.make("Pendulum-v1").unwrapped, np.random.default_rng(0)

    def actor(params: Any, noise: float) -> Callable[[np.ndarray], tuple[np.ndarray, KeptLatent]]:
        params = jax.device_get(params)

        def act(obs: np.ndarray) -> tuple[np.ndarray, KeptLatent]:
            seen = np.zeros(width, np.float32)
            seen[:3] = obs / [1, 1, 8]
            mean, log_std = mlp(params, seen)
            std = np.exp(np.clip(log_std, skills.MIN_LOG_STD, skills.MAX_LOG_STD))
            latent = np.array([mean + noise * std * rng.standard_normal()], np.float32)
            return np.clip(2 * latent, -2, 2), KeptLatent(seen, latent)

        return act

    for episode in range(steps // horizon):
        kept, rewards, _ = played(env, episode, horizon, actor(state.weights.actor, 1.0))
        state = learn(jax.random.key(episode), state, padded(kept, rewards / 8, horizon))
    still = actor(state.weights.actor, 0.0)
    judged = np.mean([played(env, 10_000 + i, horizon, still)[1].sum() for i in range(10)])
    assert judged > -250


CART = 100  # steps of an episode; the return is their number


def observed(moment: Moment) -> np.ndarray:
    """The state of the cart and its pole, in numbers of about 1."""
    return np.asarray(moment.obs * [0.4, 0.7, 5.0, 0.7], np.float32)


BALANCE = GymnasiumWorld(
    name="balance",
    make=lambda: gymnasium.make("CartPole-v1", max_episode_steps=CART),
    return_range=(0.0, float(CART)),
    horizon=CART,
    options=lambda rng: {"low": np.float32(-0.05), "high": np.float32(0.05)},
    deterministic=False,
    observe=observed,
    achieved=lambda moment: [0.0],
    desired=lambda moment: [0.0],
).world()


@pytest.mark.parametrize(
    ("method", "hyper", "least"),
    [
        ("ppo", PpoHyper(learning_rate=1e-3, value_rate=3e-3, clip_norm=1.0), 60),
        ("reinforce", ReinforceHyper(learning_rate=2e-3, clip_norm=1.0, baseline=True), 40),
    ],
)
def test_finetuning_from_nothing_balances_the_pole(method: str, hyper: Any, least: float) -> None:
    """Random actions last 22 steps."""
    env = BALANCE.make()
    network = network_config(
        env.spec, embed_dim=32, num_layers=1, num_heads=2, max_prompt_length=1, tokens_per_step=1
    )
    policy = LoadedPolicy(network, initial_params(jax.random.key(0), network), {})
    tasks = mgpo_jax.sample_tasks(env, seed=1, num=1)
    done = mgpo_jax.adapt(
        BALANCE, policy, tasks, method, hyper=hyper, seeds=2, episodes=400, eval_every=400
    )
    assert done.returns[..., -100:].mean() > least > 1.5 * done.returns[..., :20].mean()
