"""The Transformer: causality, padding, the cache against the full pass, sizes, dropout."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mgpo_jax.transformer
from mgpo_jax.network_configs import TransformerConfig
from mgpo_jax.prompts import Prompt
from mgpo_jax.transformer import GoalTransformer, grow_cache

T, P = 8, 3
CONFIG = TransformerConfig(
    obs_shape=(3,),
    goal_dim=2,
    action_dim=4,
    horizon=T,
    max_prompt_length=P,
    embed_dim=16,
    num_layers=2,
    dropout=0.0,
)
GAUSSIAN = replace(CONFIG, head="gaussian")
SUMMED = replace(CONFIG, tokens_per_step=1)


def make_inputs(config, seed=0):
    key_goals, key_obs, key_actions = jax.random.split(jax.random.key(seed), 3)
    prompt = Prompt(
        jax.random.normal(key_goals, (P, config.goal_dim)), jnp.array([False, True, True])
    )
    obs = jax.random.normal(key_obs, (T, *config.obs_shape))
    if config.head == "categorical":
        actions = jax.random.randint(key_actions, (T,), 0, config.action_dim)
    else:
        actions = jax.random.uniform(key_actions, (T, config.action_dim), minval=-1.0)
    return prompt, obs, actions


def make_params(config):
    """Random weights, larger than the initial ones, with which little would depend on anything."""
    init = GoalTransformer(config).init
    shapes = jax.eval_shape(init, jax.random.key(0), *make_inputs(config))
    rng = np.random.default_rng(0)
    return jax.tree.map(
        lambda leaf: jnp.asarray(0.4 * rng.standard_normal(leaf.shape), leaf.dtype), shapes
    )


def make_full(config):
    """The parameters of the action distributions of all steps, as one array."""
    network = GoalTransformer(config)
    return lambda *inputs: jnp.concatenate(network.apply(*inputs), axis=-1)


def test_standardized_observations():
    """The same as standardizing first; what lies far out counts as five deviations."""
    params = make_params(CONFIG)
    mean, std = (0.5, -1.0, 2.0), (0.5, 2.0, 0.1)
    prompt, obs, actions = make_inputs(CONFIG)
    raw = (obs * jnp.array(std) + jnp.array(mean)).at[3, 1].set(1e4)
    standardizing = make_full(replace(CONFIG, obs_mean=mean, obs_std=std))
    expected = make_full(CONFIG)(params, prompt, obs.at[3, 1].set(5.0), actions)
    np.testing.assert_allclose(
        standardizing(params, prompt, raw, actions), expected, rtol=1e-4, atol=1e-4
    )


@pytest.fixture(scope="module")
def params():
    """The same for one token a step, whose weights have the same names and shapes."""
    return make_params(CONFIG)


@pytest.fixture(scope="module", params=[2, 1], ids=["two tokens a step", "one token a step"])
def config(request):
    return replace(CONFIG, tokens_per_step=request.param)


@pytest.fixture(scope="module")
def full(config):
    return jax.jit(make_full(config))


def changed_steps(before, after):
    return np.flatnonzero(np.abs(np.asarray(before - after)).max(axis=-1) > 0)


@pytest.mark.parametrize("t", [0, 3, T - 1])
def test_the_past_does_not_see_the_future(params, full, t):
    prompt, obs, actions = make_inputs(CONFIG)
    before = full(params, prompt, obs, actions)
    after = full(params, prompt, obs.at[t].add(1.0), actions)
    np.testing.assert_array_equal(changed_steps(before, after), np.arange(t, T))
    after = full(params, prompt, obs, actions.at[t].set((actions[t] + 1) % 4))
    np.testing.assert_array_equal(changed_steps(before, after), np.arange(t + 1, T))


@pytest.mark.parametrize("tokens", [2, 1])
def test_gradients_are_causal(tokens):
    config = replace(GAUSSIAN, tokens_per_step=tokens)
    params = make_params(config)
    prompt, obs, actions = make_inputs(config)

    @jax.jit
    @lambda f: jax.jacrev(f, argnums=(0, 1, 2))
    def jacobians(goals, obs, actions):
        return make_full(config)(params, prompt._replace(goals=goals), obs, actions).mean(axis=-1)

    goals, obs, actions = (
        np.abs(jac).max(axis=-1) > 0 for jac in jacobians(prompt.goals, obs, actions)
    )
    steps = np.arange(T)
    np.testing.assert_array_equal(obs, steps[:, None] >= steps)
    np.testing.assert_array_equal(actions, steps[:, None] > steps)
    np.testing.assert_array_equal(goals, np.broadcast_to(prompt.mask, (T, P)))


def test_masked_slots_have_no_influence(params, full):
    prompt, obs, actions = make_inputs(CONFIG)
    other = prompt._replace(goals=prompt.goals.at[0].set(jnp.array([50.0, -60.0])))
    np.testing.assert_array_equal(
        full(params, prompt, obs, actions), full(params, other, obs, actions)
    )


def test_appended_steps_have_no_influence(params, full):
    prompt, obs, actions = make_inputs(CONFIG)
    short = full(params, prompt, obs[:5], actions[:5])
    junk = full(params, prompt, obs.at[5:].set(9.0), actions.at[5:].set(0))
    np.testing.assert_allclose(short, junk[:5], atol=1e-5)


def test_one_token_a_step_is_the_sum_of_both_embeddings():
    """Without blocks, the output at step t is a function of a_{t-1}, o_t and t alone."""
    config = replace(SUMMED, num_layers=0)
    params = make_params(config)
    prompt, obs, actions = make_inputs(config)
    weights = params["params"]

    def dense(name, rows):
        return rows @ weights[name]["kernel"] + weights[name]["bias"]

    def norm(name, rows):
        rows = (rows - rows.mean(-1, keepdims=True)) / np.sqrt(rows.var(-1, keepdims=True) + 1e-6)
        return rows * weights[name]["scale"] + weights[name]["bias"]

    done = dense("embed_action", np.eye(4)[np.asarray(actions)])
    tokens = np.array(dense("embed_obs", obs) + weights["embed_time"])
    tokens[1:] += done[:-1]
    expected = dense("head", norm("norm_out", norm("norm_in", tokens)))
    found = jax.jit(make_full(config))(params, prompt, obs, actions)
    np.testing.assert_allclose(found[P:], expected, atol=1e-4)  # no block has left the goals out


def test_the_number_of_tokens_of_some_steps():
    assert [CONFIG.num_step_tokens(steps) for steps in (1, 2, 8)] == [1, 3, 15]
    assert [SUMMED.num_step_tokens(steps) for steps in (1, 2, 8)] == [1, 2, 8]


def test_one_token_a_step_needs_no_other_weights():
    shapes = [jax.eval_shape(lambda c=c: make_params(c)) for c in (CONFIG, SUMMED)]
    assert shapes[0] == shapes[1]


@pytest.mark.parametrize(
    ("head", "num_heads", "prompt_order", "tokens"),
    [
        ("categorical", 1, True, 2),
        ("categorical", 2, False, 2),
        ("gaussian", 1, False, 2),
        ("gaussian", 2, True, 2),
        ("categorical", 2, True, 1),
        ("gaussian", 1, False, 1),
    ],
)
def test_prefill_and_decode_equal_the_full_pass(head, num_heads, prompt_order, tokens):
    config = replace(
        CONFIG, head=head, num_heads=num_heads, prompt_order=prompt_order, tokens_per_step=tokens
    )
    network = GoalTransformer(config)
    params = make_params(config)

    def cached(prompt, obs, actions):
        first, cache = network.apply(params, prompt, obs[0], method="prefill")

        def step(cache, inputs):
            action, obs = inputs
            distribution, cache = network.apply(params, cache, action, obs, method="decode")
            return cache, distribution

        outputs = [jax.tree.map(lambda leaf: leaf[None], first)]
        # Room is made in unequal pieces, once more than is used.
        for start, end, room in ((1, 3, 2), (3, T, 6)):
            cache = grow_cache(cache, tokens * room)
            cache, more = jax.lax.scan(step, cache, (actions[start - 1 : end - 1], obs[start:end]))
            outputs.append(more)
        assert cache.keys[0].shape[1] == P + 1 + tokens * (2 + 6)
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *outputs), cache.step

    inputs = [make_inputs(config, seed) for seed in range(3)]
    inputs[1] = (inputs[1][0]._replace(mask=jnp.array([False, False, True])), *inputs[1][1:])
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *inputs)
    outputs, steps = jax.jit(jax.vmap(cached))(*batch)
    expected = jax.jit(jax.vmap(lambda *one: network.apply(params, *one)))(*batch)
    np.testing.assert_array_equal(steps, T)
    for found, wanted in zip(outputs, expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-5)


@pytest.mark.parametrize("block", [3, 5])
def test_query_blocks_do_not_change_the_result(params, config, full, monkeypatch, block):
    inputs = make_inputs(CONFIG)

    monkeypatch.setattr(mgpo_jax.transformer, "QUERY_BLOCK", block)
    # A new function: the one compiled with whole blocks must not be used again.
    in_blocks = jax.jit(make_full(config))(params, *inputs)
    np.testing.assert_allclose(in_blocks, full(params, *inputs), atol=1e-5)


@pytest.mark.parametrize(
    ("prompt_order", "num_layers", "order_matters"),
    [
        (True, 1, True),
        # One layer of attention sums over the goals. A second one sees what the causal mask did.
        (False, 1, False),
        (False, 2, True),
    ],
)
def test_order_of_the_prompt(prompt_order, num_layers, order_matters):
    config = replace(CONFIG, prompt_order=prompt_order, num_layers=num_layers)
    prompt, obs, actions = make_inputs(config)
    prompt = prompt._replace(mask=jnp.ones(P, bool))
    permuted = prompt._replace(goals=prompt.goals[jnp.array([1, 0, 2])])
    full = jax.jit(make_full(config))
    params = make_params(config)
    difference = full(params, prompt, obs, actions) - full(params, permuted, obs, actions)
    assert (np.abs(difference).max() > 1e-3) == order_matters


@pytest.mark.parametrize(("horizon", "head"), [(64, "categorical"), (500, "gaussian")])
def test_sizes_of_table_6(horizon, head):
    config = TransformerConfig((6,), 2, 5, horizon, head=head)
    network = GoalTransformer(config)
    float_ = lambda *shape: jax.ShapeDtypeStruct(shape, jnp.float32)  # noqa: E731
    prompt = Prompt(float_(5, 2), jax.ShapeDtypeStruct((5,), bool))
    actions = (
        jax.ShapeDtypeStruct((horizon,), jnp.int32) if head == "categorical" else float_(horizon, 5)
    )
    obs = float_(horizon, 6)
    params = jax.eval_shape(network.init, jax.random.key(0), prompt, obs, actions)
    outputs = jax.eval_shape(network.apply, params, prompt, obs, actions)
    assert all(output.shape == (horizon, 5) for output in outputs)
    count = sum(leaf.size for leaf in jax.tree.leaves(params))
    assert 0.57e6 < count - horizon * config.embed_dim < 0.63e6


def test_dropout_only_when_asked_for(params, config, full):
    inputs = make_inputs(config)
    network = GoalTransformer(replace(config, dropout=0.5))

    @jax.jit
    def noisy(seed):
        rngs = {"dropout": jax.random.key(seed)}
        return network.apply(params, *inputs, False, rngs=rngs).logits

    calm = full(params, *inputs)
    np.testing.assert_allclose(jax.jit(network.apply)(params, *inputs).logits, calm, atol=1e-6)
    assert np.abs(noisy(0) - noisy(1)).max() > 1e-3
    assert np.abs(noisy(0) - calm).max() > 1e-3
    np.testing.assert_array_equal(noisy(0), noisy(0))
