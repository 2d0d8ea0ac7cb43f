"""Action distributions against scipy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special, stats

from envs.errors import NotAvailableError
from mgpo_jax.distributions import HEADS, Binned, Categorical, Gaussian, Mixture

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


def test_clipped_samples_have_the_likelihood_of_all_values_beyond_the_bound():
    distribution = Gaussian(jnp.asarray(MEAN), jnp.asarray(LOG_STD))
    truth = stats.norm(MEAN.astype(np.float64), np.exp(LOG_STD.astype(np.float64)))
    for action, expected in (
        ([0.3, -0.1], truth.logpdf([0.3, -0.1]).sum()),
        ([1.0, -0.1], truth.logsf(1)[0] + truth.logpdf(-0.1)[1]),
        ([0.3, -1.0], truth.logpdf(0.3)[0] + truth.logcdf(-1)[1]),
    ):
        found = distribution.log_prob_of_sample(jnp.array(action))
        np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize("head", ["categorical", "binned", "gaussian", "fixed_gaussian"])
def test_the_mean_of_the_score_is_zero(head):
    """So a policy gradient goes nowhere if all returns are the same, even if most samples are clipped."""
    num, num_samples = HEADS[head].num_params(2), 20_000
    params = 1.5 + 0.2 * jax.random.normal(jax.random.key(3), (num,))

    @jax.jit
    @jax.vmap
    def score(key):
        action = HEADS[head].make(params).sample(key)
        return jax.grad(lambda p: HEADS[head].make(p).log_prob_of_sample(action))(params)

    scores = np.asarray(score(jax.random.split(jax.random.key(4), num_samples)))
    errors = scores.std(axis=0) / num_samples**0.5
    assert (abs(scores.mean(axis=0)) <= 4 * errors).all()


def test_gaussian_mode_is_its_mean():
    np.testing.assert_array_equal(Gaussian(jnp.asarray(MEAN), jnp.asarray(LOG_STD)).mode(), MEAN)


def test_gaussian_mode_is_an_action():
    distribution = Gaussian(jnp.array([0.4, -1.3, 7.0]), jnp.zeros(3))
    np.testing.assert_allclose(distribution.mode(), [0.4, -1.0, 1.0])


WEIGHTS = np.array([0.2, 0.5, 0.3])
MEANS = np.array([[0.0, 0.8], [-0.6, 0.1], [0.5, -0.4]])
LOG_STDS = np.array([[-1.0, -2.0], [-0.5, -3.0], [-2.5, -0.2]])


def a_mixture():
    return Mixture(*(jnp.asarray(x, jnp.float32) for x in (np.log(WEIGHTS) + 3, MEANS, LOG_STDS)))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1, 1, width=32), min_size=2, max_size=2))
def test_mixture_log_prob(action):
    action = np.array(action)
    densities = stats.norm.pdf(action, MEANS, np.exp(LOG_STDS)).prod(axis=1)
    log_prob = a_mixture().log_prob(jnp.asarray(action, jnp.float32))
    np.testing.assert_allclose(log_prob, np.log(WEIGHTS @ densities), rtol=1e-4, atol=1e-4)


def test_mixture_samples_have_its_distribution():
    keys = jax.random.split(jax.random.key(2), 4000)
    samples = np.asarray(jax.vmap(a_mixture().sample)(keys))
    for dimension in range(2):
        column = samples[:, dimension]
        inside = column[abs(column) < 1]
        parts = stats.norm(MEANS[:, dimension], np.exp(LOG_STDS[:, dimension]))
        low, high = (WEIGHTS @ parts.cdf(np.full(3, edge)) for edge in (-1, 1))

        def cdf(x, parts=parts, low=low, high=high):
            return (WEIGHTS @ parts.cdf(np.asarray(x)[None, :].repeat(3, 0).T).T - low) / (
                high - low
            )

        assert stats.kstest(inside, cdf).pvalue > 1e-3


def test_mixture_mode_is_the_mean_of_the_likeliest_component():
    np.testing.assert_allclose(a_mixture().mode(), MEANS[1], rtol=1e-6)
    two = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf[::-1]]), a_mixture())
    np.testing.assert_allclose(two.mode(), [MEANS[1], MEANS[1]], rtol=1e-6)


def test_binned_by_hand():
    # Five values -1, -0.5, 0, 0.5, 1; density of a value: its probability over 0.5.
    masses = np.array([[0.1, 0.6, 0.2, 0.05, 0.05], [0.0625, 0.0625, 0.0625, 0.1875, 0.625]])
    distribution = Binned(jnp.log(jnp.asarray(masses, jnp.float32)) - 1.0)
    expected = np.log(0.6 / 0.5) + np.log(0.625 / 0.5)
    log_prob = distribution.log_prob(jnp.array([-0.7, 1.0]))
    np.testing.assert_allclose(log_prob, expected, rtol=1e-5)
    np.testing.assert_allclose(
        distribution.mode(), [(-0.1 - 0.3) / 0.9, (0.1875 * 0.5 + 0.625) / 0.8125], rtol=1e-5
    )


def test_binned_integrates_to_one_but_for_half_an_interval_at_each_end():
    distribution = Binned(jax.random.normal(jax.random.key(0), (1, 41)))
    grid = np.linspace(-1.025, 1.025, 41 * 50 + 1)[:-1] + 0.0005
    density = np.exp(jax.vmap(distribution.log_prob)(jnp.asarray(grid, jnp.float32)[:, None]))
    assert density.mean() * 2.05 == pytest.approx(1.0, abs=1e-3)


def test_binned_counts_actions_beyond_the_ends_as_the_ends():
    distribution = Binned(jax.random.normal(jax.random.key(0), (1, 41)))
    for beyond, end in ((1.3, 1.0), (-7.0, -1.0)):
        found, expected = (distribution.log_prob(jnp.array([value])) for value in (beyond, end))
        assert found == expected


def test_binned_samples_have_its_probabilities():
    logits = jnp.array([[0.3, -1.2, 2.0, 0.0, -0.4]])
    keys = jax.random.split(jax.random.key(3), 5000)
    samples = np.asarray(jax.vmap(Binned(logits).sample)(keys))[:, 0]
    assert abs(samples).max() <= 1
    counts = np.bincount(np.round(2 * (samples + 1)).astype(int), minlength=5)
    expected = special.softmax(np.asarray(logits[0], np.float64)) * len(keys)
    assert stats.chisquare(counts, expected).pvalue > 1e-3
    inside = samples[np.abs(samples) < 0.25]
    assert stats.kstest(inside, stats.uniform(-0.25, 0.5).cdf).pvalue > 1e-3


@pytest.mark.parametrize(
    ("name", "num_params"),
    [("categorical", 3), ("gaussian", 6), ("fixed_gaussian", 3), ("mixture", 35), ("binned", 123)],
)
def test_heads_turn_their_parameters_into_a_distribution(name, num_params):
    head = HEADS[name]
    assert head.num_params(3) == num_params
    for shape in ((num_params,), (4, num_params)):
        distribution = head.make(jnp.linspace(-1.0, 1.0, np.prod(shape)).reshape(shape))
        actions = distribution.mode(), distribution.sample(jax.random.key(0))
        for action in actions:
            assert action.shape == shape[:-1] + (() if name == "categorical" else (3,))
            assert distribution.log_prob(action).shape == shape[:-1]
            assert np.isfinite(distribution.log_prob(action)).all()


def test_gaussian_heads_bound_their_spread():
    make = HEADS["gaussian"].make
    distribution = make(jnp.array([0.7, -40.0, -90.0, 90.0]))
    np.testing.assert_allclose(distribution.log_std, [-3.0, 1.0])
    assert np.isfinite(distribution.log_prob(jnp.array([1.0, -1.0])))
    # Near the bound there is still a way back.
    slope = jax.grad(lambda params: make(params).log_std.sum())(jnp.array([0.0, 0.0, -5.0, 0.0]))
    assert (slope[2:] > 0.1).all()
    fixed = HEADS["fixed_gaussian"].make(jnp.array([0.7, -40.0]))
    np.testing.assert_allclose(fixed.mean, np.tanh([0.7, -40.0]), rtol=1e-5)
    np.testing.assert_array_equal(fixed.log_std, [-1.0, -1.0])


def test_a_mixture_explores_by_its_components():
    """Means of the components, as often as they are likely; other heads sample."""
    mixture = a_mixture()
    keys = jax.random.split(jax.random.key(0), 4000)
    actions = np.asarray(jax.vmap(mixture.explore)(keys))
    which = np.abs(actions[:, None] - np.clip(MEANS, -1, 1)).max(axis=-1)
    assert (which.min(axis=1) < 1e-6).all()
    shares = np.bincount(which.argmin(axis=1), minlength=len(WEIGHTS)) / len(keys)
    np.testing.assert_allclose(shares, WEIGHTS, atol=0.03)
    gaussian = Gaussian(jnp.asarray(MEAN), jnp.asarray(LOG_STD))
    np.testing.assert_array_equal(gaussian.explore(keys[0]), gaussian.sample(keys[0]))


TEMPERATURES = [0.25, 0.7, 1.0, 3.0]


def normalized(log_density, cells):
    """Densities of log densities on a grid of cells of that size, to the power of 1 / temperature."""
    density = np.exp(log_density - log_density.max())
    return density / (density.sum() * cells)


@pytest.mark.parametrize("temperature", TEMPERATURES)
def test_tempered_categorical_against_brute_force(temperature):
    tempered = Categorical(jnp.asarray(LOGITS)).tempered(jnp.float32(temperature))
    expected = special.softmax(LOGITS.astype(np.float64)) ** (1 / temperature)
    found = np.exp(jax.vmap(tempered.log_prob)(jnp.arange(5)))
    np.testing.assert_allclose(found, expected / expected.sum(), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("temperature", TEMPERATURES)
def test_tempered_gaussian_against_brute_force(temperature):
    """Two dimensions on a grid, far beyond the actions: densities know no bounds."""
    distribution = Gaussian(jnp.asarray(MEAN), jnp.asarray(LOG_STD))
    line, step = np.linspace(-12, 12, 1601, retstep=True)
    grid = jnp.asarray(np.stack(np.meshgrid(line, line[::8]), axis=-1).reshape(-1, 2), jnp.float32)
    log_density = np.asarray(distribution.log_prob(grid), np.float64)
    expected = normalized(log_density / temperature, step * 8 * step)
    found = np.exp(distribution.tempered(jnp.float32(temperature)).log_prob(grid))
    np.testing.assert_allclose(found, expected, atol=2e-3 * expected.max())


@pytest.mark.parametrize("temperature", TEMPERATURES)
def test_tempered_binned_against_brute_force(temperature):
    """One dimension after the other; a value is as wide as all others, the first and the last included."""
    distribution = Binned(2 * jax.random.normal(jax.random.key(0), (2, 11)))
    line, step = np.linspace(-1.1, 1.1, 2200, endpoint=False, retstep=True)
    line = line + step / 2
    tempered = distribution.tempered(jnp.float32(temperature))
    points = jnp.asarray(line, jnp.float32)[:, None]
    for dimension in range(2):

        def of_one(binned, row=dimension):
            return np.asarray(Binned(binned.logits[row : row + 1]).log_prob(points), np.float64)

        expected = normalized(of_one(distribution) / temperature, step)
        np.testing.assert_allclose(np.exp(of_one(tempered)), expected, rtol=2e-3)


@pytest.mark.parametrize("temperature", TEMPERATURES)
def test_tempered_mixture_against_brute_force(temperature):
    """Where its components do not overlap."""
    log_stds = jnp.log(jnp.array([[0.05], [0.1], [0.02]]))
    distribution = Mixture(jnp.log(WEIGHTS) + 3, jnp.array([[-3.0], [0.0], [3.0]]), log_stds)
    line, step = np.linspace(-5, 5, 20_001, retstep=True)
    grid = jnp.asarray(line, jnp.float32)[:, None]
    log_density = np.asarray(jax.vmap(distribution.log_prob)(grid), np.float64)
    expected = normalized(log_density / temperature, step)
    tempered = distribution.tempered(jnp.float32(temperature))
    found = np.exp(jax.vmap(tempered.log_prob)(grid))
    np.testing.assert_allclose(found, expected, atol=2e-2 * expected.max())


@pytest.mark.parametrize("name", HEADS)
def test_temperature_1_is_the_distribution_itself(name):
    params = jnp.linspace(-1.0, 1.0, HEADS[name].num_params(2))
    distribution = HEADS[name].make(params)
    tempered = distribution.tempered(jnp.float32(1.0))
    assert type(tempered) is type(distribution)
    jax.tree.map(np.testing.assert_array_equal, tempered, distribution)


@pytest.mark.parametrize("name", HEADS)
def test_temperature_0_in_the_limit_is_the_mode(name):
    """For the binned head: the likeliest value, without its neighbors."""
    params = jax.random.normal(jax.random.key(1), (HEADS[name].num_params(2),))
    cold = HEADS[name].make(params).tempered(jnp.float32(1e-8))
    keys = jax.random.split(jax.random.key(0), 20)
    actions = np.asarray(jax.vmap(cold.explore)(keys))
    width = 0.5 / 20 if name == "binned" else 1e-3
    if name == "mixture":  # the weights of components of different spread are no guide to the mode
        assert np.ptp(actions, axis=0).max() < width
    else:
        expected = np.asarray(HEADS[name].make(params).mode())
        if name == "binned":
            expected = np.linspace(-1, 1, 41)[np.asarray(cold.logits).argmax(axis=-1)]
        np.testing.assert_allclose(actions, np.broadcast_to(expected, actions.shape), atol=width)


def test_entropies_against_scipy():
    """Two distributions at once; of the binned one, those of its two histograms together."""
    logits = np.stack([LOGITS, 3 * LOGITS[::-1]])
    found = Categorical(jnp.asarray(logits)).entropy()
    np.testing.assert_allclose(
        found, stats.entropy(special.softmax(logits, axis=1), axis=1), rtol=1e-5
    )
    log_stds = np.stack([LOG_STD, LOG_STD - 3])
    found = Gaussian(jnp.zeros((2, 2)), jnp.asarray(log_stds)).entropy()
    expected = stats.norm.entropy(scale=np.exp(log_stds)).sum(axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    edges = np.linspace(-1.25, 1.25, 6)  # five values half a unit apart
    histograms = [
        stats.rv_histogram((special.softmax(row), edges), density=False) for row in logits
    ]
    expected = sum(float(histogram.entropy()) for histogram in histograms)
    np.testing.assert_allclose(Binned(jnp.asarray(logits)).entropy(), expected, rtol=1e-4)


def test_sure_choices_have_no_entropy():
    sure = Categorical(jnp.array([0.0, 1e4, -1e4]))
    assert float(sure.entropy()) == 0.0


def test_a_mixture_says_that_it_has_no_closed_form():
    with pytest.raises(NotAvailableError, match="the entropy of a mixture has no closed form"):
        a_mixture().entropy()
