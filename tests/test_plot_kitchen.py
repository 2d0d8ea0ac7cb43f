"""The video of the kitchen: the text above and below its frames."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from fakes import FakeResults, player

import envs
from envs.base import Episode, Trajectory
from envs.drawing import Shown, video
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
        ((LIGHT + MICROWAVE,), "{light,\xa0microwave}"),
        ((LIGHT, BURNER, LIGHT + MICROWAVE), "light > burner > {light,\xa0microwave}"),
        ((HINGE, SLIDE), "hinge > slide"),
        ((0.25 * HINGE - SLIDE, SLIDE), "(0.0, 0.0, -1.0, 0.2, 0.0) > slide"),
    ],
)
def test_prompts_in_words(goals, text):
    assert kitchen.words(np.stack(goals)) == text


def test_a_panel_names_what_was_completed_and_what_of_it_in_order_until_the_end():
    num, length = 80, 60
    goals = np.zeros((num, 5), np.float32)
    goals[[1, 30, 70]] = MICROWAVE, LIGHT, HINGE
    reached = goals.any(axis=1)
    obs = np.arange((num + 1) * 59, dtype=np.float32).reshape(num + 1, 59)
    trajectory = Trajectory(obs[:num], np.zeros((num, 9)), goals, reached, goals, np.array(length))
    rewards = np.where(np.arange(num) == 30, 0.5, 0.0)
    episode = Episode(trajectory, rewards, np.array(0.5), obs[length])
    panel = kitchen.panel_of(Shown("A prompt, return 0.50", HINGE[None], episode))
    assert panel.title == "A prompt, return 0.50\nhinge"
    assert panel.completed == [(2, "microwave"), (31, "light\N{CHECK MARK}")]
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


def result_with(*goals: np.ndarray) -> FakeResults:
    """An adaptation to one task that found these goals."""
    return FakeResults(
        tasks=[TASK],
        task_goals=(LIGHT + MICROWAVE)[None],
        found=[{1: np.stack(goals)}],
        eval_episodes=np.array([1]),
        eval_returns=np.zeros((1, 1, 1)),
        optimal_returns=np.ones(1),
        num_episodes=1,
        max_goals=SLOTS,
    )


SET = "{light,\xa0microwave}"


@pytest.mark.parametrize(
    ("found", "titles"),
    [
        ((LIGHT,), [f"Optimized prompt, return 0.00\nlight > {SET}"]),
        (
            (LIGHT, MICROWAVE),
            [
                f"Optimized prompt, return 0.00\nlight > microwave > {SET}",
                f"The same goals in another order, return 0.00\nmicrowave > light > {SET}",
            ],
        ),
    ],
)
def test_prompts_side_by_side(found, titles, monkeypatch, tmp_path):
    pytest.importorskip("mujoco")
    drawn = {}
    monkeypatch.setattr(kitchen, "kitchen_gif", lambda *args: drawn.update({args[0]: args[1:]}))
    env = replace(envs.make("kitchen"), horizon=20)
    result, play = result_with(*found, LIGHT + MICROWAVE), player(env, fake_policy())
    ((_, save),) = figures_of_results(PICTURES, {"ucb": result}, lambda result: play, [0], 0)
    save(tmp_path / "video.gif")
    ((path, (title, panels)),) = drawn.items()
    assert path == tmp_path / "video.gif"
    order = "Task, in a hidden order: light, microwave"
    assert title == f"{order}  (\N{CHECK MARK} done in order)"
    assert [panel.title for panel in panels] == [f"Initial prompt, return 0.00\n{SET}", *titles]
    for panel in panels:
        assert isinstance(panel, kitchen.Panel)
        assert panel.obs.shape == (env.spec.horizon + 1, 59)
        assert panel.completed == []


@pytest.mark.parametrize("num_panels", [2, 3])
def test_the_longest_texts_of_a_video_hide_nothing(num_panels, monkeypatch, tmp_path):
    """All five subtasks, in the prompt and below the picture."""
    drawn = []

    def keep(path, figure, show, num_times):
        show(num_times - 1)
        drawn.append(figure)

    monkeypatch.setattr(video, "write_gif", keep)
    monkeypatch.setattr(
        kitchen, "kitchen_frames", lambda obs, *size: np.zeros((len(obs), *size, 3), np.uint8)
    )
    num = 480
    goals = np.eye(5, dtype=np.float32)
    achieved = np.zeros((num, 5), np.float32)
    achieved[-5:] = goals
    reached = achieved.any(axis=1)
    trajectory = Trajectory(np.zeros((num, 59)), None, achieved, reached, achieved, np.array(num))
    episode = Episode(trajectory, reached * 0.2, np.array(1.0), np.zeros(59))
    prompt = np.concatenate([goals, goals.sum(axis=0)[None]])
    shown = Shown("The same goals in another order, return 1.00", prompt, episode)
    task = KitchenTask(np.arange(5, dtype=np.int32))
    PICTURES.video(tmp_path / "video.gif", task, [shown] * num_panels)
    (figure,) = drawn
    texts = [*figure.texts, *(text for ax in figure.axes for text in (ax.title, *ax.texts))]
    assert len(texts) == 1 + 2 * num_panels
    assert figure.axes[0].texts[0].get_text().count("\N{CHECK MARK}") == 5
    boxes = [text.get_window_extent() for text in texts]
    for index, box in enumerate(boxes):
        assert figure.bbox.x0 < box.x0 < box.x1 < figure.bbox.x1
        assert figure.bbox.y0 < box.y0 < box.y1 < figure.bbox.y1
        assert not any(box.overlaps(other) for other in boxes[:index])


def test_no_opengl_is_a_sentence(monkeypatch, tmp_path):
    def refuse(*args):
        raise NoOpenGLError(AttributeError("no library"))

    monkeypatch.setattr(kitchen, "kitchen_gif", refuse)
    with pytest.raises(UsageError, match="install EGL or OSMesa"):
        PICTURES.video(tmp_path / "video.gif", TASK, [])


def test_one_video_for_each_adaptation():
    result = result_with(LIGHT, LIGHT + MICROWAVE)
    results = {"first": result, "second": result}
    drawn = figures_of_results(PICTURES, results, lambda result: None, [0], 0)
    assert [name for name, _ in drawn] == ["ucb_episode_task0.gif", "ucb_1_episode_task0.gif"]
