"""The demonstrator of the kitchen: its kinematics against MuJoCo, and the subtasks that it completes."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from conftest import require_kitchen

from envs.base import TimeStep
from envs.kitchen.env import NONE, SUBTASKS, Kitchen, KitchenState, KitchenTask

require_kitchen()
import mujoco  # noqa: E402

import envs  # noqa: E402
from envs.kitchen import demonstrators  # noqa: E402
from envs.kitchen.arm import PAD, arm_pose, make_arm, rotation_vector, turn  # noqa: E402
from envs.kitchen.demonstrators import HIGH, LOW, scripted_arm  # noqa: E402
from envs.kitchen.model import load_model  # noqa: E402
from envs.kitchen.phases import make_plan  # noqa: E402

WORLD = Kitchen(name="kitchen", horizon=500)


@cache
def play():
    """``keys, orders -> rewards, goals, actions`` of whole episodes."""
    agent = scripted_arm(WORLD)

    def episode(key, order):
        task = KitchenTask(order)
        state, timestep = WORLD.reset(key, task)
        action, _, memory = agent.begin(key, task, state, timestep)

        def step(carry, time):
            state, action, memory = carry
            state, timestep = WORLD.step(state, action)
            following, _, memory = agent.proceed(
                jax.random.fold_in(key, time), memory, state, timestep
            )
            return (state, following, memory), (timestep.reward, timestep.achieved_goal, action)

        return jax.lax.scan(step, (state, action, memory), jnp.arange(WORLD.horizon))[1]

    return jax.jit(jax.vmap(episode))


def demonstrate(orders, seed=0):
    keys = jax.random.split(jax.random.key(seed), len(orders))
    rows = np.array([[*order, *[NONE] * (5 - len(order))] for order in orders], np.int32)
    return jax.tree.map(np.asarray, play()(keys, rows))


class TestArm:
    def test_it_agrees_with_mujoco(self):
        model = load_model("reduced")
        data, arm = mujoco.MjData(model), make_arm(model)
        pose = jax.jit(lambda angles: arm_pose(arm, angles))
        rng = np.random.default_rng(0)
        for angles in rng.uniform(LOW, HIGH, (8, 7)).astype(np.float32):
            data.qpos[:7], data.qpos[7:9] = angles, 0.02
            mujoco.mj_forward(model, data)
            site = data.site("end_effector")
            rotation = site.xmat.reshape(3, 3)
            tip = site.xpos + PAD * rotation[:, 2]
            linear, angular = np.zeros((2, 3, model.nv))
            body = model.site("end_effector").bodyid[0]
            mujoco.mj_jac(model, data, linear, angular, tip, body)
            found = pose(angles)
            np.testing.assert_allclose(found.tip, tip, atol=1e-5)
            np.testing.assert_allclose(found.rotation, rotation, atol=1e-5)
            jacobian = np.concatenate([linear, angular])[:, :7]
            np.testing.assert_allclose(found.jacobian, jacobian, atol=1e-5)
            np.testing.assert_allclose(found.gravity, data.qfrc_bias[:7], atol=1e-3)

    def test_rotation_vectors(self):
        for angle in (0.0, 1e-4, 0.5, 3.0, -2.0):
            np.testing.assert_allclose(
                rotation_vector(turn(jnp.array(angle))), [0, 0, angle], atol=1e-5
            )


class TestPlan:
    def test_poses_are_within_reach(self):
        plan = make_plan()
        poses = plan.phases.pose[plan.phases.joint_move]
        assert (poses >= LOW - 0.02).all()
        assert (poses <= HIGH).all()

    def test_first_poses_stand_in_front_of_the_objects(self):
        """The tip is 5 to 20 cm from the site of the object."""
        model = load_model("reduced")
        data, arm, plan = mujoco.MjData(model), make_arm(model), make_plan()
        mujoco.mj_forward(model, data)
        sites = ("knob2_site", "light_site", "slide_site", "hinge_site2", "microhandle_site")
        for subtask, site in enumerate(sites):
            phase = 2 if subtask == SUBTASKS.index("slide cabinet") else 1
            tip = arm_pose(arm, jnp.asarray(plan.phases.pose[subtask, phase])).tip
            assert 0.05 < np.linalg.norm(tip - data.site(site).xpos) < 0.2


class TestExpert:
    def test_every_subtask(self):
        rewards, goals, actions = demonstrate([[subtask] for subtask in range(5)] * 4)
        assert (rewards.sum(axis=1) == 1).mean() >= 0.95
        assert np.abs(actions).max() <= 1
        assert np.isfinite(actions).all()
        for index, rows in enumerate(goals):
            first = rows[rows.any(axis=1)][:1]
            np.testing.assert_array_equal(np.argmax(first, axis=1), [index % 5])

    def test_all_five_in_any_order(self):
        rng = np.random.default_rng(0)
        rewards, _, _ = demonstrate([rng.permutation(5).tolist() for _ in range(20)], seed=1)
        assert (rewards.sum(axis=1) > 0.99).mean() >= 0.8
        assert rewards.sum(axis=1).mean() > 0.9

    def test_by_name(self):
        known = envs.find("kitchen").demonstrators(WORLD)
        assert list(known) == ["expert", "expert-reduced", "expert-stock", "expert-mjx"]

    def test_actions_have_the_noise_of_the_manifest(self, monkeypatch):
        """Whatever the demonstrator does, nine components have independent noise of the size named."""
        meant = jnp.linspace(-0.5, 0.5, 9)
        for name in ("look", "is_over", "current_phase", "next_subtask"):
            monkeypatch.setattr(demonstrators, name, lambda *args: None)
        monkeypatch.setattr(demonstrators, "advance", lambda plan, memory, *args: memory)
        monkeypatch.setattr(demonstrators, "act", lambda *args: meant)
        nothing = KitchenState(*[None] * len(KitchenState._fields))
        state = nothing._replace(physics=SimpleNamespace(qpos=jnp.zeros(14)))
        memory, timestep = demonstrators.Memory(*[jnp.int32(0)] * 4), TimeStep(*[None] * 7)
        agent = scripted_arm(WORLD)
        act = jax.jit(jax.vmap(lambda key: agent.proceed(key, memory, state, timestep)[0]))
        noise = np.asarray(act(jax.random.split(jax.random.key(0), 2_000)) - meant)
        np.testing.assert_allclose(noise.std(axis=0), 0.08, rtol=0.1)
        np.testing.assert_allclose(noise.mean(axis=0), 0, atol=0.01)
        assert np.abs(np.corrcoef(noise.T) - np.eye(9)).max() < 0.1
        for demonstrator in envs.find("kitchen").demonstrators(WORLD).values():
            assert dict(demonstrator.settings)["noise"] == 0.08
