"""The kitchen against gymnasium's FrankaKitchen: the same subtasks are completed in both.

The two worlds are compared with each other, not with recorded numbers.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import require_kitchen

require_kitchen()
import envs  # noqa: E402
from envs.episodes import run_episode  # noqa: E402
from envs.kitchen import official  # noqa: E402
from envs.kitchen.demonstrators import scripted_arm  # noqa: E402
from envs.kitchen.env import NONE, SUBTASKS, Kitchen, KitchenTask  # noqa: E402
from envs.kitchen.fidelity import completions  # noqa: E402
from envs.kitchen.official import (  # noqa: E402
    OBS_NOISE,
    franka_kitchen,
    goal_name,
    kitchen_official,
    num_in_turn,
)
from envs.official import Own, Played, play  # noqa: E402
from experiments.store.result_files import load_results  # noqa: E402
from mgpo_jax.acting import Actor  # noqa: E402
from mgpo_jax.policy_files import load_policy  # noqa: E402

RESULTS = Path(__file__).parent.parent / "results"
HORIZON = 120
STOCK = Kitchen(name="kitchen-stock", horizon=HORIZON, backend="native", model="stock")
BURNER, LIGHT, SLIDE, HINGE, MICROWAVE = range(5)


def task_of(order) -> KitchenTask:
    return KitchenTask(jnp.array([*order, *[NONE] * (5 - len(order))], jnp.int32))


class Recorded:
    """Acts as somebody did, and does nothing after that."""

    def __init__(self, actions):
        self.actions = actions

    def reset(self, obs):
        self.time = -1
        return self.act(obs)

    def act(self, obs):
        self.time += 1
        return self.actions[self.time] if self.time < len(self.actions) else np.zeros(9, np.float32)


def in_both(who, order) -> tuple[Played, Played]:
    """What comes of it here, and in FrankaKitchen."""
    theirs = kitchen_official(STOCK)
    own = play(who, Own(STOCK, task_of(order), theirs.goal_name))
    return own, play(who, theirs.episode(task_of(order)))


@cache
def demonstration(order):
    """One episode of the scripted arm in the full scene."""
    agent = scripted_arm(STOCK)
    run = jax.jit(lambda key, task: run_episode(key, STOCK, agent, task))
    return jax.tree.map(np.asarray, run(jax.random.key(0), task_of(order)))


class TestTheSameIsReached:
    def test_by_the_actions_of_a_demonstration(self):
        """The same actions without looking, so that nothing corrects a difference of the two."""
        episode = demonstration((LIGHT,))
        length = int(episode.trajectory.length)
        own, theirs = in_both(Recorded(episode.trajectory.actions[:length]), (LIGHT,))
        assert own.reached == theirs.reached == ("light switch",)
        assert own.return_ == theirs.return_ == 1.0
        assert own.steps == theirs.steps
        # Stepped by hand, the world here is what it is in a program.
        batch = jax.tree.map(lambda leaf: leaf[None], episode)
        assert own.reached == tuple(SUBTASKS[index] for index in completions(batch)[0])
        assert (own.length, own.return_) == (length, episode.return_)

    def test_by_the_released_policy(self):
        goals = np.eye(5, dtype=np.float32)[[MICROWAVE, LIGHT]]
        prompt = np.concatenate([goals, goals.sum(axis=0, keepdims=True)])
        actor = Actor(load_policy(envs.find("kitchen")), prompt)
        own, theirs = in_both(actor, (MICROWAVE, LIGHT))
        assert "microwave" in own.reached
        assert own.return_ == pytest.approx(theirs.return_)
        assert own._replace(return_=0.0) == theirs._replace(return_=0.0)

    @pytest.mark.parametrize(
        ("seed", "task", "order"), [(0, 24, (MICROWAVE, LIGHT)), (2, 7, (LIGHT, HINGE))]
    )
    def test_by_the_released_policy_under_an_adapted_prompt(self, seed, task, order):
        """Prompts that UCB found for two test tasks, which solve them in both worlds at the same steps."""
        results = load_results(RESULTS / "kitchen-stock" / "ucb")
        names = " and ".join(sorted(SUBTASKS[index] for index in order))
        told = goal_name(results.task_goals[task])
        assert sorted(told.split(" and ")) == sorted(names.split(" and "))
        actor = Actor(load_policy(envs.find("kitchen")), results.best_goals(seed, task))
        own, theirs = in_both(actor, order)
        assert own.reached == theirs.reached == tuple(SUBTASKS[index] for index in order)
        assert own.steps == theirs.steps
        assert own.return_ == theirs.return_ == 1.0

    @pytest.mark.optimized
    def test_to_the_last_bit(self):
        """What is observed of a demonstration, contact included, is the same float32 numbers."""
        trajectory = demonstration((LIGHT,)).trajectory
        theirs = franka_kitchen(HORIZON)
        theirs.reset(seed=0)
        for step in range(int(trajectory.length) - 1):
            observed, *_ = theirs.step(trajectory.actions[step].astype(np.float64))
            seen = observed["observation"].astype(np.float32)
            np.testing.assert_array_equal(trajectory.obs[step + 1], seen)


@pytest.mark.parametrize(
    ("completed", "num"),
    [
        ([], 0),
        (["microwave"], 1),
        (["microwave", "light switch"], 2),
        (["light switch", "microwave"], 0),
        (["microwave", "slide cabinet", "light switch"], 2),  # the slide cabinet is not asked for
        (["microwave", "hinge cabinet", "light switch"], 1),
        (["hinge cabinet", "microwave", "light switch"], 0),
        (["microwave", "light switch", "hinge cabinet"], 3),
    ],
)
def test_the_rule_of_the_task(completed, num):
    assert num_in_turn(completed, ["microwave", "light switch", "hinge cabinet"]) == num


class Scripted:
    """In place of FrankaKitchen: says what is complete, step by step."""

    def __init__(self, *completed, truncated_at=10):
        self.completed, self.truncated_at, self.time = completed, truncated_at, 0

    def reset(self, seed):
        return {"observation": np.zeros(59)}, {}

    def step(self, action):
        assert action.dtype == np.float64
        self.time += 1
        so_far = [name for step in self.completed[: self.time] for name in step]
        observed = {"observation": np.full(59, self.time)}
        return (
            observed,
            0.0,
            False,
            self.time >= self.truncated_at,
            {"episode_task_completions": so_far},
        )


class TestEpisodes:
    def play(self, monkeypatch, order, *completed) -> Played:
        monkeypatch.setattr(official, "franka_kitchen", lambda horizon: Scripted(*completed))
        return play(Recorded([]), official.FrankaEpisode(task_of(order), horizon=10))

    def test_it_ends_when_the_task_is_solved(self, monkeypatch):
        found = self.play(monkeypatch, (LIGHT, HINGE), [], ["light switch"], [], ["hinge cabinet"])
        assert found == Played(("light switch", "hinge cabinet"), (2, 4), 1.0, 4)

    def test_it_ends_at_the_horizon(self, monkeypatch):
        found = self.play(monkeypatch, (LIGHT, HINGE), ["hinge cabinet"], ["light switch"])
        assert found == Played(("hinge cabinet", "light switch"), (1, 2), 0.0, 10)

    def test_the_next_one_of_the_task_comes_first(self, monkeypatch):
        """Of several that arrive in one step, in whatever order FrankaKitchen lists them."""
        for both in (["light switch", "microwave"], ["microwave", "light switch"]):
            found = self.play(monkeypatch, (MICROWAVE, LIGHT), [], both)
            assert found == Played(("microwave", "light switch"), (2, 2), 1.0, 2)
            found = self.play(monkeypatch, (HINGE, MICROWAVE), [], both)
            assert found.reached == ("light switch", "microwave")


def test_goals_in_words():
    assert goal_name(np.eye(5)[HINGE]) == "hinge cabinet"
    assert goal_name(np.array([1, 0, 0, 0, 1])) == "bottom burner and microwave"
    assert goal_name(np.array([0.5, 0, 0, -1, 1])) == "0.50 0.00 0.00 -1.00 1.00"
    assert (
        kitchen_official(STOCK).task_name(task_of((HINGE, LIGHT))) == "hinge cabinet, light switch"
    )


def noise_of(world, num: int = 2000) -> np.ndarray:
    """``[num, 59]`` draws of the noise on its observations."""
    data, robot = world.data, world.robot_env
    exact = np.concatenate([data.qpos[:9], data.qvel[:9], data.qpos[9:], data.qvel[9:]])
    return np.array([world._get_obs(robot._get_obs())["observation"] for _ in range(num)]) - exact


def test_its_own_noise():
    """What FrankaKitchen adds when nothing is said of noise, against what is written down here."""
    made = franka_kitchen(HORIZON)
    given = {name: made.spec.kwargs[name] for name in ("robot_noise_ratio", "object_noise_ratio")}
    assert given == {"robot_noise_ratio": 0.0, "object_noise_ratio": 0.0}
    made.reset(seed=0)
    assert abs(noise_of(made.unwrapped, 3)).max() == 0
    default = type(made.unwrapped)(list(SUBTASKS))
    default.reset(seed=0)
    drawn = noise_of(default)
    np.testing.assert_array_less(abs(drawn).max(axis=0), OBS_NOISE * (1 + 1e-6))
    np.testing.assert_allclose(abs(drawn).max(axis=0), OBS_NOISE, rtol=0.02)
    np.testing.assert_allclose(drawn.std(axis=0), OBS_NOISE / np.sqrt(3), rtol=0.1)


def test_the_mended_package_reads_the_robot():
    """What stands in place of ``robot_get_obs`` returns what that would."""
    world = franka_kitchen(HORIZON).unwrapped
    rng = np.random.default_rng(0)
    qpos, qvel = rng.normal(size=30), rng.normal(size=29)
    world.robot_env.set_state(qpos, qvel)
    np.testing.assert_array_equal(world.robot_env._get_obs(), [*qpos[:9], *qvel[:9]])
