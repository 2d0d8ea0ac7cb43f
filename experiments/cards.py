"""The GPUs of processes that run one command together: which of them each uses, and what XLA does there.

jax would give every process of SLURM or Open MPI the GPU with the number of its local rank. That leaves the
other GPUs of a host idle if one process should drive all of them, and it fails if the scheduler shows every
process its own GPU alone. The functions here read variables of the environment and do not import jax.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, MutableMapping
from importlib.metadata import entry_points
from importlib.util import find_spec

PLUGINS = ("jax_cuda12_plugin", "jax_cuda13_plugin")
SAME_PROGRAMS = {"xla_gpu_shard_autotuning": "false", "xla_gpu_autotune_level": "0"}
"""Flags of XLA by which all processes run the same programs on GPUs. Otherwise each may choose other ones
by timing them, whose results differ in the last bits, or may wait for choices that another has cached."""


def own_cards(environment: Mapping[str, str]) -> list[int] | None:
    """The GPUs that this process of a scheduler should use, by their places among the visible ones.

    Args:
      environment: the environment variables of the process.

    Returns:
      An empty list for all GPUs; None to let jax choose the one with the local rank of this process.
    """
    if environment.get("JAX_LOCAL_DEVICE_IDS"):
        return None  # the user has chosen, and jax reads this variable itself
    visible = environment.get("CUDA_VISIBLE_DEVICES")
    cards = [] if visible is None else list(filter(None, visible.split(",")))
    tasks = tasks_on_host(environment)
    # With fewer cards than there are processes, these cards are this process's own.
    if tasks == 1 or (tasks is not None and 0 < len(cards) < tasks):
        return list(range(len(cards)))
    return [0] if len(cards) == 1 else None


def tasks_on_host(environment: Mapping[str, str]) -> int | None:
    """The number of processes that the scheduler has started on this host; None if it does not say.

    SLURM writes ``2(x3),1`` for two processes on each of three hosts and one on a fourth.
    """
    if (counted := environment.get("OMPI_COMM_WORLD_LOCAL_SIZE", "")).isdecimal():
        return int(counted)
    found = re.findall(r"(\d+)(?:\(x(\d+)\))?", environment.get("SLURM_STEP_TASKS_PER_NODE", ""))
    hosts = [int(tasks) for tasks, times in found for _ in range(int(times or 1))]
    own = environment.get("SLURM_NODEID", "0")
    return hosts[int(own)] if own.isdecimal() and int(own) < len(hosts) else None


def choose_same_programs(environment: MutableMapping[str, str]) -> None:
    """Let XLA compile the same programs for the GPUs of all processes, unless ``XLA_FLAGS`` says otherwise.

    This must run before jax initializes its devices. Where jax cannot use GPUs it changes nothing.

    Args:
      environment: the environment variables of the process, of which ``XLA_FLAGS`` is changed.
    """
    platforms = environment.get("JAX_PLATFORMS", "")
    if (platforms and not re.search("cuda|gpu", platforms)) or not has_plugin():
        return
    flags = environment.get("XLA_FLAGS", "")
    added = [f"--{name}={value}" for name, value in SAME_PROGRAMS.items() if name not in flags]
    environment["XLA_FLAGS"] = " ".join([flags, *added]).strip()


def has_plugin() -> bool:
    """Whether the part of jax that runs on CUDA is installed."""
    announced = any("cuda" in point.name for point in entry_points(group="jax_plugins"))
    return announced or any(find_spec(name) is not None for name in PLUGINS)
