"""The encoder that embeds Crafter's picture without drawing it, against a dense layer on the picture."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.errors import UsageError
from envs.specs import ObsLayout

pytest.importorskip("craftax")
from envs.crafter.encoding import TILE, Picture
from envs.crafter.tiles import agent_picture
from envs.crafter.view import (
    ASLEEP,
    LAYOUT,
    LIGHT,
    MAX_COUNT,
    NUM_BLOCKS,
    NUM_CELLS,
    NUM_CODES,
    NUM_COUNTS,
    OBS_SIZE,
    POSSIBLE,
)
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy import LoadedPolicy, transformer_policy
from mgpo_jax.prompts import Prompt, single_goal
from mgpo_jax.settings import ENCODERS
from mgpo_jax.transformer import GoalTransformer

WIDTH = 5


def observations(number=64, *, light=None, asleep=0.0, seed=0):
    """Random ones: any code that the rules can produce in any cell."""
    rng = np.random.default_rng(seed)
    obs = np.zeros((number, OBS_SIZE), np.float32)
    obs[:, :NUM_CELLS] = rng.choice(POSSIBLE, size=(number, NUM_CELLS))
    obs[:, NUM_CELLS:][:, :NUM_COUNTS] = rng.integers(MAX_COUNT + 1, size=(number, NUM_COUNTS))
    obs[np.arange(number), NUM_CELLS + NUM_COUNTS + rng.integers(4, size=number)] = 1
    obs[:, LIGHT] = rng.random(number) if light is None else light
    obs[:, ASLEEP] = asleep
    return jnp.asarray(obs)


@pytest.fixture(scope="module", params=["cpu", "gpu"])
def layer(request):
    """The encoder with random weights, and the dense layer with the same ones, both compiled.

    Once as CPUs compute it and once as accelerators do.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: request.param)
        yield compiled_layers()


def compiled_layers():
    encoder = Picture(WIDTH)
    params = encoder.init(jax.random.key(0), observations(1))
    kernel, bias = params["params"]["kernel"], jnp.arange(float(WIDTH))
    params = {"params": {"kernel": kernel, "bias": bias}}

    def dense(obs):
        shown = jax.vmap(agent_picture)(obs) / 255
        return shown.reshape(len(obs), -1) @ kernel.reshape(-1, WIDTH) + bias

    return jax.jit(encoder.apply), params, jax.jit(dense)


def test_at_full_light_it_is_a_dense_layer_on_the_picture(layer):
    encode, params, dense = layer
    obs = observations(light=1.0)
    np.testing.assert_allclose(encode(params, obs), dense(obs), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("asleep", "levels"), [(0.0, 1.0), (1.0, 1.5)])
def test_at_any_light_only_the_rounding_to_bytes_is_left_out(layer, asleep, levels):
    """Awake a byte is at most one level lower than its number; asleep gray is rounded, too."""
    encode, params, dense = layer
    obs = observations(asleep=asleep)
    found, expected = np.asarray(encode(params, obs)), np.asarray(dense(obs))
    most = levels / 255 * np.abs(params["params"]["kernel"]).sum(axis=(0, 1, 2))
    assert (np.abs(found - expected) < most).all()
    # Rounding goes down by half a level on average, which adds up to the same for all of them.
    offset = (found - expected).mean(axis=0)
    spread = np.abs(found - expected - offset).max()
    assert spread < 0.02 * np.asarray(expected).std()


def test_its_gradient_is_that_of_the_dense_layer(layer):
    encode, params, _ = layer
    obs, weights = (
        observations(8, light=1.0),
        jnp.asarray(np.random.default_rng(1).normal(size=(8, WIDTH))),
    )
    found = jax.grad(lambda params: (encode(params, obs) * weights).sum())(params)["params"]
    shown = np.asarray(jax.vmap(agent_picture)(obs)) / 255
    expected = np.einsum("bxyc,be->xyce", shown, weights)
    np.testing.assert_allclose(found["kernel"], expected, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(found["bias"], weights.sum(axis=0), rtol=1e-4, atol=1e-5)


def test_any_number_of_leading_axes(layer):
    encode, params, _ = layer
    obs = observations(6)
    flat = encode(params, obs)
    np.testing.assert_allclose(
        encode(params, obs.reshape(2, 3, -1)).reshape(6, -1), flat, rtol=1e-5
    )
    np.testing.assert_allclose(encode(params, obs[0]), flat[0], rtol=1e-4, atol=1e-5)


def test_prepared_parameters_make_the_same_tokens(layer):
    encode, params, _ = layer
    ready = {"params": ENCODERS.find("crafter-picture").prepare(params["params"])}
    assert "kernel" not in ready["params"]
    again = ENCODERS.find("crafter-picture").prepare(ready["params"])
    assert all(again[name] is ready["params"][name] for name in again)
    obs = observations(asleep=1.0)
    np.testing.assert_allclose(encode(ready, obs), encode(params, obs), rtol=1e-5, atol=1e-5)


def test_an_acting_agent_only_looks_up():
    """The products of weights and tiles belong to the policy, not to each of its steps."""
    spec = envs.make("crafter").spec
    config = network_config(spec, encoder="crafter-picture", embed_dim=8, num_heads=1)
    network, obs = GoalTransformer(config), jnp.zeros(OBS_SIZE)
    prompt = single_goal(jnp.ones(config.goal_dim), config.max_prompt_length)
    params = network.init(jax.random.key(0), prompt, obs[None], jnp.zeros(1, jnp.int32))
    policy = transformer_policy(config, params)
    carry = policy.grow(policy.prefill(prompt, obs)[1], 1)

    def decode(acting):
        step = partial(network.apply, acting, carry, jnp.int32(0), method="decode")
        return str(jax.make_jaxpr(lambda obs: step(obs)[0].logits)(obs))

    acts = str(jax.make_jaxpr(lambda obs: policy.decode(carry, jnp.int32(0), obs)[0].logits)(obs))
    assert f",{TILE}" in decode(params)
    assert f",{TILE}" not in acts


def test_other_observations_are_refused():
    record = ENCODERS.find("crafter-picture")
    assert isinstance(record.make((OBS_SIZE,), 8, LAYOUT), Picture)
    config = network_config(envs.make("crafter").spec, encoder="crafter-picture")
    assert config.obs_layout == LAYOUT
    with pytest.raises(
        UsageError, match=r"cannot be used in crafter-map: .* must be of 85 numbers, all"
    ):
        network_config(envs.make("crafter-map").spec, encoder="crafter-picture")
    other = ObsLayout(num_cells=2, code_sizes=(3,), num_counts=0, max_count=1)
    assert "must be that of Crafter's codes, found" in record.fault(other, (9,))
    with pytest.raises(UsageError, match=r"of maze15 are .* without a layout of them"):
        network_config(envs.make("maze15").spec, encoder="crafter-picture")


def test_codes_and_counts_are_rounded_into_their_range(layer):
    encode, params, _ = layer
    obs = observations(4)
    blurred = obs.at[:, : NUM_CELLS + NUM_COUNTS].add(0.4).at[:, ASLEEP].add(0.1)
    np.testing.assert_array_equal(encode(params, blurred), encode(params, obs))
    below, least = obs.at[:, :NUM_CELLS].set(-3.0), obs.at[:, :NUM_CELLS].set(0.0)
    np.testing.assert_array_equal(encode(params, below), encode(params, least))


def test_a_code_that_cannot_be_shows_its_block(layer):
    encode, params, _ = layer
    obs = observations(NUM_CODES).at[:, :NUM_CELLS].set(jnp.arange(float(NUM_CODES))[:, None])
    impossible = np.setdiff1d(np.arange(NUM_CODES), POSSIBLE)
    blocks = obs.at[:, :NUM_CELLS].set(obs[:, :NUM_CELLS] % NUM_BLOCKS)
    found, of_blocks = (np.asarray(encode(params, some)) for some in (obs, blocks))
    np.testing.assert_array_equal(found[impossible], of_blocks[impossible])
    seen = np.setdiff1d(POSSIBLE, np.arange(NUM_BLOCKS))
    assert (np.abs(found - of_blocks)[seen].max(axis=1) > 1e-3).all()


@pytest.mark.parametrize("tokens", [2, 1])
def test_in_the_network_step_by_step_as_in_the_full_pass(tokens):
    config = network_config(
        envs.make("crafter").spec, encoder="crafter-picture", tokens_per_step=tokens,
        max_prompt_length=2, embed_dim=8, num_layers=1, num_heads=2, dropout=0.0,
    )  # fmt: skip
    network, num_steps = GoalTransformer(config), 5
    prompt = Prompt(jnp.eye(22)[:2], jnp.ones(2, bool))
    obs, actions = observations(num_steps), jnp.arange(num_steps)
    params = jax.jit(network.init)(jax.random.key(0), prompt, obs, actions)
    whole = jax.jit(network.apply)(params, prompt, obs, actions).logits
    policy = LoadedPolicy(config, params, {}).policy
    distribution, carry = jax.jit(policy.prefill)(prompt, obs[0])
    carry, steps = policy.grow(carry, num_steps - 1), [distribution.logits]
    for time in range(1, num_steps):
        distribution, carry = jax.jit(policy.decode)(carry, actions[time - 1], obs[time])
        steps.append(distribution.logits)
    np.testing.assert_allclose(np.stack(steps), whole, rtol=1e-4, atol=1e-5)
