"""Noise on observations and actions, in worlds with discrete and with continuous actions."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import envs
from envs.base import Environment, TimeStep
from envs.errors import UsageError
from envs.specs import ArraySpec, Box, EnvSpec, ObsLayout
from envs.wrappers import Noisy, behind_noise

MAZE = envs.make("maze15")
NUM = 2000


@dataclass(frozen=True)
class Echo(Environment):
    """A world of one step that shows the action it was given."""

    spec = EnvSpec(
        name="echo", obs=ArraySpec((3,)), goal_dim=1, actions=Box(3), horizon=1,
        return_range=(0.0, 1.0),
    )  # fmt: skip

    def reset(self, key, task):
        return jnp.zeros(3), self.show(jnp.zeros(3))

    def step(self, state, action):
        return action, self.show(action)

    def show(self, obs):
        no = jnp.zeros((), bool)
        return TimeStep(
            obs=obs, achieved_goal=jnp.zeros(1), goal_reached=no, outcome=jnp.zeros(1),
            reward=jnp.zeros(()), terminated=no, truncated=no,
        )  # fmt: skip


def steps(env, action):
    """Observations of ``NUM`` resets and of a step after each."""

    def play(key):
        state, first = env.reset(key, None)
        _, after = env.step(state, action)
        return first.obs, after.obs

    return jax.tree.map(np.asarray, jax.vmap(play)(jax.random.split(jax.random.key(0), NUM)))


def test_without_noise_nothing_changes():
    noisy = Noisy(MAZE)
    assert isinstance(noisy, Environment)
    assert not noisy.spec.deterministic
    task = noisy.sample_task(jax.random.key(3))
    (state, a), (inner, b) = (
        noisy.reset(jax.random.key(0), task),
        MAZE.reset(jax.random.key(0), task),
    )
    for action in (0, 3, 1, 1):
        (state, a), (inner, b) = (
            env.step(at, jnp.int32(action)) for env, at in ((noisy, state), (MAZE, inner))
        )
        jax.tree.map(np.testing.assert_array_equal, (state.inner, a), (inner, b))
    assert (noisy.task_goal(task) == MAZE.task_goal(task)).all()
    assert (noisy.fingerprint(task) == MAZE.fingerprint(task)).all()
    assert noisy.optimal_return(task) == MAZE.optimal_return(task)
    assert noisy.engine == MAZE.engine
    key = jax.random.key(4)
    assert (noisy.sample_goal(key) == MAZE.sample_goal(key)).all()
    with pytest.raises(ValueError, match="maze"):
        noisy.check_task(task)


def test_observation_noise():
    first, after = steps(Noisy(Echo(), obs_noise=0.3), jnp.array([0.5, 0.0, -0.9]))
    noise = np.concatenate([first, after - [0.5, 0.0, -0.9]])
    assert stats.kstest(noise.ravel(), stats.norm(0, 0.3).cdf).pvalue > 1e-3
    # Components, resets and steps are independent.
    rows = np.concatenate([first, after], axis=1)
    assert abs(np.corrcoef(rows.T) - np.eye(6)).max() < 0.1


def test_uniform_noise_has_a_width_for_each_component():
    widths = (0.1, 0.0, 2.0)
    first, after = steps(Noisy(Echo(), obs_range=widths), jnp.array([0.5, 0.0, -0.9]))
    noise = np.concatenate([first, after - np.float32([0.5, 0.0, -0.9])])
    for column, width in zip(noise.T, widths, strict=True):
        if width:
            assert stats.kstest(column, stats.uniform(-width, 2 * width).cdf).pvalue > 1e-3
        else:
            assert (column == 0).all()
    rows = np.concatenate([first, after], axis=1)[:, [0, 2, 3, 5]]
    assert abs(np.corrcoef(rows.T) - np.eye(4)).max() < 0.1


def test_uniform_noise_comes_on_top_of_gaussian_noise():
    both, _ = steps(Noisy(Echo(), obs_noise=0.3, obs_range=(1.0,) * 3), jnp.zeros(3))
    gaussian, _ = steps(Noisy(Echo(), obs_noise=0.3), jnp.zeros(3))
    assert stats.kstest((both - gaussian).ravel(), stats.uniform(-1, 2).cdf).pvalue > 1e-3


def test_action_noise_keeps_actions_in_their_range():
    _, after = steps(Noisy(Echo(), action_noise=0.2), jnp.array([0.0, 1.0, -0.5]))
    assert abs(after).max() <= 1
    assert stats.kstest(after[:, 0], stats.norm(0, 0.2).cdf).pvalue > 1e-3
    assert (after[:, 1] == 1).mean() == pytest.approx(0.5, abs=0.05)


def test_noise_on_discrete_actions_replaces_them():
    noisy = Noisy(MAZE, action_noise=0.4)
    keys = jax.random.split(jax.random.key(0), NUM)
    actions = np.asarray(jax.vmap(lambda key: noisy._disturb(key, jnp.int32(2)))(keys))
    expected = NUM * (0.4 / 5 + 0.6 * (np.arange(5) == 2))
    assert stats.chisquare(np.bincount(actions, minlength=5), expected).pvalue > 1e-3


def test_refuses_what_is_no_noise():
    for size in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match=f"finite and not negative, found {size}"):
            Noisy(Echo(), obs_noise=size)
    with pytest.raises(ValueError, match="a probability, found 2"):
        Noisy(MAZE, action_noise=2.0)
    with pytest.raises(ValueError, match=r"not negative, .* uniform within -1.0 to 2.0 on obs"):
        Noisy(Echo(), obs_range=(0.0, -1.0, 2.0))
    with pytest.raises(ValueError, match="of which echo has 3, found 2"):
        Noisy(Echo(), obs_range=(0.1, 0.1))


def test_a_world_behind_no_noise_is_itself():
    assert behind_noise(MAZE) is MAZE
    assert behind_noise(MAZE, 0.1, 0.2) == Noisy(MAZE, 0.1, 0.2)
    with pytest.raises(
        UsageError, match=r"--action-noise: .* a probability, found 2.0; give another"
    ):
        behind_noise(MAZE, 0.0, 2.0)
    # The flag at fault is named, whichever others are given.
    with pytest.raises(UsageError, match="--obs-noise: noise must be finite"):
        behind_noise(MAZE, -1.0, 0.5)


def test_codes_take_no_noise():
    @dataclass(frozen=True)
    class Coded(Echo):
        spec = replace(
            Echo.spec,
            layout=ObsLayout(num_cells=2, code_sizes=(3,), num_counts=1, max_count=4),
        )

    Noisy(Coded(), action_noise=0.1)
    with pytest.raises(
        ValueError,
        match="needs quantities on a continuous scale, but those of echo are codes and counts",
    ):
        Noisy(Coded(), obs_noise=0.1)
    # No size is possible, so that another one is not asked for.
    with pytest.raises(UsageError, match=r"--obs-noise: .* are codes and counts; leave it out$"):
        behind_noise(Coded(), 0.1)


def test_whole_numbers_take_no_noise():
    """Observations of integers (pixels, codes) stay as they are, and noise on them is refused."""

    @dataclass(frozen=True)
    class Pixels(Echo):
        spec = replace(Echo.spec, obs=ArraySpec((3,), "uint8"))

        def show(self, obs):
            return super().show(obs)._replace(obs=jnp.array([1, 2, 255], jnp.uint8))

    _, after = steps(Noisy(Pixels(), action_noise=0.1), jnp.zeros(3))
    assert after.dtype == np.uint8
    assert (after == [1, 2, 255]).all()
    message = r"those of echo are uint8\[3\]"
    for noise in ({"obs_noise": 0.1}, {"obs_range": (0.0, 0.0, 0.1)}):
        with pytest.raises(ValueError, match=message):
            Noisy(Pixels(), **noise)
