"""Action distributions against scipy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special, stats

from mgpo_jax.distributions import HEADS, Categorical, Gaussian

LOGITS = np.array([0.3, -1.2, 2.0, 0.0, -0.4], np.float32)
MEAN = np.array([0.2, -0.5], np.float32)
LOG_STD = np.array([-2.0, -0.3], np.float32)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-30, 30, width=32), min_size=5, max_size=5), st.integers(0, 4))
def test_categorical_log_prob(logits, action):
    logits = np.array(logits, np.float32)
    log_prob = Categorical(jnp.asarray(logits)).log_prob(jnp.int32(action))
    expected = special.log_softmax(logits.astype(np.float64))[action]
    np.testing.assert_allclose(log_prob, expected, rtol=1e-4, atol=1e-5)


def test_categorical_gradient_is_one_hot_minus_probabilities():
    grad = jax.grad(lambda logits: Categorical(logits).log_prob(jnp.int32(2)))(jnp.asarray(LOGITS))
    np.testing.assert_allclose(grad, np.eye(5)[2] - special.softmax(LOGITS), atol=1e-6)


def test_categorical_samples_have_its_probabilities():
    keys = jax.random.split(jax.random.key(0), 5000)
    actions = np.asarray(jax.vmap(Categorical(jnp.asarray(LOGITS)).sample)(keys))
    expected = special.softmax(LOGITS.astype(np.float64)) * len(keys)
    assert stats.chisquare(np.bincount(actions, minlength=5), expected).pvalue > 1e-3


def test_categorical_mode():
    assert int(Categorical(jnp.asarray(LOGITS)).mode()) == 2


@settings(max_examples=50, deadline=None)
@given(*[st.lists(st.floats(low, high, width=32), min_size=2, max_size=2)
         for low, high in ((-1, 1), (-5, 1), (-1, 1))])  # fmt: skip
def test_gaussian_log_prob(mean, log_std, action):
    arrays = [np.array(values, np.float32) for values in (mean, log_std, action)]
    log_prob = Gaussian(*map(jnp.asarray, arrays[:2])).log_prob(jnp.asarray(arrays[2]))
    mean, log_std, action = (array.astype(np.float64) for array in arrays)
    expected = stats.norm.logpdf(action, mean, np.exp(log_std)).sum()
    np.testing.assert_allclose(log_prob, expected, rtol=1e-4, atol=1e-4)


def test_gaussian_samples_are_clipped_normal():
    distribution = Gaussian(jnp.asarray(MEAN), jnp.asarray(LOG_STD))
    keys = jax.random.split(jax.random.key(1), 4000)
    samples = np.asarray(jax.vmap(distribution.sample)(keys))
    assert abs(samples).max() <= 1
    for column, mean, std in zip(samples.T, MEAN, np.exp(LOG_STD), strict=True):
        truth = stats.norm(mean, std)
        for edge, mass in ((-1, truth.cdf(-1)), (1, truth.sf(1))):
            hits = int((column == edge).sum())
            assert stats.binomtest(hits, len(column), mass).pvalue > 1e-3
        inside = column[abs(column) < 1]
        low, high = (-1 - mean) / std, (1 - mean) / std
        assert stats.kstest(inside, stats.truncnorm(low, high, mean, std).cdf).pvalue > 1e-3


def test_gaussian_mode_is_its_mean():
    np.testing.assert_array_equal(Gaussian(jnp.asarray(MEAN), jnp.asarray(LOG_STD)).mode(), MEAN)


@pytest.mark.parametrize(("name", "num_params"), [("categorical", 3), ("gaussian", 6)])
def test_heads_turn_their_parameters_into_a_distribution(name, num_params):
    head = HEADS[name]
    assert head.num_params(3) == num_params
    params = jnp.linspace(-1.0, 1.0, num_params)
    distribution = head.make(params)
    action = distribution.mode()
    assert action.shape == (() if name == "categorical" else (3,))
    assert np.isfinite(distribution.log_prob(action))


def test_gaussian_head_bounds_mean_and_spread():
    distribution = HEADS["gaussian"].make(jnp.array([0.7, -40.0, -90.0, 90.0]))
    np.testing.assert_allclose(distribution.mean, np.tanh([0.7, -40.0]), rtol=1e-5)
    np.testing.assert_array_equal(distribution.log_std, [-5.0, 1.0])
    assert np.isfinite(distribution.log_prob(jnp.array([1.0, -1.0])))
