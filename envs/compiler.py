"""A fault of XLA's CPU compiler that would silently give wrong numbers, and the option that avoids it.

jaxlib 0.10.2 hands reductions to a library of kernels (YNNPACK). A sum over the products of an array and
one that is broadcast along its leading axes, which goes on into other arithmetic in the same kernel, is
wrong beyond the first 128 KB of results (https://github.com/jax-ml/jax/issues/39103). It is right in
0.10.1, by that report, and in 0.11.2. The noise that Crafter's maps are made of is such a sum: the first
eight worlds of a batch were right, and all others were not those of their seeds.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import MutableMapping
from importlib.metadata import PackageNotFoundError, version

FAULTY = ("0.10.2",)
"""Versions of jaxlib that have the fault."""
OPTION = "xla_cpu_experimental_ynn_fusion_type"


def avoid_fault(environment: MutableMapping[str, str] = os.environ) -> None:
    """Have XLA compile reductions by itself where the installed jaxlib has the fault.

    jax may have been imported already, but it reads the variable when it starts its devices; after that
    nothing helps, and a ``RuntimeWarning`` says so. Where ``XLA_FLAGS`` says something about the option, it
    stays as it is.

    Args:
      environment: the variables of the process, of which ``XLA_FLAGS`` is changed.
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
    """The version of jaxlib. Other versions may refuse the option, so that it is not given to them."""
    try:
        return version("jaxlib")
    except PackageNotFoundError:
        return None


def _has_computed() -> bool:
    """Whether jax has started its devices in this process."""
    bridge = sys.modules.get("jax._src.xla_bridge")  # jax has no public function that tells
    started = getattr(bridge, "backends_are_initialized", None)
    return started is not None and started()
