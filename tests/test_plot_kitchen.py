"""The video of the kitchen: what stands above and below its pictures."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from fakes import FakeResults, player

import envs
from envs.base import Episode, Trajectory
from envs.drawing import Shown
from envs.errors import UsageError
from envs.kitchen import NoOpenGLError
from envs.kitchen import pictures as kitchen
from envs.kitchen.env import NONE, Kitchen, KitchenTask
from experiments.figures import figures_of_results
from mgpo_jax.distributions import Gaussian
from mgpo_jax.policy import Policy

BURNER, LIGHT, SLIDE, HINGE, MICROWAVE = np.eye(5, dtype=np.float32)
SLOTS = 3
TASK = KitchenTask(np.array([1, 4, NONE, NONE, NONE], np.int32))
PICTURES = kitchen.kitchen_pictures(Kitchen(name="kitchen", horizon=500))


@pytest.mark.parametrize(
    ("goals", "text"),
    [
        ((LIGHT + MICROWAVE,), "{light, microwave}"),
        ((LIGHT, BURNER, LIGHT + MICROWAVE), "light > burner > {light, microwave}"),
        ((HINGE, SLIDE), "hinge > slide"),
        ((0.25 * HINGE - SLIDE, SLIDE), "(0.0, 0.0, -1.0, 0.2, 0.0) > slide"),
    ],
)
def test_prompts_in_words(goals, text):
    assert kitchen.words(np.stack(goals)) == text


def test_a_panel_names_what_was_completed_until_the_end():
    num, length = 80, 60
    goals = np.zeros((num, 5), np.float32)
    goals[[1, 30, 70]] = MICROWAVE, LIGHT, HINGE
    reached = goals.any(axis=1)
    obs = np.arange((num + 1) * 59, dtype=np.float32).reshape(num + 1, 59)
    trajectory = Trajectory(obs[:num], np.zeros((num, 9)), goals, reached, goals, np.array(length))
    episode = Episode(trajectory, np.zeros(num), np.array(0.5), obs[length])
    panel = kitchen.panel_of(Shown("A prompt, return 0.50", HINGE[None], episode))
    assert panel.title == "A prompt, return 0.50\nhinge"
    assert panel.completed == [(2, "microwave"), (31, "light")]
    np.testing.assert_array_equal(panel.obs, obs[: 31 + kitchen.REST])
    none = trajectory._replace(goal_reached=np.zeros(num, bool))
    panel = kitchen.panel_of(Shown("A prompt", HINGE[None], episode._replace(trajectory=none)))
    assert panel.completed == []
    np.testing.assert_array_equal(panel.obs, obs[: length + 1])  # the last observation, too


def fake_policy() -> Policy:
    """Holds still, whatever the prompt."""
    still = Gaussian(jnp.zeros(9), jnp.zeros(9))
    return Policy(
        prefill=lambda prompt, obs: (still, jnp.zeros(())),
        decode=lambda carry, action, obs: (still, carry),
        grow=lambda carry, num_steps: carry,
        num_slots=SLOTS,
    )


@pytest.fixture
def result():
    return FakeResults(
        tasks=[TASK],
        task_goals=(LIGHT + MICROWAVE)[None],
        found=[{1: np.stack([LIGHT, LIGHT + MICROWAVE])}],
        eval_episodes=np.array([1]),
        eval_returns=np.zeros((1, 1, 1)),
        optimal_returns=np.ones(1),
        num_episodes=1,
        max_goals=SLOTS,
    )


def test_initial_and_optimized_prompt_side_by_side(result, monkeypatch, tmp_path):
    pytest.importorskip("mujoco")
    drawn = {}
    monkeypatch.setattr(kitchen, "kitchen_gif", lambda *args: drawn.update({args[0]: args[1:]}))
    env = envs.make("kitchen")
    play = player(env, fake_policy())
    ((_, save),) = figures_of_results(PICTURES, {"ucb": result}, lambda result: play, [0], 0)
    save(tmp_path / "video.gif")
    ((path, (title, panels)),) = drawn.items()
    assert path == tmp_path / "video.gif"
    assert title == "Task, in an order that is not told: light, microwave"
    assert [panel.title for panel in panels] == [
        "Initial prompt, return 0.00\n{light, microwave}",
        "Optimized prompt, return 0.00\nlight > {light, microwave}",
    ]
    for panel in panels:
        assert isinstance(panel, kitchen.Panel)
        assert panel.obs.shape == (env.spec.horizon + 1, 59)
        assert panel.completed == []


def test_no_opengl_is_a_sentence(monkeypatch, tmp_path):
    def refuse(*args):
        raise NoOpenGLError(AttributeError("no library"))

    monkeypatch.setattr(kitchen, "kitchen_gif", refuse)
    with pytest.raises(UsageError, match="install EGL or OSMesa"):
        PICTURES.video(tmp_path / "video.gif", TASK, [])


def test_one_video_for_each_adaptation(result):
    results = {"first": result, "second": result}
    drawn = figures_of_results(PICTURES, results, lambda result: None, [0], 0)
    assert [name for name, _ in drawn] == ["ucb_episode_task0.gif", "ucb_1_episode_task0.gif"]
