"""Many adaptations at once: variants and groups change nothing but speed, evaluations are averages."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mgpo_jax.rollout
from envs.grid_world import GridWorld
from envs.maze_runner import MazeRunner
from envs.noisy import Noisy
from envs.wrapper import Wrapper
from experiments import adaptation
from experiments.adaptation import (
    evaluate_prompts,
    lanes_together,
    lay_out,
    run_adaptation,
    run_variants,
)
from experiments.policies import LoadedPolicy
from experiments.tasks import sample_tasks
from mgpo_jax.checkpoint import network_config
from mgpo_jax.optimizers import ucb
from mgpo_jax.transformer import GoalTransformer
from mgpo_jax.types import Prompt

MAZE = MazeRunner(name="tiny", side=7, horizon=10)
GRID = GridWorld(name="tiny", horizon=10)


@pytest.fixture(scope="module", autouse=True)
def few_segments():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mgpo_jax.rollout, "NUM_SEGMENTS", 1)
        yield


def untrained(env):
    """A policy with weights large enough to act differently under different prompts."""
    spec = env.spec
    config = network_config(
        spec, max_prompt_length=3, embed_dim=8, num_layers=1, num_heads=1, dropout=0.0
    )
    prompt = Prompt(jnp.zeros((3, spec.goal_dim)), jnp.ones(3, bool))
    inputs = (prompt, jnp.zeros((2, spec.obs_dim)), jnp.zeros(2, jnp.int32))
    shapes = jax.eval_shape(GoalTransformer(config).init, jax.random.key(0), *inputs)
    rng = np.random.default_rng(1)
    params = jax.tree.map(
        lambda leaf: jnp.asarray(0.5 * rng.standard_normal(leaf.shape), leaf.dtype), shapes
    )
    return LoadedPolicy(config, params, {})


@pytest.fixture(scope="module")
def maze_run():
    run = partial(run_variants, seeds=2, episodes=6, eval_every=4)
    return partial(run, MAZE, untrained(MAZE), ucb, sample_tasks(MAZE, 5, 3))


VARIANTS = [{"c": 0.0, "max_goals": 1}, {"c": 10.0, "max_goals": 3}]


@pytest.fixture(scope="module")
def sweep(maze_run):
    return maze_run(VARIANTS)


def assert_same(a, b):
    """Equal but for rounding and for what depends on speed."""
    a, b = a._replace(cpu_seconds=0.0), b._replace(cpu_seconds=0.0)
    jax.tree.map(partial(np.testing.assert_allclose, atol=1e-5), a, b)


def test_a_sweep_equals_single_runs(maze_run, sweep):
    for variant, outcome in zip(VARIANTS, sweep, strict=True):
        assert_same(maze_run([variant])[0], outcome)


def test_variants_differ(sweep):
    goals = [outcome.log.prompts.mask.sum(axis=-1).max() for outcome in sweep]
    assert goals[0] == 1
    assert goals[1] > 1


def test_groups_do_not_matter(maze_run, sweep, monkeypatch):
    """Not even when lanes have to be made up to fill the last group."""
    monkeypatch.setattr(adaptation, "lanes_together", lambda env, config: 4)
    for small, outcome in zip(maze_run(VARIANTS), sweep, strict=True):
        assert small.num_episodes >= outcome.num_episodes
        assert_same(small._replace(num_episodes=outcome.num_episodes), outcome)


@dataclass(frozen=True)
class InGroups(Wrapper):
    """A world that is stepped in groups of ``num``."""

    num: int = 1

    @property
    def spec(self):
        return replace(self.env.spec, worlds_together=self.num)


def test_a_world_may_ask_for_company():
    config = untrained(MAZE).config
    alone = lanes_together(MAZE, config)
    assert lanes_together(InGroups(MAZE, 1), config) == alone
    assert lanes_together(InGroups(MAZE, alone + 5), config) == alone + 5
    assert lay_out(InGroups(MAZE, 1000), config, 60).group == 30  # two devices


def test_a_run_is_a_sweep_of_one(sweep):
    outcome = run_adaptation(
        MAZE, untrained(MAZE), partial(ucb, c=10.0), sample_tasks(MAZE, 5, 3),
        seeds=2, episodes=6, max_goals=3, eval_every=4,
    )  # fmt: skip
    assert_same(outcome, sweep[1])


def test_evaluations_stand_beside_the_search(sweep):
    outcome = sweep[1]
    np.testing.assert_array_equal(outcome.eval_episodes, [1, 4, 6])
    assert outcome.eval_returns.shape == (2, 3, 3)
    # In a world without chance the search's own first episode is the first evaluation.
    np.testing.assert_allclose(outcome.log.returns[:, :, 0], outcome.eval_returns[:, :, 0])
    assert outcome.num_episodes == 2 * 3 * (6 + 3)


def test_chance_is_averaged_out():
    """Each evaluation in a world of random starts is the mean of many episodes."""
    run = partial(
        run_adaptation, GRID, untrained(GRID), ucb, sample_tasks(GRID, 5, 2), seeds=2, episodes=2
    )
    many = run()
    assert many.num_episodes == 2 * 2 * (2 + 2 * adaptation.NUM_EVAL_EPISODES)
    assert run(eval_episodes=3).num_episodes == 2 * 2 * (2 + 2 * 3)
    assert np.isfinite(many.eval_returns).all()


def test_prompts_evaluated_again_have_the_same_returns(sweep):
    outcome = sweep[1]
    best = jax.tree.map(lambda leaf: leaf[:, :, -1], outcome.log.best)
    again = partial(evaluate_prompts, network=untrained(MAZE), tasks=sample_tasks(MAZE, 5, 3))
    returns, num_failed = again(MAZE, prompts=best, episodes=2)
    assert num_failed == 0
    np.testing.assert_allclose(returns, outcome.eval_returns[:, :, -1], atol=1e-5)
    # Nothing but noise: every action is random, whatever the prompt.
    blind, _ = again(Noisy(MAZE, action_noise=1.0), prompts=best, episodes=40)
    assert blind.shape == returns.shape
    assert not np.allclose(blind, returns)
    np.testing.assert_allclose(blind[0], blind[1], atol=0.4)
