"""A workaround for a bug of XLA's CPU compiler that silently gives wrong numbers.

jaxlib 0.10.2 delegates reductions to a library of kernels (YNNPACK). If an array is multiplied by one that
is broadcast along its leading axes, summed, and used in further arithmetic in the same kernel, the sum is
wrong beyond the first 128 KB of results (https://github.com/jax-ml/jax/issues/39103). It is right in
0.10.1, according to that report, and in 0.11.2. The noise from which Crafter's maps are generated is such a
sum: the first eight worlds of a batch were right, and all others were not those of their seeds.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import MutableMapping
from importlib.metadata import PackageNotFoundError, version

FAULTY = ("0.10.2",)
"""Versions of jaxlib that have the bug."""
OPTION = "xla_cpu_experimental_ynn_fusion_type"


def avoid_fault(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let XLA compile reductions without that library if the installed jaxlib has the bug.

    This may be called after jax was imported, but not after jax has initialized its devices, which is when
    it reads the variable; a ``RuntimeWarning`` says so. If ``XLA_FLAGS`` already sets the option, it is
    left unchanged.

    Args:
      environment: the environment variables of the process, of which ``XLA_FLAGS`` is changed.
    """
    flags = environment.get("XLA_FLAGS", "")
    if OPTION in flags or _installed() not in FAULTY:
        return
    environment["XLA_FLAGS"] = f"{flags} --{OPTION}=-reduce".strip()
    if _has_computed():
        warnings.warn(
            f"jaxlib {_installed()} computes some sums on CPUs wrongly, and jax has started already, so "
            "that this cannot be avoided any more; import envs or mgpo_jax before jax computes anything, "
            f"or set XLA_FLAGS=--{OPTION}=-reduce",
            RuntimeWarning,
            stacklevel=3,
        )


def _installed() -> str | None:
    """The version of jaxlib. Other versions may reject the option, so it is set only if needed."""
    try:
        return version("jaxlib")
    except PackageNotFoundError:
        return None


def _has_computed() -> bool:
    """Whether jax has initialized its devices in this process."""
    bridge = sys.modules.get("jax._src.xla_bridge")  # jax has no public function for this
    started = getattr(bridge, "backends_are_initialized", None)
    return started is not None and started()
