"""Kitchens with a randomized scene and physics: what is drawn, and that nothing else changes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import require_kitchen

import envs
from envs.kitchen.env import Kitchen
from experiments import demonstrations
from experiments.datasets import collect
from mgpo_jax.lanes import together
from mgpo_jax.tasks import benchmark_tasks, evaluation_tasks, task_hashes

require_kitchen()
from envs.kitchen import varied  # noqa: E402
from envs.kitchen.model import load_model  # noqa: E402
from envs.kitchen.physics import MODELS  # noqa: E402
from envs.kitchen.varied import Variation, VariedKitchen, VariedTask  # noqa: E402

HORIZON, STEPS = 40, 20
PLACE = VariedKitchen(name="kitchen", horizon=HORIZON)
SCENES = {
    name: Kitchen(name="kitchen", horizon=HORIZON, backend="native", model=name) for name in MODELS
}
REDUCED, STOCK = MODELS.index("reduced"), MODELS.index("stock")


def plain(scene: int) -> Variation:
    """A scene with its own physics."""
    drawn = varied.draw_variation(jax.random.key(0))
    return Variation(
        scene=jnp.asarray(scene),
        friction=jnp.ones(()),
        softness=jnp.ones(()),
        damping=jnp.ones_like(drawn.damping),
        handles=jnp.zeros_like(drawn.handles),
        start=jnp.zeros_like(drawn.start),
    )


def stacked(*rows):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)


def observations(env, tasks, actions):
    """[N, T, 59]: what N worlds show after each of these actions [N, T, 9]."""

    def one(task, actions):
        def step(state, action):
            state, timestep = env.step(state, action)
            return state, timestep.obs

        state, first = env.reset(jax.random.key(0), task)
        return first.obs, jax.lax.scan(step, state, actions)[1]

    first, later = together(env, one, in_axes=(0, 0))(tasks, actions)
    return np.concatenate([first[:, None], later], axis=1)


def random_actions(num: int) -> np.ndarray:
    """Held for five steps each, so that the arm gets about."""
    few = np.random.default_rng(3).uniform(-1, 1, (num, STEPS // 5, 9))
    return np.repeat(few, 5, axis=1).astype(np.float32)


@pytest.mark.parametrize("scene", range(len(MODELS)))
def test_a_plain_variation_is_the_scene_itself(scene):
    """Although states are written in the full scene's coordinates, and in float32 in both scenes."""
    env, num = SCENES[MODELS[scene]], 3
    tasks = jax.vmap(env.task)(jnp.arange(300, 300 + num))
    varied_tasks = VariedTask(tasks.order, stacked(*[plain(scene)] * num))
    actions = random_actions(num)
    expected = observations(env, tasks, actions)
    found = observations(PLACE, varied_tasks, actions)
    tolerance = 0 if scene == REDUCED else 1e-4
    np.testing.assert_allclose(found[:, 1:], expected[:, 1:], rtol=0, atol=tolerance)
    # The kettle, which stands still in the reduced scene, and nothing else may start elsewhere.
    np.testing.assert_allclose(found[:, 0], expected[:, 0], atol=1e-6)


def test_worlds_of_a_batch_do_not_notice_each_other():
    keys = jax.random.split(jax.random.key(7), 6)
    tasks = jax.vmap(PLACE.sample_task)(keys)
    scene = jnp.asarray([REDUCED, STOCK] * 3)
    tasks = tasks._replace(variation=tasks.variation._replace(scene=scene))
    actions = random_actions(6)
    together_ = observations(PLACE, tasks, actions)
    for index in range(3):
        alone = jax.tree.map(lambda leaf, index=index: leaf[index : index + 1], tasks)
        found = observations(PLACE, alone, actions[index : index + 1])[0]
        np.testing.assert_allclose(found, together_[index], atol=1e-5)
    assert np.isfinite(together_).all()


@pytest.mark.parametrize("part", ["damping", "start"])
def test_what_is_drawn_moves_the_arm(part):
    """What touches nothing only feels damping and start."""
    drawn = varied.draw_variation(jax.random.key(5))
    before = plain(REDUCED)
    after = before._replace(**{part: getattr(drawn, part)})
    order = SCENES["reduced"].task(jnp.asarray(310)).order
    tasks = VariedTask(stacked(order, order), stacked(before, after))
    actions = np.repeat(random_actions(1), 2, axis=0)
    first, second = observations(PLACE, tasks, actions)
    assert np.abs(first[-1, :7] - second[-1, :7]).max() > 1e-3
    if part == "start":
        np.testing.assert_allclose(second[0, :7] - first[0, :7], drawn.start, atol=1e-6)


def test_fields_by_hand():
    model = load_model("reduced")
    one = plain(REDUCED)
    handles = one.handles.at[4].set(jnp.asarray([0.01, -0.005, 0.0]))  # of the microwave
    damping = one.damping.at[0].set(1.2)
    changed = one._replace(
        friction=jnp.asarray(0.7), softness=jnp.asarray(1.3), damping=damping, handles=handles
    )
    row = np.asarray(varied.start_of(changed).variation)[None]
    fields = varied.varied_fields(model, varied._unpacked(row))
    np.testing.assert_allclose(fields["pair_friction"][0, :, :2], 2 * 0.7, rtol=1e-6)
    np.testing.assert_allclose(fields["pair_solref"][0, :, 0], 0.02 * 1.3, rtol=1e-6)
    np.testing.assert_allclose(fields["pair_solref"][0, :, 1], 1.0)
    np.testing.assert_allclose(fields["dof_damping"][0, 0], 1.2 * model.dof_damping[0], rtol=1e-6)
    np.testing.assert_allclose(fields["dof_damping"][0, 1:], model.dof_damping[1:])
    shift = fields["geom_pos"][0] - model.geom_pos
    moved = {model.geom(int(geom)).name for geom in np.flatnonzero(np.abs(shift).sum(axis=1))}
    assert moved == {"microwave handle", "microwave door"}
    np.testing.assert_allclose(shift[model.geom("microwave door").id], [0.01, -0.005, 0], atol=1e-8)


def test_draws_stay_within_what_is_stated():
    drawn = jax.vmap(varied.draw_variation)(jax.random.split(jax.random.key(1), 2_000))
    for values, center, width in (
        (drawn.friction, 1, varied.FRICTION),
        (drawn.softness, 1, varied.SOFTNESS),
        (drawn.damping, 1, varied.DAMPING),
        (drawn.handles, 0, varied.HANDLE),
        (drawn.start, 0, varied.START),
    ):
        off = np.abs(np.asarray(values) - center)
        assert off.max() <= width + 1e-6
        assert off.max() > 0.95 * width
        assert abs(np.mean(np.asarray(values) - center)) < 0.05 * width
    # 2,000 draws of a share of 0.7: four standard deviations.
    assert abs(np.mean(drawn.scene == STOCK) - varied.STOCK_SHARE) < 0.041


def test_tasks_are_those_of_the_kitchen():
    """The orders, their hashes and what is kept for test do not depend on the scene."""
    env, key = SCENES["reduced"], jax.random.key(11)
    np.testing.assert_array_equal(PLACE.sample_task(key).order, env.sample_task(key).order)
    tasks = evaluation_tasks(PLACE, 16, 25, tested=env)
    assert not np.isin(task_hashes(PLACE, tasks), task_hashes(env, benchmark_tasks(env, 25))).any()
    assert set(np.asarray(tasks.variation.scene).tolist()) == {REDUCED, STOCK}


def test_a_dataset_keeps_the_scene_of_each_trajectory(monkeypatch):
    """Single subtasks in a short kitchen; whatever they are worth is kept."""
    monkeypatch.setattr(demonstrations, "BATCH", 8)
    env = replace(SCENES["reduced"], horizon=6)
    expert = envs.find("kitchen").demonstrators(env)["expert"]
    place = replace(expert.env, stock_share=0.5)
    expert = expert._replace(
        env=place,
        sample_task=lambda key, index: place.varied(key, env.task(index % 5)),
        keeps=lambda episode: episode.trajectory.length > 0,
    )
    dataset, facts = collect(env, expert, num=8, seed=0, num_test_tasks=25)
    assert list(facts["variants"]) == list(MODELS)
    assert sum(facts["variants"].values()) == len(dataset) == 8
    assert len(set(dataset.variants.tolist())) == 2
    # Only in the stock scene, to whose full state all of it belongs, does the kettle move at all.
    kettle = slice(18 + 14, 18 + 14 + 3)
    for index, start in enumerate(dataset.starts):
        rows = dataset.obs[start : start + dataset.lengths[index]]
        moves = np.ptp(rows[:, kettle], axis=0).max() > 0
        assert moves == (dataset.variants[index] == STOCK)


def test_the_first_demonstrator_is_that_of_the_world():
    known = partial(envs.find("kitchen").demonstrators)
    assert next(iter(known(Kitchen("kitchen", 500)))) == "expert"
    assert next(iter(known(Kitchen("kitchen", 500, backend="mjx")))) == "expert-mjx"
    stock = Kitchen("kitchen", 500, backend="native", model="stock")
    assert next(iter(known(stock))) == "expert-stock"
    assert all(one.env.spec.obs == stock.spec.obs for one in known(stock).values())
