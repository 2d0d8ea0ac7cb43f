"""Worlds as gymnasium environments: gymnasium's own checker, and comparison with the worlds."""

from __future__ import annotations

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import envs
import envs.to_gymnasium
from envs.errors import UsageError
from envs.to_gymnasium import WorldEnv

gymnasium.register_envs(envs.to_gymnasium)


def installed(name: str) -> bool:
    try:
        return envs.make(name) is not None
    except UsageError:
        return False


NAMES = [
    pytest.param(name, marks=() if name in ("maze15", "gridworld") else pytest.mark.slow)
    for name in envs.names()
    if installed(name)
]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.filterwarnings("ignore:.*(infinity|precision).*")
def test_gymnasium_finds_no_fault(name: str) -> None:
    env = gymnasium.make(f"mgpo_jax/{name}-v0")
    assert env.spec is not None
    assert env.unwrapped.world == envs.make(name)
    check_env(env.unwrapped, skip_render_check=True)


def test_an_episode_is_that_of_the_world() -> None:
    env, world = WorldEnv("gridworld"), envs.make("gridworld")
    task = world.task(jnp.int32(5))
    obs, info = env.reset(seed=3, options={"task": task})
    np.testing.assert_array_equal(obs["desired_goal"], world.task_goal(task))
    assert not info["goal_reached"]
    state, step = env._state, jax.jit(world.step)
    for action in (0, 1, 2, 3, 5):
        state, told = step(state, action)
        obs, reward, terminated, truncated, info = env.step(action)
        np.testing.assert_array_equal(obs["observation"], told.obs)
        np.testing.assert_array_equal(obs["achieved_goal"], told.achieved_goal)
        np.testing.assert_array_equal(info["outcome"], told.outcome)
        assert (reward, terminated, truncated) == (told.reward, told.terminated, told.truncated)


def test_tasks_are_drawn_kept_and_given() -> None:
    env = WorldEnv("maze15")
    first, _ = env.reset(seed=1)
    task = env.task
    again, _ = env.reset(seed=1)
    other, _ = env.reset()
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert not np.array_equal(first["desired_goal"], other["desired_goal"])
    kept, _ = env.reset(options={"task": task})
    np.testing.assert_array_equal(kept["desired_goal"], first["desired_goal"])
    same, _ = env.reset(options={"same_task": True})
    np.testing.assert_array_equal(same["desired_goal"], first["desired_goal"])


def test_wrong_options_are_refused() -> None:
    env = WorldEnv(envs.find("maze15"))
    with pytest.raises(UsageError, match="task and same_task, found tsk"):
        env.reset(options={"tsk": 1})
    with pytest.raises(UsageError, match="no last task yet"):
        env.reset(options={"same_task": True})


def test_it_goes_there_and_back_again() -> None:
    """A world as a gymnasium environment as a world."""
    from envs.gymnasium_world import GymnasiumWorld

    described = GymnasiumWorld(
        name="gridworld-again", make=lambda: gymnasium.make("mgpo_jax/gridworld-v0"),
        return_range=(0.0, 1.0), horizon=90, reward_confirms_goals=True,
        reached=lambda moment: moment.info["goal_reached"],
        outcome=lambda moment: moment.info["outcome"],
    )  # fmt: skip
    env = described.environment()
    spec, own = env.spec, envs.make("gridworld").spec
    assert (spec.obs, spec.goal_dim, spec.actions) == (own.obs, own.goal_dim, own.actions)
    task = env.sample_task(jax.random.key(0))
    state, told = env.reset(jax.random.key(0), task)
    for action in (0, 1, 5):
        state, told = env.step(state, jnp.int32(action))
    world = gymnasium.make("mgpo_jax/gridworld-v0")
    world.reset(seed=int(task.seed))
    for action in (0, 1, 5):
        obs, *_ = world.step(action)
    np.testing.assert_array_equal(told.obs, obs["observation"])
