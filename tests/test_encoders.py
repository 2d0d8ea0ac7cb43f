"""Encoders: observations of any shape and dtype, from a dataset's file to the action."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.errors import UsageError
from envs.maze.env import MazeRunner
from envs.specs import ArraySpec, ObsLayout
from envs.wrappers import Noisy, Wrapper
from mgpo_jax.dataset import BatchPlan, Dataset, load_dataset, save_dataset
from mgpo_jax.losses import bc_loss
from mgpo_jax.network_configs import TransformerConfig, network_config
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.prompts import Prompt
from mgpo_jax.runner import adapt
from mgpo_jax.settings import ENCODERS, TrainConfig
from mgpo_jax.sharding import device_mesh
from mgpo_jax.tasks import sample_tasks
from mgpo_jax.training import Trainer, batch_stream
from mgpo_jax.transformer import GoalTransformer, grow_cache

HORIZON, NUM_SLOTS = 6, 3
PICTURES = TransformerConfig(
    obs_shape=(3, 3), obs_dtype="uint8", goal_dim=2, action_dim=3, horizon=HORIZON,
    max_prompt_length=NUM_SLOTS, embed_dim=16, num_layers=1, dropout=0.0,
)  # fmt: skip
FLAT = replace(PICTURES, obs_shape=(9,), obs_dtype="float32")


@pytest.mark.parametrize("lead", [(), (4,), (2, 3)])
def test_the_linear_encoder_is_a_dense_layer_on_all_numbers(lead):
    """With the same weights by the same names, so that policies trained with the one act with the other."""
    rng = np.random.default_rng(0)
    params = {
        "params": {
            "kernel": jnp.asarray(rng.normal(size=(6, 5)), jnp.float32),
            "bias": jnp.asarray(rng.normal(size=5), jnp.float32),
        }
    }
    flat = jnp.asarray(rng.normal(size=(*lead, 6)), jnp.float32)
    expected = nn.Dense(5).apply(params, flat)
    for shape in ((6,), (2, 3), (3, 1, 2)):
        encoder = ENCODERS.find("linear").make(shape, 5, None)
        obs = flat.reshape(*lead, *shape)
        np.testing.assert_array_equal(encoder.apply(params, obs), expected)
        # Initial weights are drawn in the same way, too.
        key = jax.random.key(1)
        jax.tree.map(
            np.testing.assert_array_equal, encoder.init(key, obs), nn.Dense(5).init(key, flat)
        )


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, bool])
def test_integers_count_as_they_are(dtype):
    obs = np.random.default_rng(0).integers(0, 2 if dtype is bool else 200, (4, 2, 3)).astype(dtype)
    encoder = ENCODERS.find("linear").make((2, 3), 5, None)
    params = encoder.init(jax.random.key(0), jnp.asarray(obs))
    found = encoder.apply(params, jnp.asarray(obs))
    assert found.dtype == jnp.float32
    expected = obs.reshape(4, 6).astype(np.float64) @ np.asarray(params["params"]["kernel"])
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-3)


LAYOUTS = {
    "digits": ObsLayout(num_cells=6, code_sizes=(5, 2, 3), num_counts=2, max_count=4),
    "whole codes": ObsLayout(num_cells=6, code_sizes=(30,), num_counts=2, max_count=4),
}


def coded(layout, lead, seed=0):
    """Observations of codes and counts, followed by three numbers."""
    rng = np.random.default_rng(seed)
    codes = rng.integers(np.prod(layout.code_sizes), size=(*lead, layout.num_cells))
    counts = rng.integers(layout.max_count + 1, size=(*lead, layout.num_counts))
    numbers = rng.normal(size=(*lead, 3))
    return jnp.asarray(np.concatenate([codes, counts, numbers], axis=-1), jnp.float32)


def one_hots(obs, layout):
    """One observation with its codes, digit by digit, and its counts as one-hots."""
    parts = []
    for code in obs[: layout.num_cells].astype(int):
        rest = code
        for size in layout.code_sizes:
            rest, digit = divmod(rest, size)
            parts.append(np.eye(size)[digit])
    num_coded = layout.num_cells + layout.num_counts
    for count in obs[layout.num_cells : num_coded].astype(int):
        parts.append(np.eye(layout.max_count + 1)[count])
    return np.concatenate([*parts, obs[num_coded:]])


def dense_kernel(params):
    """The weights of the same linear layer on one-hots."""
    parts = params["params"]
    rows = [parts[name].reshape(-1, parts[name].shape[-1]) for name in ("cells", "counts")]
    return jnp.concatenate([*rows, parts["kernel"]]), parts["bias"]


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("lead", [(), (4,), (2, 3)])
@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_cells_are_a_dense_layer_on_one_hots(monkeypatch, layout, lead, backend):
    """Its values, and its gradient with respect to the weights, as CPUs and accelerators compute them."""
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    obs = coded(layout, lead)
    encoder = ENCODERS.find("cells").make((11,), 5, layout)
    params = encoder.init(jax.random.key(0), obs)
    rows = np.stack([one_hots(row, layout) for row in np.asarray(obs).reshape(-1, 11)])
    kernel, bias = dense_kernel(params)
    expected = (rows @ kernel + bias).reshape(*lead, 5)
    np.testing.assert_allclose(encoder.apply(params, obs), expected, rtol=1e-5, atol=1e-6)
    weights = np.random.default_rng(1).normal(size=(*lead, 5)).astype(np.float32)
    grads = jax.grad(lambda params: (encoder.apply(params, obs) * weights).sum())(params)
    kernel, bias = dense_kernel(grads)
    np.testing.assert_allclose(kernel, rows.T @ weights.reshape(-1, 5), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(bias, weights.reshape(-1, 5).sum(axis=0), rtol=1e-5, atol=1e-6)


def test_codes_and_counts_are_rounded_into_their_range():
    """As noise on observations leaves them; the numbers beside them stay as they are."""
    layout = LAYOUTS["digits"]
    encoder = ENCODERS.find("cells").make((11,), 5, layout)
    obs = coded(layout, (4,))
    params = encoder.init(jax.random.key(0), obs)
    apply = jax.jit(encoder.apply)
    blurred = obs + np.where(np.arange(11) < 8, 0.4, 0.0)
    np.testing.assert_array_equal(apply(params, blurred), apply(params, obs))
    largest = np.where(np.arange(11) < 6, 29, np.where(np.arange(11) < 8, 4, obs))
    beyond = np.where(np.arange(11) < 8, largest + 7, obs)
    np.testing.assert_array_equal(apply(params, beyond), apply(params, largest))
    # A layout without numbers, counts or cells is one, too.
    for cells, counts in ((11, 0), (0, 11), (4, 7)):
        all_coded = replace(layout, num_cells=cells, num_counts=counts)
        whole = ENCODERS.find("cells").make((11,), 5, all_coded)
        zeros = jnp.zeros((2, 11))
        assert whole.apply(whole.init(jax.random.key(0), zeros), zeros).shape == (2, 5)


def coded_config(**changes):
    layout = LAYOUTS["digits"]
    return replace(FLAT, obs_shape=(11,), encoder="cells", obs_layout=layout, **changes)


@pytest.mark.parametrize("tokens", [2, 1])
def test_cells_in_the_network_step_by_step_as_in_the_full_pass(tokens):
    config = coded_config(tokens_per_step=tokens)
    params, (prompt, _, actions) = params_of(config), inputs()
    obs = coded(config.obs_layout, (HORIZON,))
    policy = LoadedPolicy(config, params, {}).policy
    distribution, carry = policy.prefill(prompt, obs[0])
    carry, steps = policy.grow(carry, HORIZON - 1), [distribution.logits]
    for time in range(1, HORIZON):
        distribution, carry = policy.decode(carry, actions[time - 1], obs[time])
        steps.append(distribution.logits)
    expected = GoalTransformer(config).apply(params, prompt, obs, actions).logits
    np.testing.assert_allclose(jnp.stack(steps), expected, rtol=1e-4, atol=1e-5)


def test_worlds_without_a_layout_have_no_cells():
    maze = MazeRunner(name="maze15", side=15, horizon=64).spec
    with pytest.raises(
        UsageError, match=r"--encoder cells embeds codes .* maze15 are float32\[6\]"
    ):
        network_config(maze, encoder="cells")
    spec = replace(maze, obs=ArraySpec((11,)), layout=LAYOUTS["digits"])
    assert network_config(spec, encoder="cells").obs_layout == LAYOUTS["digits"]
    assert network_config(spec).obs_layout is None
    with pytest.raises(UsageError, match="layout of its observations must describe a flat"):
        network_config(replace(spec, obs=ArraySpec((7,))), encoder="cells")


def test_noise_on_codes_is_refused():
    config = coded_config()
    data = replace(DATASET, obs=np.asarray(coded(config.obs_layout, (len(DATASET.obs),))))
    with pytest.raises(UsageError, match="--obs-noise does not apply to --encoder cells"):
        Trainer(TrainConfig(obs_noise=0.1), config, data, device_mesh(1))


def params_of(config, scale=0.4):
    prompt = Prompt(jnp.zeros((NUM_SLOTS, config.goal_dim)), jnp.ones(NUM_SLOTS, bool))
    obs = jnp.zeros((2, *config.obs_shape), config.obs_dtype)
    init = GoalTransformer(config).init
    shapes = jax.eval_shape(init, jax.random.key(0), prompt, obs, jnp.zeros(2, jnp.int32))
    rng = np.random.default_rng(0)
    return jax.tree.map(
        lambda leaf: jnp.asarray(scale * rng.standard_normal(leaf.shape), leaf.dtype), shapes
    )


def inputs():
    rng = np.random.default_rng(3)
    prompt = Prompt(jnp.asarray(rng.random((3, 2)), jnp.float32), jnp.array([False, True, True]))
    obs = jnp.asarray(rng.integers(0, 5, (HORIZON, 3, 3)), jnp.uint8)
    return prompt, obs, jnp.asarray(rng.integers(0, 3, HORIZON), jnp.int32)


@pytest.mark.parametrize("standardized", [False, True])
def test_bytes_of_any_shape_go_through_the_network(standardized):
    """In the full pass and step by step, exactly like the same numbers in a row."""
    scales = {}
    if standardized:
        scales = {"obs_mean": tuple(np.linspace(1, 3, 9).tolist()), "obs_std": (0.5,) * 9}
    pictures, flat = replace(PICTURES, **scales), replace(FLAT, **scales)
    params, (prompt, obs, actions) = params_of(pictures), inputs()
    rows = obs.reshape(HORIZON, 9).astype(jnp.float32)

    def passes(config, obs):
        network = GoalTransformer(config)
        distribution, cache = network.apply(params, prompt, obs[0], method="prefill")
        cache, steps = grow_cache(cache, 2 * HORIZON), [distribution]
        for time in range(1, HORIZON):
            distribution, cache = network.apply(
                params, cache, actions[time - 1], obs[time], method="decode"
            )
            steps.append(distribution)
        stepwise = jnp.stack([step.logits for step in steps])
        return network.apply(params, prompt, obs, actions).logits, stepwise

    full, stepwise = jax.jit(lambda obs: passes(pictures, obs))(obs)
    expected, _ = jax.jit(lambda obs: passes(flat, obs))(rows)
    np.testing.assert_allclose(full, expected, atol=1e-5)
    np.testing.assert_allclose(stepwise, full, atol=1e-5)
    assert np.ptp(full, axis=0).max() > 0.1


def make_dataset():
    """The action is the entry of the picture's first row that is set: easy to learn."""
    rng = np.random.default_rng(0)
    lengths = np.array([6, 2, 5, 1, 4, 6, 3, 6], np.int32)
    total = int(lengths.sum())
    actions = rng.integers(3, size=total).astype(np.int32)
    obs = rng.integers(0, 3, (total, 3, 3)).astype(np.uint8)
    obs[:, 0] = 2 * np.eye(3, dtype=np.uint8)[actions]
    goals = rng.random((total, 2)).astype(np.float32)
    return Dataset(
        obs=obs,
        actions=actions,
        achieved_goals=goals,
        goal_reached=np.ones(total, bool),
        outcomes=goals,
        lengths=lengths,
    )


DATASET = make_dataset()
WHOLE = BatchPlan(np.arange(8), DATASET.lengths, HORIZON)
CONFIG = TrainConfig(
    steps=40,
    batch_size=8,
    part_size=4,
    bucket=HORIZON,
    optimizer="adamw",
    learning_rate=2e-2,
    warmup_steps=2,
)


def test_bytes_stay_bytes_from_the_file_to_the_network(tmp_path):
    save_dataset(tmp_path / "data", DATASET, {})
    loaded, _ = load_dataset(tmp_path / "data")
    assert loaded.obs.dtype == np.uint8
    batch = next(batch_stream(CONFIG, loaded, truncate=True))
    for plan in batch:
        part = loaded.gather(*plan)
        assert part.obs.dtype == np.uint8
        assert part.obs.shape[2:] == (3, 3)


def test_the_loss_is_that_of_the_same_numbers_in_a_row():
    params = params_of(PICTURES)
    rows = replace(DATASET, obs=DATASET.obs.reshape(-1, 9).astype(np.float32))
    losses = []
    for config, dataset in ((PICTURES, DATASET), (FLAT, rows)):
        network, batch = GoalTransformer(config), dataset.gather(*WHOLE)

        @jax.jit
        @jax.vmap
        def loss(one, network=network):
            return bc_loss(params, jax.random.key(1), network, one)[0]

        losses.append(loss(batch))
    np.testing.assert_allclose(*losses, rtol=1e-5)


def test_training_on_bytes():
    """It learns from them; noise on observations is for floats."""
    trainer = Trainer(CONFIG, PICTURES, DATASET, device_mesh(1))
    state = trainer.init()
    before = trainer.evaluate(state.params, [WHOLE])
    for plans in islice(batch_stream(CONFIG, DATASET, True), 40):
        state, _ = trainer.step(state, plans)
    after = trainer.evaluate(state.params, [WHOLE])
    assert after["loss"] < 0.5 * before["loss"]
    assert after["accuracy"] > 0.9
    with pytest.raises(UsageError, match=r"--obs-noise needs floating-point .* are uint8"):
        Trainer(replace(CONFIG, obs_noise=0.1), PICTURES, DATASET, device_mesh(1))


@dataclass(frozen=True)
class Seen(Wrapper):
    """A maze whose observations are a picture of two rows of bytes."""

    @property
    def spec(self):
        return replace(self.env.spec, obs=ArraySpec((2, 3), "uint8"))

    def reset(self, key, task):
        return self._draw(*self.env.reset(key, task))

    def step(self, state, action):
        return self._draw(*self.env.step(state, action))

    def _draw(self, state, timestep):
        picture = jnp.round(7 * timestep.obs).astype(jnp.uint8).reshape(2, 3)
        return state, timestep._replace(obs=picture)


def test_adaptation_in_a_world_of_bytes():
    """It is the same as in a world that tells the same numbers in a row."""
    inner = MazeRunner(name="tiny", side=7, horizon=8)

    @dataclass(frozen=True)
    class Rows(Seen):
        @property
        def spec(self):
            return replace(self.env.spec, obs=ArraySpec((6,)))

        def _draw(self, state, timestep):
            return state, timestep._replace(obs=jnp.round(7 * timestep.obs))

    options = {"seeds": 1, "episodes": 4, "eval_every": 4}
    outcomes = []
    for env in (Seen(inner), Rows(inner)):
        config = network_config(
            env.spec, max_prompt_length=NUM_SLOTS, embed_dim=8, num_layers=1, dropout=0.0
        )
        policy = LoadedPolicy(config, params_of(config), {})
        outcomes.append(adapt(env, policy, sample_tasks(env, 5, 3), "ucb", **options))
    seen, rows = outcomes
    np.testing.assert_array_equal(seen.actions, rows.actions)
    np.testing.assert_allclose(seen.returns, rows.returns, atol=1e-6)
    assert len(np.unique(seen.actions)) > 2
    with pytest.raises(ValueError, match=r"needs floating-point observations, .* uint8\[2, 3\]"):
        Noisy(Seen(inner), obs_noise=0.1)
