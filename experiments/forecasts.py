"""``--dry-run``: estimates of the work and resources that a command would need."""

from __future__ import annotations

import math
from collections.abc import Iterable
from math import ceil
from typing import Any

import jax

import envs
from envs.base import Environment, Task
from envs.registry import World
from experiments.inventory import price_of, seconds_per_episode
from experiments.networks import sized_network
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.settings import PretrainConfig
from experiments.store.summary import judged_episodes
from experiments.store.tables import block
from mgpo_jax import methods
from mgpo_jax.dataset import spec_of
from mgpo_jax.files import to_json
from mgpo_jax.kinds import MULTI_GOAL
from mgpo_jax.losses import initial_params
from mgpo_jax.manifest import read_facts
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.runner import log_bytes
from mgpo_jax.tasks import num_tasks

OPTIMIZER = 3  # copies of the weights in a gradient step, at least: weights, gradient, a moment


def of_adaptation(
    config: AdaptConfig, world: World, env: Environment, policy: LoadedPolicy, tasks: Task
) -> str:
    """What ``adapt`` would do: searches, episodes, memory and CPU time.

    The CPU time is estimated from published adaptations in this world (``inventory.seconds_per_episode``).
    """
    num, method = num_tasks(tasks), methods.find(config.method)
    lanes = num * config.seeds * _num_variants(config)
    judgements = 1 + ceil(config.episodes / config.eval_every)
    judged = judgements * (judged_episodes(to_json(config), world) or 1)
    rate = seconds_per_episode(config.env, method)
    num_bytes = log_bytes(env, lanes, config.episodes, config.keep_actions)
    rows = [
        ("searches", f"{num} tasks x {config.seeds} seeds x {_num_variants(config)} variants"),
        (
            "episodes",
            f"{lanes * config.episodes:,} for searching, {lanes * judged:,} for evaluation",
        ),
        ("steps", f"at most {lanes * (config.episodes + judged) * env.spec.horizon:,}"),
        ("network", f"{_num_weights(policy.params):,} weights"),
        ("memory", f"{num_bytes / 1e6:,.0f} MB of results at most"),
        (
            "CPU time",
            _cpu_time(None if rate is None else rate * lanes * (config.episodes + judged)),
        ),
        ("results", str(config.folder)),
    ]
    return block(f"{config.env}, {config.method}: dry run, nothing is computed", rows)


def _num_variants(config: AdaptConfig) -> int:
    if not config.sweep:
        return 1
    from experiments.sweeping import variants

    return len(variants(config))


def of_training(config: PretrainConfig) -> str:
    """What ``pretrain`` would do: the network, its batches, memory and CPU time.

    Weights are only counted for the multi-goal Transformer, since the sizes of other kinds depend on the
    data. The CPU time is estimated from the training of the world's released policy
    (``inventory.price_of``).
    """
    train, folder = config.train, config.data.data_folder
    spec = spec_of(read_facts(folder)) if folder is not None else envs.make(config.env).spec
    rows = [("trajectories", f"{config.data.trajectories:,}, {config.holdout:,} of them held out")]
    if config.method == MULTI_GOAL:
        network = sized_network(config, spec)
        shapes = jax.eval_shape(lambda key: initial_params(key, network), jax.random.key(0))
        num = _num_weights(shapes)
        tokens = network.max_prompt_length + network.num_step_tokens(spec.horizon)
        rows += [
            ("network", f"{num:,} weights"),
            ("tokens", f"at most {tokens:,} a trajectory"),
            ("memory", f"{4 * OPTIMIZER * num / 1e6:,.0f} MB for weights, beside data and a batch"),
        ]
    rows += [
        ("batches", f"{train.batch_size} trajectories in parts of {train.part_size}"),
        ("steps", f"{train.steps:,}"),
        ("CPU time", _cpu_time(None if folder is not None else price_of(config))),
        ("run", str(config.folder)),
    ]
    return block(f"{config.env}, {config.method}: dry run, nothing is computed", rows)


def _num_weights(params: Any) -> int:
    leaves: Iterable[Any] = jax.tree.leaves(params)
    return sum(math.prod(leaf.shape) for leaf in leaves)


def _cpu_time(seconds: float | None) -> str:
    if seconds is None:
        return "unknown: no similar run has been measured"
    if seconds < 120:
        return f"about {seconds:.0f} seconds, plus compilation"
    return f"about {seconds / 60:.0f} minutes, plus compilation"
