"""Pre-training: the loss by hand, gradients for any division of a batch, exact resume, schedules."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy import special, stats

from envs.base import Trajectory
from envs.errors import UsageError
from mgpo_jax.dataset import BatchPlan, Dataset
from mgpo_jax.distributions import Gaussian
from mgpo_jax.losses import bc_loss, blurred, stats_of
from mgpo_jax.network_configs import TransformerConfig
from mgpo_jax.prompts import hindsight_outcome, sample_prompt
from mgpo_jax.settings import TrainConfig
from mgpo_jax.sharding import device_mesh
from mgpo_jax.training import Trainer, TrainState, batch_stream
from mgpo_jax.transformer import GoalTransformer
from mgpo_jax.weight_updates import learning_rate_schedule, make_optimizer

HORIZON = 6
NETWORK = TransformerConfig(
    obs_shape=(3,), goal_dim=2, action_dim=3, horizon=HORIZON, max_prompt_length=3,
    embed_dim=16, num_layers=1, dropout=0.0,
)  # fmt: skip
# Buckets as long as the horizon: one shape, one compilation.
CONFIG = TrainConfig(
    steps=40, batch_size=8, part_size=4, bucket=HORIZON, learning_rate=1e-2, warmup_steps=2,
    clip_norm=1e9,
)  # fmt: skip


def make_dataset():
    """The action is the entry of the observation that is set: easy to learn."""
    rng = np.random.default_rng(0)
    lengths = np.array([6, 2, 5, 1, 4, 6, 3, 6], np.int32)
    total = int(lengths.sum())
    actions = rng.integers(3, size=total).astype(np.int32)
    goals = rng.random((total, 2)).astype(np.float32)
    return Dataset(
        obs=np.eye(3, dtype=np.float32)[actions],
        actions=actions,
        achieved_goals=goals,
        goal_reached=np.ones(total, bool),
        outcomes=goals,
        lengths=lengths,
        task_hashes=np.zeros(len(lengths), np.uint64),
    )


DATASET = make_dataset()
WHOLE = BatchPlan(np.arange(8), DATASET.lengths, HORIZON)


def parts_of(size):
    return [
        BatchPlan(WHOLE.indices[i : i + size], WHOLE.lengths[i : i + size], HORIZON)
        for i in range(0, 8, size)
    ]


@pytest.fixture(scope="module")
def noisy_trainer():
    """Dropout, random prompts, two devices."""
    return Trainer(CONFIG, replace(NETWORK, dropout=0.1), DATASET, device_mesh(2))


def run(trainer, state, num_steps):
    metrics = []
    stream = batch_stream(CONFIG, DATASET, True, num_devices=2, first_step=state.step)
    for plans in islice(stream, num_steps):
        state, metric = trainer.step(state, plans)
        metrics.append(jax.tree.map(float, metric))
    return state, metrics


def to_host(state):
    """What a checkpoint keeps; the step donates its buffers, so copies are needed."""
    return jax.tree.map(np.array, state)


def test_the_loss_falls_and_a_resumed_run_equals_an_uninterrupted_one(noisy_trainer):
    state, metrics = run(noisy_trainer, noisy_trainer.init(), 12)
    middle = to_host(state)
    state, more = run(noisy_trainer, state, 28)
    losses = [metric["loss"] for metric in metrics + more]
    assert state.step == 40
    assert np.mean(losses[-5:]) < 0.5 * losses[0]
    assert noisy_trainer.evaluate(state.params, [WHOLE])["accuracy"] > 0.9

    restored = jax.tree.map(jnp.asarray, (middle.params, middle.opt_state))
    resumed, again = run(noisy_trainer, TrainState(*restored, 12), 28)
    assert again == more
    jax.tree.map(np.testing.assert_array_equal, to_host(resumed), to_host(state))


def gradient(network, part_size, num_devices):
    """The gradient of the whole data set: AdamW's first moment is a tenth of the first one."""
    config = replace(CONFIG, part_size=part_size, optimizer="adamw")
    trainer = Trainer(config, network, DATASET, device_mesh(num_devices))
    state = trainer.init()
    params = to_host(state.params)
    state, metrics = trainer.step(state, parts_of(part_size))
    moments = state.opt_state[1][0].mu
    return params, jax.tree.map(lambda mu: 10 * np.asarray(mu), moments), metrics


@pytest.fixture(scope="module")
def one_goal():
    """Prompts of one goal: the only ones that do not depend on how a batch is divided."""
    network = replace(NETWORK, max_prompt_length=1)
    return network, gradient(network, 8, 1)


def test_the_gradient_is_that_of_the_mean_loss(one_goal):
    network, (params, found, metrics) = one_goal
    batch = DATASET.gather(*WHOLE)

    def mean_loss(params):
        one = lambda trajectory: bc_loss(  # noqa: E731
            params, jax.random.key(0), GoalTransformer(network), trajectory, True
        )[0]
        return jnp.sum(jax.vmap(one)(batch)) / DATASET.lengths.sum()

    loss, grads = jax.jit(jax.value_and_grad(mean_loss))(params)
    assert_close(found, ravel_pytree(grads)[0])
    np.testing.assert_allclose(metrics["loss"], loss, rtol=1e-5)
    assert metrics["num_steps"] == DATASET.lengths.sum()
    norm = np.sqrt(sum(np.sum(leaf**2) for leaf in jax.tree.leaves(grads)))
    np.testing.assert_allclose(metrics["grad_norm"], norm, rtol=1e-4)


def test_the_gradient_does_not_depend_on_parts(one_goal):
    network, (_, expected, metrics) = one_goal
    _, found, found_metrics = gradient(network, 2, 2)
    assert_close(found, expected)
    assert_close(found_metrics, metrics)


def test_the_gradient_does_not_depend_on_devices():
    """The same random prompts, whatever device draws them."""
    _, expected, metrics = gradient(NETWORK, 4, 1)
    _, found, found_metrics = gradient(NETWORK, 4, 2)
    assert_close(found, expected)
    assert_close(found_metrics, metrics)


EIGHT = """
import jax
assert jax.local_device_count() == 8
from test_training import NETWORK, assert_close, gradient
found = [gradient(NETWORK, 8, devices)[1:] for devices in (1, 2, 8)]
for one in found[1:]:
    assert_close(one, found[0])
"""


def test_the_gradient_does_not_depend_on_many_devices():
    """In a process of its own, since jax counts its devices only once."""
    root = Path(__file__).parents[1]
    ways = os.pathsep.join([str(root), str(root / "tests"), os.environ.get("PYTHONPATH", "")])
    flags = os.environ["XLA_FLAGS"].replace("device_count=2", "device_count=8")
    done = subprocess.run(
        [sys.executable, "-c", EIGHT],
        env={**os.environ, "PYTHONPATH": ways, "XLA_FLAGS": flags},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def assert_close(found, expected):
    check = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)  # noqa: E731
    jax.tree.map(check, found, expected)


@pytest.fixture(scope="module")
def loss_of():
    network = GoalTransformer(NETWORK)
    return jax.jit(lambda params, key, one: bc_loss(params, key, network, one, True))


@pytest.fixture(scope="module")
def params():
    rng = np.random.default_rng(0)
    trainer = Trainer(CONFIG, NETWORK, DATASET, device_mesh(1))
    shapes = jax.eval_shape(trainer.init).params
    return jax.tree.map(
        lambda leaf: jnp.asarray(0.3 * rng.standard_normal(leaf.shape), leaf.dtype), shapes
    )


def test_bc_loss_by_hand(loss_of, params):
    length = 4
    one = DATASET.gather(np.array([0]), np.array([length]), HORIZON)
    one = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), one)
    key = jax.random.key(5)
    nll, sums = loss_of(params, key, one)

    key_prompt, _ = jax.random.split(key)
    prompt = sample_prompt(key_prompt, one, hindsight_outcome(one), 3)
    logits = jax.jit(GoalTransformer(NETWORK).apply)(params, prompt, one.obs, one.actions).logits
    log_prob = special.log_softmax(np.asarray(logits, np.float64), axis=-1)
    actions = np.asarray(one.actions)
    expected = -sum(log_prob[t, actions[t]] for t in range(length))
    np.testing.assert_allclose(nll, expected, rtol=1e-5)
    np.testing.assert_allclose(sums.nll, expected, rtol=1e-5)
    assert sums.correct == (np.argmax(logits, axis=-1) == actions)[:length].sum()
    assert sums.num_steps == length


def test_intended_actions_are_labels_and_executed_ones_the_history(loss_of, params):
    length = 4
    one = DATASET.gather(np.array([0]), np.array([length]), HORIZON)
    one = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), one)
    key = jax.random.key(5)
    same = one._replace(intended=one.actions)
    jax.tree.map(
        np.testing.assert_array_equal, loss_of(params, key, same), loss_of(params, key, one)
    )
    noisy = one._replace(intended=(one.actions + 1) % 3)
    nll, sums = loss_of(params, key, noisy)
    key_prompt, _ = jax.random.split(key)
    prompt = sample_prompt(key_prompt, one, hindsight_outcome(one), 3)
    logits = jax.jit(GoalTransformer(NETWORK).apply)(params, prompt, one.obs, one.actions).logits
    log_prob = special.log_softmax(np.asarray(logits, np.float64), axis=-1)
    meant = np.asarray(noisy.intended)
    np.testing.assert_allclose(nll, -sum(log_prob[t, meant[t]] for t in range(length)), rtol=1e-5)
    assert sums.correct == (np.argmax(logits, axis=-1) == meant)[:length].sum()


def test_bc_loss_ignores_padding(loss_of, params):
    one = DATASET.gather(np.array([0]), np.array([4]), HORIZON)
    one = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), one)
    junk = one._replace(
        obs=one.obs.at[4:].set(7.0),
        actions=one.actions.at[4:].set(2),
        achieved_goals=one.achieved_goals.at[4:].set(-5.0),
        goal_reached=jnp.ones(HORIZON, bool),
        outcomes=one.outcomes.at[4:].set(9.0),
    )
    for seed in range(5):
        key = jax.random.key(seed)
        jax.tree.map(
            np.testing.assert_array_equal, loss_of(params, key, one), loss_of(params, key, junk)
        )


@pytest.mark.parametrize("schedule", ["cosine", "constant"])
def test_schedules(schedule):
    config = TrainConfig(steps=1000, warmup_steps=100, learning_rate=0.5, schedule=schedule)
    rate = learning_rate_schedule(config)
    at = [float(rate(step)) for step in (0, 50, 100, 550, 1000, 2000)]
    # Half way down the cosine lies the middle of 100 % and 2 %.
    after = [0.51 * 0.5, 0.01, 0.01] if schedule == "cosine" else [0.5, 0.5, 0.5]
    np.testing.assert_allclose(at, [0.0, 0.25, 0.5, *after], atol=1e-6)


def test_a_run_shorter_than_its_warm_up_still_reaches_the_peak():
    config = TrainConfig(steps=10, learning_rate=2e-3, warmup_steps=300, schedule="constant")
    assert float(learning_rate_schedule(config)(10)) == pytest.approx(2e-3)


@pytest.fixture
def long():
    num = 1000
    return Trajectory(
        obs=jnp.zeros((num, 3)),
        actions=jnp.zeros(num, jnp.int32),
        achieved_goals=jnp.zeros((num, 2)),
        goal_reached=jnp.zeros(num, bool),
        outcomes=jnp.zeros((num, 2)),
        length=jnp.int32(num),
    )


def test_noise_on_observations_has_one_size_a_trajectory(long):
    keys = jax.random.split(jax.random.key(0), 400)
    seen = jax.vmap(lambda key: blurred(key, long, 0.3))(keys)
    noise = np.asarray(seen.obs - long.obs)
    sizes = noise.std(axis=(1, 2))
    assert stats.kstest(sizes, stats.uniform(0, 0.3).cdf).pvalue > 1e-3
    assert stats.kstest((noise / sizes[:, None, None]).ravel()[::50], "norm").pvalue > 1e-3


def test_noise_is_for_training_only(params):
    """Neither held-out losses nor runs without it change."""
    network = GoalTransformer(NETWORK)
    one = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), DATASET.gather(*WHOLE))

    def loss(deterministic, noise):
        return float(bc_loss(params, jax.random.key(1), network, one, deterministic, noise)[0])

    clean = loss(True, 0.0)
    assert loss(True, 0.5) == loss(False, 0.0) == clean
    assert loss(False, 0.5) != clean


@pytest.mark.parametrize("size", [-1.0, float("nan"), float("inf")])
def test_noise_is_finite_and_not_negative(size):
    says = "at least 0" if np.isfinite(size) else "a finite number"
    with pytest.raises(UsageError, match=f"--obs-noise must be {says}, found {size}"):
        Trainer(replace(CONFIG, obs_noise=size), NETWORK, DATASET, device_mesh(1))


@pytest.mark.skipif(jax.device_count() < 2, reason="needs two devices")
def test_devices_must_divide_the_parts():
    with pytest.raises(UsageError, match="part_size 3 does not divide over 2 devices"):
        Trainer(replace(CONFIG, part_size=3), NETWORK, DATASET, device_mesh(2))


@pytest.fixture(scope="module")
def first_update(params):
    """``(gradients, changes of the settings) -> (update, state)`` of an optimizer at a constant rate."""
    flat, unravel = ravel_pytree(params)

    def update(grads, **changes):
        config = replace(CONFIG, warmup_steps=0, schedule="constant", **changes)
        optimizer = make_optimizer(config, unravel)
        return jax.jit(optimizer.update)(grads, optimizer.init(flat), flat)

    return update


def test_gradients_are_clipped(params, first_update):
    """AdamW's first moment is a tenth of the gradient that it is given."""
    flat, _ = ravel_pytree(params)
    grads = jnp.linspace(-1.0, 1.0, len(flat))
    norm = float(jnp.linalg.norm(grads))
    for bound, wanted in ((0.1, 0.1), (2 * norm, norm)):
        _, state = first_update(grads, optimizer="adamw", clip_norm=bound)
        np.testing.assert_allclose(jnp.linalg.norm(state[1][0].mu), 0.1 * wanted, rtol=1e-4)


def test_muon_updates_the_matrices_of_the_blocks_and_adamw_the_rest(params, first_update):
    """AdamW's first update has one size everywhere, whatever the gradient; Muon's is as large in the
    root mean square as those of AdamW are later. Both have Nesterov momentum."""
    flat, unravel = ravel_pytree(params)
    noise = jax.random.normal(jax.random.key(0), flat.shape)
    updates, _ = first_update(noise, optimizer="muon", weight_decay=0.0, learning_rate=0.01)
    momentum = 1 + 0.9 * 0.1 / (1 - 0.9**2)
    num_matrices = 0
    for path, update in jax.tree_util.tree_leaves_with_path(unravel(updates)):
        if "blocks" in jax.tree_util.keystr(path) and update.ndim == 2:
            num_matrices += 1
            size = float(jnp.sqrt(jnp.mean(update**2)))
            assert size == pytest.approx(0.2 * 0.01, rel=0.2), path
        else:
            np.testing.assert_allclose(jnp.abs(update), momentum * 0.01, rtol=1e-3, err_msg=path)
    assert num_matrices >= 4


@pytest.mark.parametrize("name", ["muon", "adamw"])
def test_all_weights_decay(name, params, first_update):
    flat, _ = ravel_pytree(params)
    zero = jnp.zeros_like(flat)
    updates, _ = first_update(zero, optimizer=name, weight_decay=0.5, learning_rate=0.01)
    np.testing.assert_allclose(updates, -0.01 * 0.5 * flat, rtol=1e-3, atol=1e-7)


def test_a_continuous_action_is_hit_where_all_of_its_dimensions_are():
    labels = jnp.array([[0.0, 0.0], [0.0, 0.5], [0.05, -0.05], [0.12, 0.0], [0.0, 0.0]])
    blank = Gaussian(jnp.zeros((5, 2)), jnp.zeros((5, 2)))
    found = stats_of(blank, labels, jnp.array([True, True, True, True, False]))
    assert (found.correct, found.num_steps) == (2, 4)
