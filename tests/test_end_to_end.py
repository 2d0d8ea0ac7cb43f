"""The whole method at toy scale: pre-train on mazes of side 9, then improve by adaptation."""

from __future__ import annotations

from functools import partial
from itertools import islice

import jax
import numpy as np
import pytest

from envs.maze.demonstrators import maze_demonstrators
from envs.maze.env import MazeRunner
from experiments.datasets import collect
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.runner import adapt
from mgpo_jax.settings import TrainConfig
from mgpo_jax.sharding import device_mesh
from mgpo_jax.tasks import sample_tasks
from mgpo_jax.training import Trainer, batch_stream

ENV = MazeRunner(name="maze9", side=9, horizon=24)


@pytest.fixture(scope="module")
def trained() -> tuple[list[float], LoadedPolicy]:
    """Losses and policy of 500 small steps on two devices."""
    demonstrator = maze_demonstrators(ENV)["astar4"]._replace(
        keeps=lambda episode: episode.trajectory.length >= 5
    )
    dataset, _ = collect(ENV, demonstrator, 3000, seed=0, num_test_tasks=50)
    config = TrainConfig(steps=500, batch_size=32, part_size=16, bucket=24, warmup_steps=20)
    config = TrainConfig(**{**vars(config), "learning_rate": 3e-3})
    network = network_config(ENV.spec, embed_dim=32, num_layers=2, dropout=0.0)
    trainer = Trainer(config, network, dataset, device_mesh(2))
    state, losses = trainer.init(), []
    for plans in islice(batch_stream(config, dataset, truncate=True, num_devices=2), config.steps):
        state, metrics = trainer.step(state, plans)
        losses.append(metrics["loss"])
    return [float(loss) for loss in losses], LoadedPolicy(network, state.params, {})


def test_pretraining_learns(trained: tuple[list[float], LoadedPolicy]) -> None:
    losses, _ = trained
    assert np.mean(losses[-50:]) < 0.6 * np.mean(losses[:10])


@pytest.mark.parametrize("name", ["ucb", "bpe"])
def test_adaptation_improves(trained: tuple[list[float], LoadedPolicy], name: str) -> None:
    """On unseen mazes the optimized prompt beats the prompt (g^M), and never loses to it."""
    tasks = sample_tasks(ENV, 77, 20)
    outcome = adapt(ENV, trained[1], tasks, name, seeds=2, episodes=40, eval_every=20)
    initial, final = outcome.eval_returns[:, :, 0], outcome.eval_returns[:, :, -1]
    optimum = np.asarray(jax.vmap(partial(ENV.optimal_return))(tasks))
    assert (final >= initial - 1e-5).all()
    assert (optimum - final >= -1e-5).all()
    regret_before, regret_after = (optimum - initial).mean(), (optimum - final).mean()
    assert regret_after < 0.5 * regret_before
