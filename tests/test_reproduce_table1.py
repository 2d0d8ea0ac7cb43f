"""``experiments.reproduce table1 --scale smoke`` in a small form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import pytest

import envs
from envs import episodes
from experiments import comparison_tables, comparisons
from experiments.reproduce import main
from experiments.store.reproduce_settings import ReproduceConfig
from mgpo_jax import methods
from mgpo_jax.baselines.commanded import CommandConfig, complete
from mgpo_jax.baselines.skills import SkillConfig
from mgpo_jax.kinds import KINDS
from mgpo_jax.network_configs import network_config, world_side
from mgpo_jax.policy import LoadedPolicy

TABLE = comparisons.TABLES["table1"]
SIZES = {"embed_dim": 8, "num_layers": 1}


def small(world: Any, path: Any, kind: str) -> LoadedPolicy:
    """A small network of a kind with random weights, instead of the released one."""
    env = envs.make(world.name)
    side = world_side(env.spec, None, "linear")
    config: Any
    if kind == "ptgm":
        config = CommandConfig(**side, **SIZES, num_heads=1, dropout=0.0)
        config = complete(config, env, None)
    elif kind == "spirl":
        config = SkillConfig(**side, **SIZES, latent_dim=2)
    else:
        config = network_config(env.spec, max_prompt_length=2, num_heads=1, dropout=0.0, **SIZES)
    params = KINDS.find(kind).load().init(jax.random.key(0), config)
    return LoadedPolicy(config, params, {}, sha256="0" * 64)


@pytest.mark.parametrize("world", ["maze15", "gridworld"])
def test_from_cells_to_table(
    world: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """All methods of the table on two tasks.

    In fifteen episodes PPO has three rounds, and SPiRL goes on after its ten of warming up.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(comparisons, "SMOKE_TASKS", 2)
    for module in (comparisons, comparison_tables):
        monkeypatch.setattr(module, "SMOKE_EPISODES", 15)
    monkeypatch.setattr(episodes, "MAX_SEGMENTS", 1)
    monkeypatch.setattr(comparisons, "load_policy", small)
    main(ReproduceConfig(what="table1", env=(world,), scale="smoke"))
    names = TABLE.methods + TABLE.further
    text = capsys.readouterr().out
    _, _, *rows = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [row[:2] for row in cells] == [[world, methods.find(name).title] for name in names]
    for row, name in zip(cells, names, strict=True):
        num = 15 if methods.find(name).learns else 1
        assert row[6] == f"2 x 1 x {num}"
        float(row[3].split()[0])
    assert "failed" not in text
    assert "Scaled down: 2 tasks, 1 seed, 15 episodes" in text
    assert (tmp_path / "runs/reproduce/table1-smoke.png").stat().st_size > 0
