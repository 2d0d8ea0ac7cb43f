"""The bench: its count of FLOP against the network's work, and the command from start to end."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import envs
from envs.errors import DataError, UsageError
from envs.registry import Judgement
from experiments import bench, layouts, measurements, signals
from experiments.bench import BenchConfig, main
from experiments.measurements import sequence_flops
from experiments.store.presets import pretrain_preset
from mgpo_jax import claims, released
from mgpo_jax.kinds import kind_of
from mgpo_jax.network_configs import TransformerConfig

CONFIG = TransformerConfig(obs_shape=(3, 2), goal_dim=2, action_dim=4, horizon=9, embed_dim=8)


def products(num_goals: int, num_steps: int, tokens: int) -> int:
    """FLOP of one pass, product by product (2 m n for a vector of m with a matrix m x n)."""
    width = CONFIG.embed_dim
    square = 2 * width * width
    num_tokens = 2 * num_steps - 1 if tokens == 2 else num_steps
    is_obs = [False] * num_goals + [index % tokens == 0 for index in range(num_tokens)]
    total = 0
    for layer in range(CONFIG.num_layers):
        for position, read_out in enumerate(is_obs):
            total += 2 * square  # key, value
            if read_out or layer < CONFIG.num_layers - 1:
                total += 2 * square  # query and mix
                total += 2 * (4 * square)  # feed-forward
                total += 2 * (2 * width * (position + 1))  # scores and weighted values
    embed = 2 * width * (math.prod(CONFIG.obs_shape) + CONFIG.action_dim)
    return total + num_steps * (embed + 2 * width * CONFIG.action_dim)


@pytest.mark.parametrize("tokens", [2, 1])
@pytest.mark.parametrize(("num_goals", "num_steps"), [(1, 1), (3, 1), (1, 4), (5, 9)])
def test_flops_are_those_of_the_products(num_goals: int, num_steps: int, tokens: int) -> None:
    config = replace(CONFIG, tokens_per_step=tokens)
    counted = sequence_flops(config, num_goals, np.array([num_steps, num_steps]))
    assert counted.tolist() == [products(num_goals, num_steps, tokens)] * 2


@pytest.mark.slow
def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bench.json"
    main(BenchConfig(demonstrator="astar2", quick=True, trajectories=200, json=path))
    rows = json.loads(path.read_text())["rows"]
    found = {row["name"].strip(): row for row in rows}
    assert found["collection"]["note"].startswith("astar2")
    assert all(row["value"] > 0 for row in rows)
    assert found["relative speed"]["value"] < 100
    printed = capsys.readouterr().out
    assert all(name in printed for name in found)


def test_baselines_without_a_released_network_start_from_random_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(released, "RELEASED", tmp_path)
    world, env = envs.find("maze15"), envs.make("maze15")
    dataset, _ = measurements.bench_collect(world, env, "astar1", 8)
    recipe = pretrain_preset("maze15", "smoke", "spirl")
    policy, note = measurements.policy_to_bench(world, env, recipe, dataset)
    assert note == "untrained policy"
    assert kind_of(policy.config).name == "spirl"


def test_rows_of_baselines_are_per_episode_of_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """A world that a method's check refuses, such as one without a list of goals, has no row of it."""
    asked = []

    def adapt(env, policy, tasks, method, hyper, *, seeds, episodes, eval_every, judged):
        asked.append((policy, method.name, seeds, episodes, eval_every, judged))
        if method.name == "ptgm":
            raise UsageError("no goals to choose from")
        returns = np.zeros((seeds, 4, episodes))
        return SimpleNamespace(cpu_seconds=8.0, returns=returns, lengths=returns + 30)

    monkeypatch.setattr(measurements, "adapt", adapt)
    monkeypatch.setattr(
        measurements, "policy_to_bench", lambda world, env, recipe, dataset: (recipe.method, "made")
    )
    sampled = Judgement(mode="sample", temperature=0.5, episodes=16)
    world, env = replace(envs.find("gridworld"), judged=sampled), envs.make("gridworld")
    rows = list(measurements.bench_baselines(world, env, "gridworld", None, 40))
    assert [row.name for row in rows] == ["adapt reinforce", "adapt ppo", "adapt spirl"]
    assert [row.value for row in rows] == [1e3 * 8 / 160] * 3
    assert rows[0].note == "made, 4 tasks x 40 episodes of 30 steps"
    assert [kind for kind, *_ in asked] == ["mgpo", "mgpo", "ptgm", "spirl"]
    # Judged as the world's record says, but in a single episode.
    assert {tuple(rest) for _, _, *rest in asked} == {(1, 40, 40, replace(sampled, episodes=1))}


@pytest.mark.parametrize("kind", ["rows", "layouts"])
def test_a_bench_that_is_stopped_keeps_its_measurements(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, kept = tmp_path / "bench.json", []
    row: dict[str, Any] = {"name": "collection", "value": 1.0, "unit": "ms", "note": ""}

    def stop() -> None:
        assert signals._watch.farewell() == bench.STOPPED
        kept.append(len(json.loads(path.read_text())[kind]))

    def measure(*given: Any) -> Iterator[measurements.Row]:
        for _ in range(2):
            yield measurements.Row(**row)
            stop()

    def measure_layout(layout: str, words: Any) -> list[dict[str, Any]]:
        if layout == "1x2":
            stop()
        return [row]

    monkeypatch.setattr(measurements, "measurements", measure)
    monkeypatch.setattr(bench, "measured", measure_layout)
    main(BenchConfig(json=path, layouts=("2x1", "1x2") if kind == "layouts" else ()))
    assert kept == ([1] if kind == "layouts" else [1, 2])
    found = json.loads(path.read_text())
    assert len(found[kind]) == 2
    assert {"revision", "command"} <= found.keys()


def test_a_bench_that_is_stopped_leaves_no_process_and_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal ends a command without its ``finally`` blocks, after what was registered for that."""
    started, popen = [], subprocess.Popen

    def sleeping(command: list[str], **options: Any) -> subprocess.Popen:
        started.append(popen([sys.executable, "-c", "import time; time.sleep(60)"]))
        if len(started) == 2:
            assert list(tmp_path.iterdir())
            threading.Timer(0.1, claims.clean_up).start()
        return started[-1]

    monkeypatch.setattr(layouts.subprocess, "Popen", sleeping)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(DataError, match="failed with the layout 2x1"):
        layouts.measured("2x1", [])
    assert all(process.poll() is not None for process in started)
    assert not list(tmp_path.iterdir())
