"""``--dry-run``: estimates of the work and resources that a command would need."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

import envs
from envs.base import Environment, Task
from envs.registry import World
from envs.specs import EnvSpec
from experiments.inventory import price_of, seconds_per_episode
from experiments.networks import sized_network
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.settings import PretrainConfig
from experiments.store.speeds import num_judging
from experiments.store.tables import block
from mgpo_jax import methods
from mgpo_jax.dataset import spec_of
from mgpo_jax.kinds import MULTI_GOAL
from mgpo_jax.losses import initial_params
from mgpo_jax.manifest import read_facts
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.runner import log_bytes
from mgpo_jax.tasks import num_tasks

OPTIMIZER = 3  # copies of the weights in a gradient step, at least: weights, gradient, a moment


class Fact(NamedTuple):
    """A line of an estimate."""

    name: str
    text: str
    value: Any
    """The same as a JSON value, in the smallest unit: numbers, bytes, seconds. None if it is unknown."""
    key: str = ""
    """Its name in JSON (default: ``name``)."""


def printed(title: str, facts: Sequence[Fact], as_json: bool) -> str:
    """An estimate as text, or as a JSON object."""
    if as_json:
        return json.dumps({fact.key or fact.name: fact.value for fact in facts}, indent=2)
    return block(f"{title}: dry run, nothing is computed", [fact[:2] for fact in facts])


def of_adaptation(
    config: AdaptConfig, world: World, env: Environment, policy: LoadedPolicy, tasks: Task
) -> str:
    """What ``adapt`` would do: searches, episodes, memory and CPU time.

    The CPU time is estimated from published adaptations in this world (``inventory.seconds_per_episode``).
    """
    num, method = num_tasks(tasks), methods.find(config.method)
    lanes = num * config.seeds * _num_variants(config)
    rate = seconds_per_episode(config.env, method)
    num_bytes = log_bytes(env, lanes, config.episodes, config.keep_actions)
    searching, judging = lanes * config.episodes, lanes * num_judging(config, world)
    steps, weights = (searching + judging) * env.spec.horizon, _num_weights(policy.params)
    searches = f"{num} tasks x {config.seeds} seeds x {_num_variants(config)} variants"
    facts = [
        Fact("searches", searches, lanes),
        Fact(
            "episodes",
            f"{searching:,} for searching, {judging:,} for evaluation",
            {"searching": searching, "evaluation": judging},
        ),
        Fact("steps", f"at most {steps:,}", steps),
        Fact("network", f"{weights:,} weights", weights, "weights"),
        Fact("memory", f"{num_bytes / 1e6:,.0f} MB of results at most", num_bytes, "memory_bytes"),
        _cpu_time(None if rate is None else rate * (searching + judging)),
        Fact("results", str(config.folder), str(config.folder)),
    ]
    return printed(f"{config.env}, {config.method}", facts, config.json)


def _num_variants(config: AdaptConfig) -> int:
    if not config.sweep:
        return 1
    from experiments.sweeping import variants

    return len(variants(config))


def of_training(config: PretrainConfig) -> str:
    """What ``pretrain`` would do: the network, its inputs and batches, memory and CPU time.

    Weights are only counted for the multi-goal Transformer, since the sizes of other kinds depend on the
    data. The CPU time is estimated from the training of the world's released policy
    (``inventory.price_of``). It is unknown for data of the user's own, since how long a step takes depends
    on the lengths of the trajectories and on the size of the network in ways that were not measured.
    """
    train, folder = config.train, config.data.data_folder
    spec = spec_of(read_facts(folder)) if folder is not None else envs.make(config.env).spec
    held_out = {"all": config.data.trajectories, "held_out": config.holdout}
    told = f"{config.data.trajectories:,}, {config.holdout:,} of them held out"
    facts = [Fact("trajectories", told, held_out), *_facts_of_input(spec)]
    if config.method == MULTI_GOAL:
        facts += _facts_of_network(config, spec)
    num_bytes = train.batch_size * _bytes_of_trajectory(spec)
    batch = (
        f"{train.batch_size} trajectories in parts of {train.part_size}, at most {_size(num_bytes)} of "
        "input"
    )
    facts += [
        Fact(
            "batches",
            batch,
            {"trajectories": train.batch_size, "part": train.part_size, "bytes": num_bytes},
        ),
        Fact("steps", f"{train.steps:,}", train.steps),
        _cpu_time(None if folder is not None else price_of(config)),
        Fact("run", str(config.folder), str(config.folder)),
    ]
    return printed(f"{config.env}, {config.method}", facts, config.json)


def _facts_of_network(config: PretrainConfig, spec: EnvSpec) -> list[Fact]:
    """The sizes of the multi-goal Transformer."""
    network = sized_network(config, spec)
    shapes = jax.eval_shape(lambda key: initial_params(key, network), jax.random.key(0))
    num = _num_weights(shapes)
    tokens = network.max_prompt_length + network.num_step_tokens(spec.horizon)
    num_bytes = 4 * OPTIMIZER * num
    memory = f"{num_bytes / 1e6:,.0f} MB for weights, beside data and a batch"
    return [
        Fact("network", f"{num:,} weights", num, "weights"),
        Fact("tokens", f"at most {tokens:,} a trajectory", tokens),
        Fact("memory", memory, num_bytes, "memory_bytes"),
    ]


def _facts_of_input(spec: EnvSpec) -> list[Fact]:
    """The shapes of what the network reads and of what it puts out."""
    shape, dtype = list(spec.obs.shape), str(spec.obs.dtype)
    actions = f"{spec.action_dim} {'discrete' if spec.discrete else 'numbers'}"
    return [
        Fact("observations", f"{dtype}{shape}", {"dtype": dtype, "shape": shape}),
        Fact("goals", f"{spec.goal_dim} numbers", spec.goal_dim),
        Fact("actions", actions, {"discrete": spec.discrete, "num": spec.action_dim}),
    ]


def _bytes_of_trajectory(spec: EnvSpec) -> int:
    """Bytes of the longest trajectory in a batch, with all arrays that a dataset can have by step.

    These are observations, executed and intended actions, achieved goals and outcomes, and whether a goal
    was reached.
    """
    obs = spec.obs.size * np.dtype(spec.obs.dtype).itemsize
    action = 1 if spec.discrete else spec.action_dim
    return int(spec.horizon * (obs + 2 * 4 * action + 2 * 4 * spec.goal_dim + 1))


def _num_weights(params: Any) -> int:
    leaves: Iterable[Any] = jax.tree.leaves(params)
    return sum(math.prod(leaf.shape) for leaf in leaves)


def _size(num_bytes: int) -> str:
    return f"{num_bytes / 1e6:,.1f} MB" if num_bytes >= 1e6 else f"{num_bytes / 1e3:,.0f} kB"


def _cpu_time(seconds: float | None) -> Fact:
    if seconds is None:
        return Fact("CPU time", "unknown: no similar run has been measured", None, "cpu_seconds")
    about = f"{seconds:.0f} seconds" if seconds < 120 else f"{seconds / 60:.0f} minutes"
    return Fact("CPU time", f"about {about}, plus compilation", seconds, "cpu_seconds")
