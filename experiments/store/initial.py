"""The policy that a training starts from (``--init``): where it lies, and the settings that it fixes.

Only its config is read here, never its weights, and nothing imports jax.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel

from envs.errors import DataError, UsageError
from experiments.store.layout import CONFIG
from experiments.store.settings import PretrainConfig
from mgpo_jax.schema import STRICT, Json, Sha256, read_document
from mgpo_jax.settings import OF_WEIGHTS, check_contradictions, setting_fault, types_of

INIT = "init"
"""Subfolder of a run with its copy of the policy that training started from."""
OF_INITIAL = (*OF_WEIGHTS, "standardize_obs")
"""Settings of a training that are fixed by the policy it starts from."""
MEND_INIT = "give the folder of another policy with --init, such as RUN/policy"


class Initial(NamedTuple):
    """What the config of an initial policy says, read without its weights."""

    network: dict[str, Any]
    """The settings that the policy fixes (``OF_INITIAL``), by name."""
    sha256: str
    """Hash of its weights."""


class _PolicyConfig(BaseModel):
    """The entries of a policy's ``config.json`` that are read here; others are ignored."""

    model_config = {**STRICT, "extra": "ignore"}

    sha256: Sha256
    network: dict[str, Json]


def goes_on(config: PretrainConfig) -> bool:
    """Whether a config resumes a run that already exists."""
    return config.resume and os.path.isfile(config.folder / CONFIG)


def initial_folder(config: PretrainConfig) -> Path:
    """The folder of the policy that a training starts from; a resumed run uses its own copy.

    The config must have ``init`` set.
    """
    assert config.init is not None
    kept = config.folder / INIT
    return kept if goes_on(config) and os.path.isfile(kept / CONFIG) else config.init


def mend_initial(config: PretrainConfig) -> str:
    """How to mend a damaged initial policy, as the end of an error message."""
    folder = initial_folder(config)
    return MEND_INIT if folder == config.init else f"remove {folder}, and --init is read again"


def read_initial(config: PretrainConfig) -> Initial:
    """The config of the policy that a training starts from; raises as ``initial_at`` does."""
    return initial_at(initial_folder(config), mend_initial(config))


def initial_at(folder: Path, mend: str = MEND_INIT) -> Initial:
    """The config of an initial policy.

    Args:
      folder: folder of the policy.
      mend: how to mend a damaged one, the end of the error message.

    Raises:
      UsageError: if there is no policy in the folder.
      DataError: if its config is damaged.
    """
    path = folder / CONFIG
    if not os.path.isfile(path):
        raise UsageError(f"no policy in {folder} ({CONFIG} is missing); {mend}")
    document: _PolicyConfig = read_document(path, _PolicyConfig, mend)
    general = PretrainConfig()  # older policies lack settings that were constants at the time
    network = {name: document.network.get(name, getattr(general, name)) for name in OF_WEIGHTS}
    types = types_of(PretrainConfig)
    for name, value in network.items():
        if said := setting_fault(types[name], value):
            raise DataError(f"{path}: network.{name} {said}; {mend}")
    network["standardize_obs"] = bool(document.network.get("obs_mean"))
    return Initial(network, document.sha256)


def check_initial(config: PretrainConfig) -> None:
    """Raise ``UsageError`` for network settings that contradict those of the initial policy."""
    folder, network = initial_folder(config), read_initial(config).network
    given = {name: getattr(config, name) for name in network}
    mend = "leave it out" if folder == config.init else mend_initial(config)
    check_contradictions(given, network, f"the policy in {folder}", mend)
