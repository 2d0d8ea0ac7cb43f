"""PTGM by PPO over clusters of goals: its prior, its rewards, its updates, and what it learns."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from test_finetune import NUM_STATES, Chain
from test_finetune import TASK as CHAIN_TASK
from test_ptgm import CONFIG, ENV, SETTING, episode_of, make_params, rule_of

from envs.errors import UsageError
from envs.registry import Judgement
from mgpo_jax import methods
from mgpo_jax.adaptation import search
from mgpo_jax.baselines import ptgm_ppo
from mgpo_jax.baselines.commanded import CommandConfig, View, log_prior
from mgpo_jax.baselines.hierarchy import Choice, LowLevel
from mgpo_jax.baselines.methods import PtgmPpoHyper
from mgpo_jax.baselines.ptgm_ppo import ClusteredPtgm, Kept
from mgpo_jax.baselines.returns import advantages
from mgpo_jax.methods import Setting
from mgpo_jax.network_configs import world_side

LINE = tuple((float(x), *[0.0] * (CONFIG.goal_dim - 1)) for x in (0, 1, 2, 10, 11, 12, 13, 30))
CLUSTERED = replace(SETTING, network=replace(CONFIG, commands=LINE))
"""Eight goals on a line, in three clusters."""
NUM, M = 3, ENV.spec.horizon // 3
SAMPLED = Choice(jnp.zeros((), bool))


@pytest.fixture(scope="module")
def params() -> Any:
    return make_params(CLUSTERED.network)


def learner(params: Any, setting: Setting = CLUSTERED, **changes: Any) -> ClusteredPtgm:
    return ClusteredPtgm(setting, params, PtgmPpoHyper(**{"clusters": NUM, **changes}))


def start_of(agent: ClusteredPtgm) -> Any:
    return agent.init(jax.random.key(0), jnp.zeros(CONFIG.goal_dim))


def moved(weights: Any) -> Any:
    """Weights that differ from the initial ones, with which little would depend on anything."""
    noise = lambda leaf: 0.3 * jax.random.normal(jax.random.key(leaf.size), leaf.shape)  # noqa: E731
    return jax.tree.map(lambda leaf: leaf + noise(leaf), weights)


@pytest.fixture(scope="module")
def view() -> View:
    return View(*jax.random.normal(jax.random.key(5), (2, CONFIG.embed_dim)))


def test_a_cluster_is_as_likely_as_its_goals(params, view):
    agent = learner(params)
    np.testing.assert_array_equal(agent.codes, [1, 4, 7])  # 1, 11 and 30
    p = np.exp(log_prior(CLUSTERED.network, params, view))
    wanted = [p[:3].sum(), p[3:7].sum(), p[7]]
    np.testing.assert_allclose(np.exp(agent.log_prior(view)), wanted, rtol=1e-5)


@pytest.mark.parametrize("as_prior", [True, False])
def test_it_starts_as_the_prior_or_uniformly(params, view, as_prior):
    agent = learner(params, starts_as_prior=as_prior)
    decide = rule_of(ptgm_ppo, agent, start_of(agent), SAMPLED)
    keys = jax.random.split(jax.random.key(2), 2_000)
    commands, kept = jax.jit(jax.vmap(lambda key: decide(key, view, None)))(keys)
    np.testing.assert_array_equal(commands, agent.codes[kept.cluster])
    np.testing.assert_array_equal(kept.seen[0], view.obs)
    np.testing.assert_allclose(kept.log_p[0], agent.log_prior(view), atol=1e-5)
    shares = np.bincount(kept.cluster, minlength=NUM) / len(keys)
    wanted = np.exp(agent.log_prior(view)) if as_prior else np.full(NUM, 1 / NUM)
    np.testing.assert_allclose(shares, wanted, atol=0.04)


def test_it_samples_in_the_search_and_is_judged_greedily(params, view):
    agent = learner(params)
    adapter, state = agent.adapter(), start_of(agent)
    assert not adapter.ask(jax.random.key(1), state)[0].greedy
    best = adapter.best(state)
    assert best.greedy
    decide = rule_of(ptgm_ppo, agent, state, best)
    found = {int(decide(jax.random.key(seed), view, None)[0]) for seed in range(5)}
    assert found == {int(agent.codes[np.argmax(agent.log_prior(view))])}


def made_up(num: int = 2) -> tuple[Any, Kept]:
    """Episodes of 7 steps, and of ``ENV.spec.horizon``, with a decision every third step."""
    rng = np.random.default_rng(0)
    kept = Kept(
        jnp.asarray(rng.standard_normal((num, M, CONFIG.embed_dim)), jnp.float32),
        jnp.asarray(rng.integers(0, NUM, (num, M))),
        jax.nn.log_softmax(jnp.asarray(rng.standard_normal((num, M, NUM)), jnp.float32)),
    )
    rewards = rng.standard_normal((num, ENV.spec.horizon)).astype(np.float32)
    lengths = [7] + [ENV.spec.horizon] * (num - 1)
    rewards[0, 7:] = 0
    rows = [
        episode_of(list(rewards[i]), lengths[i], jax.tree.map(lambda leaf, i=i: leaf[i], kept))
        for i in range(num)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows), kept


def test_a_round_by_hand(params):
    """The penalty is that of the policy that chose, and the loss is that of PPO over all decisions."""
    agent = learner(params, kl=0.25, discount=0.9, gae_lambda=0.8, value_weight=2.0)
    episodes, kept = made_up()
    weights = moved(start_of(agent).weights)
    round_ = jax.jit(agent.read)(weights, episodes)
    logits = agent.actor.apply(weights.actor, kept.seen) + kept.log_p
    log_pi = jax.nn.log_softmax(logits)
    away = jnp.sum(jnp.exp(log_pi) * (log_pi - kept.log_p), axis=-1)
    paid = episodes.rewards.reshape(2, M, 3).sum(axis=2) - 0.25 * away
    valid = np.arange(M) < np.array([[3], [M]])  # 7 steps have three decisions
    np.testing.assert_array_equal(round_.decisions.valid, valid)
    paid = jnp.where(valid, paid, 0)
    np.testing.assert_allclose(round_.decisions.reward, paid, atol=1e-4)
    values = agent.critic.apply(weights.critic, kept.seen)[..., 0]
    gains = jax.vmap(advantages, (0, 0, 0, None, None))(paid, values, jnp.asarray(valid), 0.9, 0.8)
    targets = np.asarray(gains + values)[valid]
    gains = np.asarray(gains)[valid]
    gains = (gains - gains.mean()) / gains.std()

    after = moved(weights)
    log_now = jax.nn.log_softmax(agent.actor.apply(after.actor, kept.seen) + kept.log_p)
    chosen = lambda log_p: np.take_along_axis(log_p, kept.cluster[..., None], 2)[..., 0][valid]  # noqa: E731
    ratio = np.exp(chosen(np.asarray(log_now)) - chosen(np.asarray(log_pi)))
    assert ratio.min() < 0.8 < 1.2 < ratio.max()
    gained = np.minimum(ratio * gains, np.clip(ratio, 0.8, 1.2) * gains)
    missed = np.asarray(agent.critic.apply(after.critic, kept.seen)[..., 0])[valid] - targets
    wanted = -gained.mean() + 2 * (missed**2).mean()
    np.testing.assert_allclose(jax.jit(agent.loss)(after, round_), wanted, rtol=1e-3)


def test_decisions_after_the_end_change_nothing(params):
    agent = learner(params)
    state, tell = start_of(agent), jax.jit(agent.tell)
    episodes, kept = made_up()
    noise = kept._replace(seen=kept.seen.at[0, 3:].add(9.0), cluster=kept.cluster.at[0, 3:].set(0))
    first, second = (
        tell(jax.random.key(0), state, SAMPLED, each).weights
        for each in (episodes, episodes._replace(decisions=noise))
    )
    jax.tree.map(np.testing.assert_array_equal, first, second)
    assert optax.tree.norm(optax.tree.sub(first, state.weights)) > 1e-3


def test_a_weight_of_zero_pays_nothing_for_leaving_the_prior(params):
    """From a uniform start, what the prior says then changes no bit."""
    episodes, kept = made_up()
    other = episodes._replace(decisions=kept._replace(log_p=kept.log_p[..., ::-1]))

    def told(episodes: Any, kl: float) -> Any:
        agent = learner(params, kl=kl, starts_as_prior=False)
        return jax.jit(agent.tell)(jax.random.key(0), start_of(agent), SAMPLED, episodes).weights

    first, second = told(episodes, 0.0), told(other, 0.0)
    jax.tree.map(np.testing.assert_array_equal, first, second)
    weighed = told(other, 0.5)
    assert optax.tree.norm(optax.tree.sub(first, weighed)) > 1e-4


def chain_learner(**changes: Any) -> ClusteredPtgm:
    """In a chain of five states, goal 1 is to go right and goal 0 left; a decision is a step."""
    chain = Chain()
    config = CommandConfig(
        **world_side(chain.spec, None, "linear"), embed_dim=16, num_layers=1, num_heads=1,
        dropout=0.0, skill_steps=1, commands=((0.0,), (1.0,)),
    )  # fmt: skip

    def view(obs: Any) -> tuple[View, tuple]:
        return View(jnp.pad(obs, (0, 16 - NUM_STATES)), jnp.zeros(16)), ()

    setting = Setting(chain, config, 200, Judgement())
    agent = learner(make_params(config), setting, clusters=None, learning_rate=0.01, **changes)
    agent.low = LowLevel(
        begin=view,
        proceed=lambda carry, action, obs: view(obs),
        command=lambda carry, decision: decision,
        act=lambda key, carry, orders, index: orders,
    )
    return agent


def test_a_chain_is_learned():
    adapter = chain_learner(kl=0.0).adapter()
    run = jax.jit(jax.vmap(lambda key: search(key, Chain(), adapter, CHAIN_TASK, 200).log.returns))
    returns = run(jax.random.split(jax.random.key(7), 4)).reshape(4, -1)
    assert returns[:, -20:].mean() > 0.95 > returns[:, :20].mean() + 0.1


def test_lanes_side_by_side_equal_lanes_alone():
    adapter, keys = (
        chain_learner(round_episodes=2).adapter(),
        jax.random.split(jax.random.key(1), 2),
    )
    run = lambda key: search(key, Chain(), adapter, CHAIN_TASK, 10).log.returns  # noqa: E731
    together, alone = jax.jit(jax.vmap(run))(keys), jax.jit(run)
    for lane in range(2):
        np.testing.assert_array_equal(together[lane], alone(keys[lane]))


def test_more_clusters_than_goals_are_refused():
    check = methods.find("ptgm-ppo").check_use
    says = r"^--clusters 9 exceeds the 8 distinct goals .*; with --clusters 8 each goal is its own"
    with pytest.raises(UsageError, match=says) as caught:
        check(CLUSTERED, PtgmPpoHyper(clusters=9))
    assert "\n" not in str(caught.value)
    twice = replace(CLUSTERED, network=replace(CLUSTERED.network, commands=LINE + LINE))
    with pytest.raises(UsageError, match="the 8 distinct goals"):
        check(twice, PtgmPpoHyper(clusters=9))
    check(twice, PtgmPpoHyper(clusters=8))


@pytest.mark.parametrize(("num", "wanted"), [(8, 8), (169, 50)])
def test_the_usual_number_of_clusters(num, wanted):
    config = replace(CONFIG, commands=tuple((float(i),) for i in range(num)))
    assert ptgm_ppo.num_clusters(config, PtgmPpoHyper()) == wanted
