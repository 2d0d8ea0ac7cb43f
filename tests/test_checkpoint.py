"""Training checkpoints: round trips, and clear errors for damage."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest
from jax.flatten_util import ravel_pytree

import envs
from envs.errors import DataError
from mgpo_jax import checkpoint, processes
from mgpo_jax.checkpoint import (
    Snapshot,
    _named_leaves,
    checkpoints,
    restore_state,
    save_state,
)
from mgpo_jax.network_configs import TransformerConfig, network_config
from mgpo_jax.prompts import single_goal
from mgpo_jax.settings import TrainConfig
from mgpo_jax.training import TrainState
from mgpo_jax.transformer import GoalTransformer
from mgpo_jax.weight_updates import make_optimizer

SPEC = envs.make("maze15").spec
CONFIG = network_config(SPEC, embed_dim=8, num_layers=1)


def params_of(config: TransformerConfig) -> dict:
    prompt = single_goal(jnp.zeros(config.goal_dim), config.max_prompt_length)
    obs, actions = jnp.zeros((1, *config.obs_shape)), jnp.zeros(1, jnp.int32)
    return GoalTransformer(config).init(jax.random.key(0), prompt, obs, actions)


@pytest.fixture(scope="module")
def params() -> dict:
    return params_of(CONFIG)


def train_state(params: dict, step: int) -> TrainState:
    weights, unravel = ravel_pytree(params)
    opt_state = make_optimizer(TrainConfig(), unravel).init(weights)
    filled = jax.tree.map(lambda leaf: jnp.full_like(leaf, step), (params, opt_state))
    return TrainState(*filled, step)


ROW = {"step": 3, "train/loss": 0.1}
PENDING = {"loss": float(np.float32(0.3))}


def snapshot(params: dict, step: int) -> Snapshot:
    return Snapshot(train_state(params, step), [ROW], [PENDING])


def test_state_comes_back(tmp_path: Path, params: dict) -> None:
    blank = train_state(params, 0)
    with checkpoints(tmp_path) as manager:
        assert restore_state(manager, blank) is None
        for step in (3, 7):
            save_state(manager, snapshot(params, step))
    with checkpoints(tmp_path) as manager:
        found = restore_state(manager, blank)
    assert found is not None
    assert (found.state.step, found.measured, found.pending) == (7, [ROW], [PENDING])
    assert jax.tree.structure(found.state) == jax.tree.structure(blank)
    jax.tree.map(np.testing.assert_array_equal, found.state, train_state(params, 7))


def test_a_process_that_works_apart_saves_under_its_own_number(
    tmp_path: Path, params: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Orbax counts processes as jax does, whichever of them work together at present."""
    monkeypatch.setattr(jax, "process_index", lambda *args: 1)
    with processes.apart(), checkpoints(tmp_path) as manager:
        save_state(manager, snapshot(params, 3))
    assert (tmp_path / "3").is_dir()


def test_a_later_checkpoint_in_the_way_is_named(tmp_path: Path, params: dict) -> None:
    """A host may have one of another run. Orbax would save nothing there, while the others wait."""
    with checkpoints(tmp_path) as manager:
        save_state(manager, snapshot(params, 7))
        with pytest.raises(DataError, match=r"already has a checkpoint of step 7.*for step 3"):
            save_state(manager, snapshot(params, 3))


def test_checkpoint_of_another_run(tmp_path: Path, params: dict) -> None:
    blank = train_state(params, 0)
    with checkpoints(tmp_path) as manager:
        save_state(manager, snapshot(params, 3), "aa" * 32)
        assert restore_state(manager, blank, "aa" * 32) is not None
        with pytest.raises(DataError, match="of a run with other settings or data; remove"):
            restore_state(manager, blank, "bb" * 32)


def test_a_checkpoint_without_hash_is_read(tmp_path: Path, params: dict) -> None:
    """Those of older versions hold the leaves alone."""
    with checkpoints(tmp_path) as manager:
        manager.save(5, args=ocp.args.StandardSave(_named_leaves(train_state(params, 5))))
        found = restore_state(manager, train_state(params, 0), "aa" * 32)
    assert found is not None
    assert (found.state.step, found.measured, found.pending) == (5, None, [])


def damage(checkpoint: Path, how: str) -> None:
    """Flip a bit of the largest file, or cut or remove it."""
    largest = max((p for p in checkpoint.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    content = bytearray(largest.read_bytes())
    content[len(content) // 2] ^= 1
    if how == "missing":
        largest.unlink()
    else:
        largest.write_bytes(content if how == "flipped" else content[: len(content) // 2])


@pytest.mark.parametrize("how", ["flipped", "cut", "missing"])
def test_a_damaged_checkpoint_is_set_aside(
    tmp_path: Path, params: dict, how: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """The run goes on from the one before, and saves the step of the damaged one again."""
    folder, blank = tmp_path / "checkpoints", train_state(params, 0)
    with checkpoints(folder) as manager:
        for step in (3, 7):
            save_state(manager, snapshot(params, step))
    damage(folder / "7", how)
    with checkpoints(folder) as manager:
        found = restore_state(manager, blank)
        assert found is not None
        assert found.state.step == 3
        save_state(manager, snapshot(params, 7))
    assert (tmp_path / "checkpoints-damaged/7").is_dir()
    err = capfd.readouterr().err
    assert f"checkpoint {folder / '7'} is damaged; it was moved to" in err
    assert "Traceback" not in err
    with checkpoints(folder) as manager:
        again = restore_state(manager, blank)
    assert again is not None
    assert again.state.step == 7


@pytest.mark.parametrize("error", [PermissionError(13, "denied"), MemoryError()])
def test_a_fault_of_the_machine_sets_nothing_aside(
    tmp_path: Path, params: dict, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    folder = tmp_path / "checkpoints"

    def fail(*args: object) -> None:
        raise error

    with checkpoints(folder) as manager:
        save_state(manager, snapshot(params, 3))
        monkeypatch.setattr(checkpoint, "_read", fail)
        with pytest.raises(type(error)):
            restore_state(manager, train_state(params, 0))
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoints"]


def test_what_was_set_aside_stays(tmp_path: Path, params: dict) -> None:
    folder = tmp_path / "checkpoints"
    for _ in range(2):
        with checkpoints(folder) as manager:
            save_state(manager, snapshot(params, 3))
        damage(folder / "3", "cut")
        with checkpoints(folder) as manager:
            assert restore_state(manager, train_state(params, 0)) is None
    names = sorted(path.name for path in (tmp_path / "checkpoints-damaged").iterdir())
    assert names == ["3", "3-2"]


def test_no_sound_checkpoint_is_left(tmp_path: Path, params: dict) -> None:
    folder = tmp_path / "checkpoints"
    with checkpoints(folder) as manager:
        save_state(manager, snapshot(params, 3))
    damage(folder / "3", "cut")
    with checkpoints(folder) as manager:
        assert restore_state(manager, train_state(params, 0)) is None


def test_a_file_in_the_place_of_checkpoints(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").write_text("")
    refused = pytest.raises(DataError, match="is not a folder; remove it")
    with refused, checkpoints(tmp_path / "checkpoints"):
        pass


def test_state_of_another_network(tmp_path: Path, params: dict) -> None:
    with checkpoints(tmp_path) as manager:
        save_state(manager, snapshot(params, 1))
    other = params_of(network_config(SPEC, embed_dim=16, num_layers=1))
    with checkpoints(tmp_path) as manager, pytest.raises(DataError, match="of another network"):
        restore_state(manager, train_state(other, 0))


SAVER = """
import sys, itertools, jax.numpy as jnp
from mgpo_jax.checkpoint import Snapshot, checkpoints, save_state
from mgpo_jax.training import TrainState
with checkpoints(sys.argv[1]) as manager:
    for step in itertools.count(1):
        leaf = jnp.full((400, 400), step, jnp.float32)
        state = TrainState({"a": leaf, "b": leaf}, (leaf,), step)
        save_state(manager, Snapshot(state, [], []))
        print(step, flush=True)
"""


def test_kill_in_mid_save_loses_nothing(tmp_path: Path) -> None:
    """SIGKILL at any moment leaves a newest checkpoint that is whole."""
    process = subprocess.Popen(
        [sys.executable, "-c", SAVER, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) == 6:
            break
    time.sleep(0.013)  # somewhere within the next save
    process.send_signal(signal.SIGKILL)
    process.wait()
    blank = jnp.zeros((400, 400))
    with checkpoints(tmp_path) as manager:
        found = restore_state(manager, TrainState({"a": blank, "b": blank}, (blank,), 0))
    assert found is not None
    state = found.state
    assert state.step >= 6
    for leaf in jax.tree.leaves((state.params, state.opt_state)):
        np.testing.assert_array_equal(leaf, state.step)
