"""The results of a lane do not depend on the number of lanes (a fault of XLA is avoided)."""

from __future__ import annotations

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import compiler

LANES, STEPS = 128, 250
QUICK = {"xla_llvm_disable_expensive_passes": True, "xla_backend_optimization_level": 0}


def rows(tree):
    """All numbers of lanes, ``{path: [lanes, ..]}``."""

    def numbers(leaf):
        keys = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if keys else leaf)

    leaves = jax.tree.leaves_with_path(tree)
    return {jax.tree_util.keystr(path): numbers(leaf) for path, leaf in leaves}


def play(size, start, steps):
    """Every number of the state and of what is seen after each step, of some of 128 lanes alone."""
    env = envs.make("crafter-symbolic")
    tasks = jax.vmap(env.sample_task)(jax.random.split(jax.random.key(6), LANES))
    keys = jax.random.split(jax.random.key(5), LANES)
    actions = jax.random.randint(jax.random.key(7), (LANES, STEPS), 0, env.spec.action_dim)
    at = slice(start, start + size)
    own = keys[at], jax.tree.map(lambda leaf: leaf[at], tasks)
    reset = jax.jit(jax.vmap(env.reset), compiler_options=QUICK)
    step = jax.jit(jax.vmap(env.step), compiler_options=QUICK)
    state, timestep = reset(*own)
    yield rows((state, timestep))
    for time in range(steps):
        state, timestep = step(state, actions[at, time])
        yield rows((state, timestep))


@pytest.fixture(scope="module")
def many():
    """All lanes together, step by step."""
    pytest.importorskip("craftax", reason="Crafter needs craftax")
    return list(play(LANES, 0, STEPS))


@pytest.mark.parametrize(
    ("size", "start", "steps"),
    [
        (1, 9, STEPS),
        (8, 40, 0),
        (64, 64, 0),
        pytest.param(8, 120, STEPS, marks=pytest.mark.slow),
        pytest.param(64, 32, STEPS, marks=pytest.mark.slow),
    ],
)
def test_a_lane_of_many_is_that_of_few(many, size, start, steps):
    """Every field of Crafter's state; compiling takes most of the time, the start is what once differed."""
    for time, alone in enumerate(play(size, start, steps)):
        for path, row in alone.items():
            whole = many[time][path][start : start + size]
            np.testing.assert_array_equal(row, whole, err_msg=f"{path} after {time} steps")


def test_sums_of_products_are_right_beyond_the_first_kernel():
    """The fault alone: of 64 x 64 sums in each of 16 lanes, all from the ninth lane on were wrong."""
    draw = np.random.default_rng(0).normal
    shared, own = (draw(size=shape).astype(np.float32) for shape in ((64, 64, 2), (16, 64, 64, 2)))
    got = jax.jit(lambda w, x: jnp.sum(w * x, axis=-1) * 2 + 1)(shared, own)
    right = (shared.astype(float) * own).sum(axis=-1) * 2 + 1
    np.testing.assert_allclose(got, right, rtol=1e-4, atol=1e-4)


class TestAvoidFault:
    @pytest.fixture(autouse=True)
    def _faulty(self, monkeypatch):
        monkeypatch.setattr(compiler, "version", lambda name: compiler.FAULTY[0])
        monkeypatch.setattr(compiler, "_has_computed", lambda: False)

    @pytest.mark.parametrize(
        ("before", "after"),
        [
            ({}, "--xla_cpu_experimental_ynn_fusion_type=-reduce"),
            ({"XLA_FLAGS": "--a=1"}, "--a=1 --xla_cpu_experimental_ynn_fusion_type=-reduce"),
            (
                {"XLA_FLAGS": "--xla_cpu_experimental_ynn_fusion_type=-dot"},
                "--xla_cpu_experimental_ynn_fusion_type=-dot",
            ),
        ],
    )
    def test_flags(self, before, after):
        compiler.avoid_fault(before)
        compiler.avoid_fault(before)  # twice is once
        assert before["XLA_FLAGS"] == after

    def test_jax_has_computed_already(self, monkeypatch):
        monkeypatch.setattr(compiler, "_has_computed", lambda: True)
        with pytest.warns(
            RuntimeWarning, match="import envs or mgpo_jax before jax computes anything"
        ):
            compiler.avoid_fault({})
        compiler.avoid_fault(
            {"XLA_FLAGS": f"--{compiler.OPTION}=-reduce"}
        )  # which was early enough

    def test_other_versions_are_left_alone(self, monkeypatch):
        monkeypatch.setattr(compiler, "version", lambda name: "0.11.2")
        environment = {}
        compiler.avoid_fault(environment)
        assert environment == {}

    def test_without_jaxlib(self, monkeypatch):
        def missing(name):
            raise compiler.PackageNotFoundError(name)

        monkeypatch.setattr(compiler, "version", missing)
        environment = {}
        compiler.avoid_fault(environment)
        assert environment == {}


def test_it_is_known_whether_jax_has_computed():
    code = (
        "from envs.compiler import _has_computed; assert not _has_computed(); import jax; "
        "assert not _has_computed(); jax.devices(); assert _has_computed()"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("package", ["envs", "mgpo_jax.policy"])
def test_both_packages_avoid_the_fault(package):
    code = (
        f"import os; os.environ.pop('XLA_FLAGS', None); import {package}; from envs import compiler; "
        "faulty = compiler._installed() in compiler.FAULTY; "
        "assert (compiler.OPTION in os.environ.get('XLA_FLAGS', '')) == faulty"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
