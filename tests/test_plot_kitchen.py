"""The video of the kitchen: what stands above and below its pictures."""

from __future__ import annotations

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.kitchen import NONE, NoOpenGLError
from envs.render import Panel
from experiments import figures
from experiments.figures import kitchen
from mgpo_jax.distributions import Gaussian
from mgpo_jax.errors import UsageError
from mgpo_jax.policy import Policy
from mgpo_jax.types import Episode, Prompt, Trajectory

BURNER, LIGHT, SLIDE, HINGE, MICROWAVE = np.eye(5, dtype=np.float32)
SLOTS = 3
TASK = np.array([[1, 4, NONE, NONE, NONE]], np.int32)


def prompt_of(*goals: np.ndarray) -> Prompt:
    rows = np.zeros((SLOTS, 5), np.float32)
    rows[SLOTS - len(goals) :] = goals
    return Prompt(jnp.asarray(rows), jnp.arange(SLOTS) >= SLOTS - len(goals))


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
    assert kitchen.words(prompt_of(*goals)) == text


def test_a_panel_names_what_was_completed_until_the_end():
    num, length = 80, 60
    goals = np.zeros((num, 5), np.float32)
    goals[[1, 30, 70]] = MICROWAVE, LIGHT, HINGE
    reached = goals.any(axis=1)
    obs = np.arange(num * 59, dtype=np.float32).reshape(num, 59)
    trajectory = Trajectory(obs, np.zeros((num, 9)), goals, reached, goals, np.array(length))
    episode = Episode(trajectory, np.zeros(num), np.array(0.5))
    panel = kitchen.panel("A prompt", prompt_of(HINGE), episode)
    assert panel.title == "A prompt, return 0.50\nhinge"
    assert panel.completed == [(2, "microwave"), (31, "light")]
    np.testing.assert_array_equal(panel.obs, obs[: 30 + kitchen.REST])
    none = trajectory._replace(goal_reached=np.zeros(num, bool))
    panel = kitchen.panel("A prompt", prompt_of(HINGE), episode._replace(trajectory=none))
    assert panel.completed == []
    np.testing.assert_array_equal(panel.obs, obs[:length])


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
    best = prompt_of(LIGHT, LIGHT + MICROWAVE)
    return SimpleNamespace(
        tasks={"order": TASK},
        best_prompt=lambda seed, index: best,
        config={"bandit": "ucb"},
    )


def test_initial_and_optimized_prompt_side_by_side(result, monkeypatch, tmp_path):
    pytest.importorskip("mujoco")
    drawn = {}
    monkeypatch.setattr(kitchen, "kitchen_gif", lambda *args: drawn.update({args[0]: args[1:]}))
    env = envs.make("kitchen")
    kitchen.before_and_after(env, fake_policy(), result, 0, 0, tmp_path / "video.gif")
    ((path, (title, panels)),) = drawn.items()
    assert path == tmp_path / "video.gif"
    assert title == "Task, in an order that is not told: light, microwave"
    assert [panel.title for panel in panels] == [
        "Initial prompt, return 0.00\n{light, microwave}",
        "Optimized prompt, return 0.00\nlight > {light, microwave}",
    ]
    for panel in panels:
        assert isinstance(panel, Panel)
        assert panel.obs.shape == (env.spec.horizon, 59)
        assert panel.completed == []


def test_no_opengl_is_a_sentence(result, monkeypatch, tmp_path):
    pytest.importorskip("mujoco")

    def refuse(*args):
        raise NoOpenGLError(AttributeError("no library"))

    monkeypatch.setattr(kitchen, "kitchen_gif", refuse)
    with pytest.raises(UsageError, match="install EGL or OSMesa"):
        kitchen.before_and_after(
            envs.make("kitchen"), fake_policy(), result, 0, 0, tmp_path / "video.gif"
        )


def test_one_video_for_each_adaptation(result):
    results = {"first": result, "second": result}
    pictures = figures.pictures(envs.make("kitchen"))
    names = [
        name for name, _ in pictures.draw_all(results, lambda result: fake_policy(), [0, 1], 0)
    ]
    assert names == ["ucb_episode_task0.gif", "ucb_1_episode_task0.gif"]
