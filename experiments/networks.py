"""The network of a pre-training run: made of its settings, or that of the policy it starts from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from envs.base import Environment
from envs.errors import DataError, UsageError
from envs.specs import EnvSpec
from experiments.store import runs
from experiments.store.initial import check_initial, initial_folder, mend_initial
from experiments.store.settings import PretrainConfig
from mgpo_jax.dataset import Dataset
from mgpo_jax.kinds import KINDS, kind_of
from mgpo_jax.mapped import let_go
from mgpo_jax.network_configs import world_side
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.policy_files import MEND, read_policy

CONSTANT = 1e-4  # observation components with a smaller standard deviation are not scaled


def initial_policy(config: PretrainConfig, spec: EnvSpec) -> LoadedPolicy | None:
    """The policy that a run starts from; None if it starts from random weights.

    Raises:
      UsageError: if there is no policy in the folder, or the settings contradict its network.
      DataError: if it is damaged, of another world, or not the one that a resumed run started from.
    """
    if config.init is None:
        return None
    try:
        policy = read_policy(initial_folder(config), spec, config.method)
    except DataError as error:
        raise DataError(str(error).replace(MEND, mend_initial(config))) from None
    found = kind_of(policy.config).name
    if found not in (config.method, *KINDS.find(config.method).load().starts_from):
        raise UsageError(
            f"--method {config.method} cannot start from {config.init}, a network of the kind {found}"
        )
    runs.check_same_start(config, policy.sha256)
    check_initial(config)
    return policy


def configured_network(
    config: PretrainConfig,
    env: Environment | None,
    dataset: Dataset,
    init: LoadedPolicy | None = None,
    spec: EnvSpec | None = None,
) -> Any:
    """The network config of a run: that of the policy that it starts from, or one made of its settings.

    Args:
      config: settings of the run.
      env: the world; None for a dataset without one.
      dataset: the dataset, for the moments of the observations.
      init: the policy that the run starts from, if any.
      spec: describes the data if there is no world.
    """
    learned = KINDS.find(config.method).load()
    if init is not None:
        network = replace(init.config, dropout=config.dropout)
        if isinstance(network, learned.config):
            return network
        shared = learned.config(**_common(learned.config, network))
        return learned.complete(shared, env, dataset)
    spec = env.spec if env is not None else spec
    assert spec is not None
    network = learned.complete(sized_network(config, spec), env, dataset)
    if not config.standardize_obs:
        return network
    mean, std = moments(dataset.obs)
    std = np.where(std < CONSTANT, 1.0, std)
    return replace(network, obs_mean=tuple(mean.tolist()), obs_std=tuple(std.tolist()))


def sized_network(config: PretrainConfig, spec: EnvSpec) -> Any:
    """The network config that the settings imply, without anything that depends on the data."""
    learned = KINDS.find(config.method).load()
    sizes = _common(learned.config, config)
    return learned.config(**{**sizes, **world_side(spec, config.head, config.encoder)})


def _common(network: type[Any], source: Any) -> dict[str, Any]:
    """The fields of ``source``, by name, that a network's config has as well."""
    names = {f.name for f in fields(network)} & {f.name for f in fields(source)}
    return {name: getattr(source, name) for name in names}


def moments(obs: np.ndarray, piece: int = 1 << 24) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of each component of the observations, float64 [D].

    Rows are added up in order, ``piece`` numbers at a time, so that a memory-mapped array needs little
    memory. The result equals ``numpy.mean`` and ``numpy.std`` bit for bit if D is above 1.

    Args:
      obs: observations [N, ...].
      piece: how many numbers are converted at once.
    """
    size = int(np.prod(obs.shape[1:], dtype=np.int64))
    step = max(1, piece // size)

    def total(of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        found = np.zeros(size)
        for first in range(0, len(obs), step):
            rows = of(np.asarray(obs[first : first + step]).reshape(-1, size).astype(np.float64))
            found = np.add.reduce(np.concatenate([found[None], rows]), axis=0)
            let_go(obs)
        return found

    mean = total(lambda rows: rows) / len(obs)
    return mean, np.sqrt(total(lambda rows: np.square(rows - mean)) / len(obs))
